"""Paths by arc length."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.experts.pdm_closed import DrivePaths, drive_paths, pose_at, project
from tests.tasks.experts import slow_pdm

Array = NDArray[np.float64]


def poses_at(paths: DrivePaths, progress: list[float] | Array, path: int = 0) -> Array:
    return np.array([pose_at(paths, path, float(at)) for at in progress])


def line_of(xy: Array) -> Array:
    """Points (P, 2) with the direction to the next as heading."""
    step = np.diff(xy, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([xy, np.append(heading, heading[-1])])


def test_the_first_of_two_equally_near_points_of_a_hairpin_counts() -> None:
    hairpin = line_of(np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 8.0], [0.0, 8.0]]))
    assert project(drive_paths(hairpin, [0.0]), 0, 5.0, 4.0) == 5.0


def test_headings_are_interpolated_the_short_way_round() -> None:
    paths = drive_paths(np.array([[0.0, 0.0, 3.1], [2.0, 0.0, -3.1]]), [0.0])
    assert abs(abs(pose_at(paths, 0, 1.0)[2]) - np.pi) < 1e-12


def test_a_parallel_of_a_left_curve_is_shorter_on_its_left() -> None:
    angle = np.linspace(0.0, np.pi / 2.0, 200)
    arc = np.stack([20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle), angle], axis=1)
    lengths = drive_paths(arc, (-1.0, 0.0, 1.0)).progress[:, -1]
    np.testing.assert_allclose(lengths, np.pi / 2.0 * np.array([21.0, 20.0, 19.0]), rtol=1e-4)


@pytest.mark.parametrize("seed", range(20))
def test_projection_and_interpolation_equal_their_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.0, rng.uniform(0.0, 0.4), 150))
    step = 0.75 * np.stack([np.cos(heading), np.sin(heading)], axis=1) * (rng.random(150) > 0.1)[:, None]
    line = line_of(1e3 * rng.normal(size=2) + np.cumsum(step, axis=0))
    points = line[rng.integers(0, 150, 100), :2] + rng.normal(0.0, 10.0, (100, 2))
    paths = drive_paths(line, (0.0, -1.0, 1.0))
    for index, offset in enumerate((0.0, -1.0, 1.0)):
        slow = slow_pdm.drive_path(slow_pdm.parallel(line, offset))
        along = np.array([project(paths, index, x, y) for x, y in points])
        np.testing.assert_allclose(along, slow.project(points), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(poses_at(paths, along, index), slow.at(along), rtol=0.0, atol=1e-9)
