"""An ego that reads one cell of the index sees everything that it could touch."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.reward.collisions import (
    CELL_M,
    CELLS_PER_SIDE,
    CIRCUMRADIUS,
    Obstacles,
    obstacles_of,
    with_index,
)
from tasks.world.frames import PACIFICA, touching

PERIOD_M = CELLS_PER_SIDE * CELL_M


def indexed(boxes: np.ndarray) -> Obstacles:
    n_items = boxes.shape[1]
    return with_index(obstacles_of(boxes, np.zeros(n_items, dtype=bool), np.zeros(n_items)))


def seen_from(obstacles: Obstacles, t: int, x: float, y: float) -> np.ndarray:
    row, column = (math.floor(place / CELL_M) % CELLS_PER_SIDE for place in (y, x))
    cell = (t * CELLS_PER_SIDE + row) * CELLS_PER_SIDE + column
    starts, rows = obstacles.cells
    return rows[starts[cell] : starts[cell + 1]].astype(np.int64) - t * obstacles.boxes.shape[1]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_items=st.integers(0, 30),
    spread_m=st.sampled_from([5.0, 60.0, 400.0]),
    origin_m=st.sampled_from([0.0, -PERIOD_M / 2, 1e6]),
    longest_m=st.sampled_from([0.0, 6.0, 40.0, 500.0]),
)
def test_whatever_touches_an_ego_is_in_the_cell_of_its_centre(seed, n_items, spread_m, origin_m, longest_m) -> None:
    rng = np.random.default_rng(seed)
    boxes = np.empty((3, n_items, 5))
    boxes[..., :2] = origin_m + rng.uniform(-spread_m, spread_m, (3, n_items, 2))
    boxes[..., 2] = rng.choice([0.0, np.pi / 2, 1.0, -2.5], (3, n_items))
    boxes[..., 3:] = rng.uniform(0.0, longest_m, (3, n_items, 2))
    boxes[rng.random((3, n_items)) < 0.2] = np.nan
    obstacles = indexed(boxes)
    near = origin_m + np.round(rng.uniform(-spread_m, spread_m, (60, 2)), rng.integers(0, 3))
    for x, y in np.concatenate([near, boxes[0, np.isfinite(boxes[0, :, 0]), :2]]):
        t, heading = rng.integers(3), rng.uniform(-4.0, 4.0)
        ego = np.array([x, y, heading, PACIFICA.length, PACIFICA.width])
        assert np.isin(np.nonzero(touching(ego, boxes[t]))[0], seen_from(obstacles, t, x, y)).all()


def test_an_ego_too_far_away_to_touch_anything_sees_nothing() -> None:
    obstacles = indexed(np.array([[[3.0, 4.0, 0.3, 4.5, 2.0]]]))
    assert seen_from(obstacles, 0, 3.0, 4.0).tolist() == [0]
    reach = math.sqrt(2.0) * (math.hypot(4.5, 2.0) / 2 + CIRCUMRADIUS + CELL_M)
    for angle in np.linspace(0.0, 6.0, 20):
        assert seen_from(obstacles, 0, 3.0 + reach * np.cos(angle), 4.0 + reach * np.sin(angle)).size == 0


def test_an_object_is_listed_at_its_own_times_and_once() -> None:
    boxes = np.full((3, 1, 5), np.nan)
    boxes[1, 0] = [0.0, 0.0, 0.0, 1000.0, 1000.0]  # longer than the grid's period
    obstacles = indexed(boxes)
    assert [seen_from(obstacles, t, 77.0, -310.0).tolist() for t in range(3)] == [[], [0], []]
