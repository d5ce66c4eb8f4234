"""Trajectories of another meaning: every kind is told by what gives it away, and no healthy set is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.world.frames import to_world
from tasks.world.vocabulary import kinematic_trajectories, refuse_other_meaning

Array = NDArray[np.float64]
PLACES = np.random.default_rng(0).uniform((-500.0, -500.0, -3.0), (500.0, 500.0, 3.0), (300, 3))


def from_now(drives: Array) -> Array:
    return np.concatenate([np.zeros((len(drives), 1, drives.shape[2])), drives[:, :-1]], axis=1)


def twice_as_long(drives: Array) -> Array:
    """Every other row, and as fast as at the end from then on: what 8 s in 40 rows are."""
    kept = drives[:, 1::2]
    on = (kept[:, -1:] - kept[:, -2:-1]) * np.arange(1, kept.shape[1] + 1)[:, None]
    return np.concatenate([kept, kept[:, -1:] + on], axis=1)


def of_the_world(drives: Array) -> Array:
    return np.array([to_world(place, drive) for place, drive in zip(PLACES, drives)])


def with_headings(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda drives: np.concatenate([drives[..., :2], change(drives[..., 2:])], axis=-1)


KINDS: dict[str, tuple[Callable[[Array], Array], str]] = {
    "degrees": (with_headings(np.degrees), r"headings are \d+ deg off the direction of motion .*: they are in degrees"),
    "degrees from 0 to 360": (with_headings(lambda h: np.degrees(h) % 360.0), "they are in degrees"),
    "clockwise": (with_headings(lambda h: -h), "they turn the wrong way: clockwise"),
    "y to the right": (lambda drives: drives * [1, -1, 1], "they turn the wrong way: clockwise, or y is to the right"),
    "compass": (with_headings(lambda h: np.pi / 2 - h), "they count clockwise from y"),
    "backwards": (with_headings(lambda h: h + np.pi), "they point backwards"),
    "no headings": (with_headings(lambda h: 0.0 * h), r"headings are \d+ deg off the direction of motion"),
    "row of now": (from_now, r"the first row lies 0\.00 m from the start.*: it is the row of now"),
    "begins at 0.2 s": (lambda d: np.concatenate([d[:, 1:], d[:, -1:]], axis=1), r"2\.0 times as far as rows after it"),
    "swapped": (lambda drives: drives[..., [1, 0, 2]], "motion begins 90 deg off x.*: are x and y swapped"),
    "y forward": (lambda d: np.stack([-d[..., 1], d[..., 0], d[..., 2] + np.pi / 2], -1), "are x and y swapped"),
    "x backwards": (lambda drives: drives * [-1, -1, 1], "180 deg off x.*: does x point backwards"),
    "8 s": (twice_as_long, r"change their velocity by more than [4-7]\.\d m/s within a second.*: do they hold 8 s"),
    "twice as far": (lambda drives: drives * [2, 2, 1], "m/s within a second"),
    "centimetres": (lambda drives: drives * [100, 100, 1], r"faster than \d,\d\d\d m/s\. Expected metres"),
    "back in time": (lambda drives: drives[:, ::-1], "time runs backwards"),
    "of the world": (of_the_world, r"the first row lies \d\d\d\.\d\d m from the start.*not the world's"),
}


@pytest.fixture(params=["kinematic", "human"])
def drives(request: pytest.FixtureRequest) -> Array:
    if request.param == "kinematic":
        return kinematic_trajectories(300, 0)
    shared: Path = request.getfixturevalue("shared_root")
    return np.load(shared / "data" / "vocabulary" / "human_8192x40x3.npy")[::28].astype(float)


@pytest.mark.parametrize("kind", KINDS)
def test_another_meaning_is_told_by_what_gives_it_away(drives: Array, kind: str) -> None:
    spoil, said = KINDS[kind]
    refuse_other_meaning(drives, "mine.npy")
    with pytest.raises(ValueError, match=f"^mine.npy: .*{said}"):
        refuse_other_meaning(spoil(drives), "mine.npy")


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_odd_trajectories_refuse_no_file(drives: Array, kind: str) -> None:
    odd = np.where((np.arange(len(drives)) % 20 == 0)[:, None, None], KINDS[kind][0](drives), drives)
    refuse_other_meaning(odd, "mine.npy")


def test_what_stands_or_creeps_says_nothing() -> None:
    refuse_other_meaning(np.zeros((50, 40, 3)), "mine.npy")
    refuse_other_meaning(np.random.default_rng(0).normal(0.0, 0.02, (50, 40, 3)), "mine.npy")


def test_start_states_may_be_harsh_but_not_sideways() -> None:
    harsh = kinematic_trajectories(300, 0) * [2, 2, 1]
    refuse_other_meaning(harsh, "starts", human=False)
    with pytest.raises(ValueError, match="swapped"):
        refuse_other_meaning(harsh[..., [1, 0, 2]], "starts", human=False)


def test_the_whole_public_vocabulary_and_anchors_are_as_they_should_be(shared_root: Path) -> None:
    refuse_other_meaning(np.load(shared_root / "data/vocabulary/human_8192x40x3.npy").astype(float), "human")
    anchors = np.load(shared_root / "data/vocabulary/anchors_20x8x2.npy").astype(float)
    refuse_other_meaning(anchors, "anchors")
    for kind in ("row of now", "back in time"):
        with pytest.raises(ValueError, match=KINDS[kind][1].replace("4.0", r"\S+")):
            refuse_other_meaning(KINDS[kind][0](anchors), "anchors")
    with pytest.raises(ValueError, match="swapped"):
        refuse_other_meaning(anchors[..., ::-1], "anchors")
