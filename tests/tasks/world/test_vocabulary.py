"""Vocabularies: what is refused, and what a cluster keeps."""

import numpy as np
import pytest

from tasks.world.frames import to_world
from tasks.world.vocabulary import Vocabulary, cluster, human_windows, kinematic_trajectories


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((5, 8, 3)), r"shape \(5, 8, 3\), expected \(K >= 1, 40, 3\)"),
        (np.zeros((0, 40, 3)), r"shape \(0, 40, 3\)"),
        (np.zeros((2, 40, 3), dtype=np.int64), "int64, expected a floating point type"),
        (np.where(np.arange(3)[:, None, None] == 1, np.nan, np.zeros((3, 40, 3))), "the first is number 1"),
    ],
)
def test_a_broken_vocabulary_is_refused_by_name(values: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match="mine.npy: .*" + message):
        Vocabulary(values, source="mine.npy")


def test_the_digest_is_that_of_the_values_not_of_their_memory() -> None:
    values = kinematic_trajectories(6, 0)
    assert Vocabulary(values).digest == Vocabulary(np.asfortranarray(values)).digest
    assert Vocabulary(values[::-1]).digest != Vocabulary(values).digest
    assert Vocabulary(values, source="elsewhere").digest == Vocabulary(values).digest


def test_a_vocabulary_does_not_change_under_its_user() -> None:
    values = kinematic_trajectories(6, 0)
    vocabulary = Vocabulary(values)
    values[:] = 0.0
    assert vocabulary.trajectories.any()
    with pytest.raises(ValueError, match="read-only"):
        vocabulary.trajectories[0] = 0.0


def test_windows_of_a_drive_do_not_depend_on_where_it_was_driven() -> None:
    t = 0.1 * np.arange(80)
    states = np.zeros((80, 11))
    states[:, 0], states[:, 2] = 5.0 * t, 0.02 * t
    moved = states.copy()
    moved[:, :3] = to_world(np.array([100.0, 30.0, 2.0]), states[:, :3])
    starts = np.array([0, 10, 39])
    windows = human_windows(states, starts)
    np.testing.assert_allclose(windows, human_windows(moved, starts), atol=1e-9)
    np.testing.assert_allclose(windows[0], states[1:41, :3], atol=1e-12)
    with pytest.raises(ValueError, match="a window from step 40"):
        human_windows(states, np.array([40]))


def test_clusters_are_real_drives_and_the_same_for_the_same_seed() -> None:
    windows = kinematic_trajectories(300, 7)
    kept = cluster(windows, 40, seed=1)
    assert kept.shape == (40, 40, 3)
    assert len(np.unique(kept.reshape(40, -1), axis=0)) == 40
    assert all((windows == drive).all(axis=(1, 2)).any() for drive in kept)
    np.testing.assert_array_equal(kept, cluster(windows, 40, seed=1))


def test_well_separated_groups_are_each_represented() -> None:
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(1, 41)
    speeds = np.repeat([0.0, 5.0, 10.0, 20.0], 25) + rng.normal(0.0, 0.05, 100)
    windows = np.stack([speeds[:, None] * t, np.zeros((100, 40)), np.zeros((100, 40))], axis=-1)
    ends = np.sort(cluster(windows, 4, seed=0)[:, -1, 0])
    np.testing.assert_allclose(ends, [0.0, 20.0, 40.0, 80.0], atol=1.0)


def test_more_clusters_than_distinct_windows_is_an_error() -> None:
    windows = np.repeat(kinematic_trajectories(5, 0), 3, axis=0)
    assert len(cluster(windows, 5, seed=0)) == 5
    with pytest.raises(ValueError, match=r"k = 6 .* from 5 distinct windows"):
        cluster(windows, 6, seed=0)
