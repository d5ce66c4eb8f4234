"""An ego that reads one cell of the index sees everything that it could touch."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.reward.collisions import (
    CELLS_PER_SIDE,
    ENTRIES_PER_BOX,
    SMALLEST_CELL_M,
    Obstacles,
    cell_of,
    index_obstacles,
    unindexed,
    within_reach,
)
from tasks.world.geometry import touching

EGO_SIZE = (5.176, 2.297)
RADIUS_M = 0.5 * math.hypot(*EGO_SIZE)
PERIOD_M = CELLS_PER_SIDE * SMALLEST_CELL_M


def indexed(boxes: np.ndarray) -> Obstacles:
    n_items = boxes.shape[1]
    return index_obstacles(boxes, np.zeros(n_items, dtype=bool), np.zeros(n_items), RADIUS_M)


def seen_from(obstacles: Obstacles, t: int, x: float, y: float) -> np.ndarray:
    cell = cell_of(obstacles, t, x, y)
    return obstacles.items[obstacles.starts[cell] : obstacles.starts[cell + 1]]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_items=st.integers(1, 30),
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
        touched = np.nonzero(touching(np.array([x, y, heading, *EGO_SIZE]), boxes[t]))[0]
        assert np.isin(touched, seen_from(obstacles, t, x, y)).all()


def test_an_ego_too_far_away_to_touch_anything_sees_nothing() -> None:
    box = np.array([[[3.0, 4.0, 0.3, 4.5, 2.0]]])
    obstacles = indexed(box)
    assert seen_from(obstacles, 0, 3.0, 4.0).tolist() == [0]
    reach = math.hypot(4.5, 2.0) / 2 + RADIUS_M + 2 * SMALLEST_CELL_M
    for angle in np.linspace(0.0, 6.0, 20):
        assert seen_from(obstacles, 0, 3.0 + reach * np.cos(angle), 4.0 + reach * np.sin(angle)).size == 0


def test_an_object_is_listed_at_its_own_times_and_once() -> None:
    boxes = np.full((3, 1, 5), np.nan)
    boxes[1, 0] = [0.0, 0.0, 0.0, 1000.0, 1000.0]  # longer than the grid's period
    obstacles = indexed(boxes)
    assert [seen_from(obstacles, t, 77.0, -310.0).tolist() for t in range(3)] == [[], [0], []]


def test_the_index_stays_small_however_large_the_objects() -> None:
    boxes = np.tile([0.0, 0.0, 0.7, 90.0, 90.0], (41, 200, 1))
    obstacles = indexed(boxes)
    assert obstacles.items.size <= ENTRIES_PER_BOX * 41 * 200
    assert obstacles.cells_per_m < 1.0 / SMALLEST_CELL_M
    assert sorted(seen_from(obstacles, 40, 30.0, 30.0)) == list(range(200))


def test_a_world_without_objects_has_an_index_too() -> None:
    for obstacles in (indexed(np.empty((41, 0, 5))), indexed(np.full((41, 4, 5), np.nan))):
        assert seen_from(obstacles, 12, 3.0, -8.0).size == 0


def test_unindexed_objects_are_seen_from_everywhere() -> None:
    obstacles = unindexed(np.zeros((41, 5, 5)), np.zeros(5, dtype=bool), np.zeros(5))
    assert seen_from(obstacles, 40, 1e5, -1e5).tolist() == [0, 1, 2, 3, 4]


def test_objects_left_out_along_a_path_are_those_that_nothing_on_it_touches() -> None:
    x = np.array([0.0, 0.0, 43.5, 44.5, 20.0, np.nan, 43.0])  # the path ends at 40 m
    boxes = np.zeros((41, 7, 5))
    boxes[..., 0], boxes[..., 3], boxes[..., 4] = x, 2.0, 1.0
    boxes[:40, 1, 0], boxes[40, 1, 0] = 500.0, 3.0  # gone at all times but the last
    boxes[:, 4, 1] = 30.0  # aside
    boxes[:40, 6] = np.nan  # there at the last step alone
    plain = unindexed(boxes, np.zeros(7, dtype=bool), np.zeros(7))
    near = within_reach(plain, (0.0, 0.0, 40.0, 0.0), *EGO_SIZE)
    kept = near.items[near.starts[0] : near.starts[1]].tolist()
    assert kept == [0, 1, 2, 6]
    touched = [i for i in range(7) if any(touching(np.array([40.0, 0.0, 0.0, *EGO_SIZE]), box) for box in boxes[:, i])]
    assert touched == [2, 6]  # from the path's end
    everywhere = indexed(boxes)
    met = within_reach(everywhere, (0.0, 0.0, 1.0, 1.0), *EGO_SIZE)
    assert np.array_equal(met.items, everywhere.items)
    assert np.array_equal(met.starts, everywhere.starts)
