"""Inputs that make no sense are refused by name, never scored."""

import numpy as np
import pytest

from tasks.reward.epdms import prepare, score
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.random_worlds import random_drives, random_world

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]])
BOW_TIE = np.array([[0.0, 0.0], [4.0, 4.0], [4.0, 0.0], [0.0, 4.0], [0.0, 0.0]])


WORLD = random_world(7)
STATES = random_drives(7, WORLD["past_states"], 3)


@pytest.mark.parametrize("ring", [BOW_TIE, SQUARE + 1e9])
def test_a_map_that_makes_no_sense_is_refused_by_name(ring: np.ndarray) -> None:
    with pytest.raises(ValueError, match="odd one"):
        prepare(**WORLD | {"polygons": (MapPolygon("odd one", MapLayer.LANE, ring),)})


@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_states_that_make_no_sense_are_refused_by_name(value: float) -> None:
    damaged = STATES.copy()
    damaged[0, 40, 2] = value
    for states in (damaged, STATES[0], STATES[:, :40], STATES[:0]):
        with pytest.raises(ValueError, match="states"):
            score(prepare(**WORLD), states)


def test_an_unknown_way_to_relate_progress_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="normalise"):
        score(prepare(**WORLD), STATES, normalise="mean")  # type: ignore[arg-type]
