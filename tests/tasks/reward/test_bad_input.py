"""Inputs that make no sense are refused by name, never scored."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tasks.reward.epdms import prepare, score
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.random_worlds import random_drives, random_world

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]])
BOW_TIE = np.array([[0.0, 0.0], [4.0, 4.0], [4.0, 0.0], [0.0, 4.0], [0.0, 0.0]])


def with_value(values: np.ndarray, value: float, *index: int) -> np.ndarray:
    out = values.copy()
    out[index] = value
    return out


def with_nan(values: np.ndarray, *index: int) -> np.ndarray:
    return with_value(values, np.nan, *index)


def polygon(ring: np.ndarray) -> tuple[MapPolygon, ...]:
    return (MapPolygon("odd one", MapLayer.LANE, ring),)


WORLD = random_world(7)
PAST, LINE, OBJECTS = WORLD["past_states"], WORLD["centerline"], WORLD["objects"]
SEEN = tuple(np.argwhere(OBJECTS.valid)[0])  # a step and an object


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"past_states": with_nan(PAST, 3, 0)}, "past_states"),
        ({"past_states": PAST[:3]}, "past_states"),
        ({"ego_state0": with_nan(PAST[-1], 2)}, "ego_state0"),
        ({"ego_state0": PAST[-1, :5]}, "ego_state0"),
        ({"past_states": None}, "drop_touching"),
        ({"centerline": with_nan(LINE, 5, 1)}, "centerline"),
        ({"polygons": polygon(BOW_TIE)}, "odd one"),
        ({"polygons": polygon(SQUARE + 1e9)}, "odd one"),
        ({"objects": OBJECTS.window(0, 30)}, "objects"),
        ({"objects": replace(OBJECTS, boxes=OBJECTS.boxes[..., :4])}, "objects"),
        ({"objects": replace(OBJECTS, velocities=OBJECTS.velocities[:, :0])}, "objects"),
        ({"red_lanes": (("l0",), np.ones((5, 1), dtype=bool))}, "red lanes"),
        ({"red_lanes": (("l0",), np.ones((41, 1)))}, "red lanes must be bool"),
        ({"past_states": with_value(PAST, 1e300, 3, 2)}, "past_states"),
        ({"objects": replace(OBJECTS, kinds=OBJECTS.kinds[:-1])}, "objects.kinds"),
        ({"objects": replace(OBJECTS, boxes=with_value(OBJECTS.boxes, np.inf, *SEEN, 0))}, "objects.boxes"),
        ({"objects": replace(OBJECTS, boxes=with_value(OBJECTS.boxes, -4.0, *SEEN, 3))}, "objects.boxes"),
        ({"objects": replace(OBJECTS, velocities=with_value(OBJECTS.velocities, np.nan, *SEEN))}, "objects.velocities"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused_by_name(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        prepare(**WORLD | changes)


@pytest.mark.parametrize(
    "damage",
    [
        lambda s: with_nan(s, 0, 40, 2),
        lambda s: with_value(s, 1e300, 0, 40, 2),
        lambda s: s[0],
        lambda s: s[:, :40],
        lambda s: s[:0],
    ],
)
def test_states_that_make_no_sense_are_refused_by_name(damage: Any) -> None:
    states = random_drives(7, PAST, 3)
    with pytest.raises(ValueError, match="states"):
        score(prepare(**WORLD), damage(states))


def test_an_unknown_way_to_relate_progress_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="normalise"):
        score(prepare(**WORLD), random_drives(7, PAST, 3), normalise="mean")  # type: ignore[arg-type]
