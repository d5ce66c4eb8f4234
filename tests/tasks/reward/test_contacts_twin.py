"""Collisions and time to collision: the kernels equal the numpy version in random small worlds, and invariances."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.kernels.compiled import inner_kernel
from tasks.reward.areas import Places, empty_places
from tasks.reward.centerline import LANES_KNOWN, MULTIPLE_LANES, NON_DRIVABLE, Body, empty_body, instants_of, place_body
from tasks.reward.collisions import (
    Looks,
    Obstacles,
    empty_looks,
    first_contacts,
    list_within_reach,
    obstacles_of,
    set_looks,
    with_index,
)
from tasks.reward.map_index import MapIndex, index_map
from tasks.world.frames import HEADING, PACIFICA, VX, VY, X, Y, box_corners, ego_boxes, to_world, touching
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.slow import collisions as slow
from tests.tasks.reward.slow.areas import EgoAreas
from tests.tasks.reward.slow.prepare import Obstacles as SlowObstacles


@dataclass(frozen=True)
class World:
    """K drives among N objects."""

    states: np.ndarray  # (K, 41, 11)
    flags: np.ndarray  # (K, 41) bits of tasks.reward.centerline
    crossing: np.ndarray  # (P, 2) ring of an intersection
    boxes: np.ndarray  # (41, N, 5)
    is_stopped: np.ndarray  # (N,)
    collision_score: np.ndarray  # (N,)


def objects(world: World) -> Obstacles:
    return obstacles_of(world.boxes, world.is_stopped, world.collision_score)


def contacts(world: World, obstacles: Obstacles) -> np.ndarray:
    """NC, its index, TTC's index (K, 3) by the kernels."""
    found = np.empty((len(world.states), 3))
    map_index = index_map([MapPolygon("crossing", MapLayer.INTERSECTION, world.crossing)], frozenset())
    body, looks = empty_body(world.flags.size), empty_looks(world.flags.size, 41, obstacles.boxes.shape[1])
    place_body(world.states.reshape(-1, 11), PACIFICA.rear_axle_to_center, body)
    body.flags[:] = world.flags.ravel() | LANES_KNOWN
    _contacts(obstacles, world.states, body, looks, map_index, empty_places(map_index, 1), found)
    return found


@inner_kernel
def _contacts(
    obstacles: Obstacles,
    states: np.ndarray,
    body: Body,
    looks: Looks,
    index: MapIndex,
    places: Places,
    found: np.ndarray,
) -> None:
    set_looks(body, looks)
    for k in range(len(states)):
        one = instants_of(body, 41 * k, 41 * k + 41)
        found[k, 0], found[k, 1], found[k, 2] = first_contacts(obstacles, states[k], one, looks, 41 * k, index, places)


@inner_kernel
def _list_within_reach(obstacles: Obstacles, body: Body, found: np.ndarray) -> int:
    return list_within_reach(obstacles, body, found)


def slow_contacts(world: World) -> np.ndarray:
    """The same by the numpy version."""
    centroids = np.full((*world.boxes.shape[:2], 2), np.nan)
    present = np.isfinite(world.boxes).all(axis=-1)
    polygons = shapely.polygons(box_corners(world.boxes[present]))
    centroids[present] = shapely.get_coordinates(shapely.centroid(polygons))
    obstacles = SlowObstacles(world.boxes, centroids, world.is_stopped, world.collision_score)
    nowhere = np.zeros(world.flags.shape, dtype=bool)
    areas = EgoAreas(
        multiple_lanes=(world.flags & MULTIPLE_LANES) != 0,
        non_drivable=(world.flags & NON_DRIVABLE) != 0,
        oncoming=nowhere,
        center_in_intersection=nowhere,
        rear_axle_in_intersection=shapely.contains_xy(
            shapely.Polygon(world.crossing), world.states[..., X], world.states[..., Y]
        ),
    )
    bodies = ego_boxes(world.states, PACIFICA)
    nc, collision = slow.no_at_fault_collision(obstacles, world.states, bodies, areas)
    ttc, violation = slow.time_to_collision(obstacles, world.states, bodies, areas)
    assert np.array_equal(ttc, np.where(np.isinf(violation), 1.0, 0.0))
    return np.stack([nc, collision, violation], axis=-1)


SPEEDS = (0.0, 0.004, 0.005, 0.05, 0.051, 2.0, 5.0, 9.0, 15.0, -1.0)
SIZES = ((4.5, 2.0), (0.5, 0.5), (0.0, 2.0), (3.0, 0.0), (0.0, 0.0), (14.0, 2.5), (200.0, 0.3), (5.176, 2.297))


def drive(rng: np.random.Generator) -> np.ndarray:
    """States (41, 11): straight or curved, at a speed that may change at once, standing included."""
    states = np.zeros((41, 11))
    speed = np.full(41, rng.choice(SPEEDS))
    if rng.random() < 0.4:
        speed[rng.integers(41) :] = rng.choice(SPEEDS)
    rate = rng.choice([0.0, 0.0, 0.3, -0.5])
    states[:, HEADING] = rate * 0.1 * np.arange(41)
    gone = 0.1 * np.cumsum(speed) - 0.1 * speed[0]
    states[:, X] = gone if rate == 0.0 else 0.1 * np.cumsum(speed * np.cos(states[:, HEADING]))
    states[:, Y] = 0.0 if rate == 0.0 else 0.1 * np.cumsum(speed * np.sin(states[:, HEADING]))
    states[:, VX], states[:, VY] = speed, rng.choice([0.0, 0.0, 0.01])
    return states


def item(rng: np.random.Generator, path: np.ndarray) -> np.ndarray:
    """Boxes (41, 5): beside or on a drive's path, standing or moving, sharing edges with the ego, not always there."""
    length, width = SIZES[rng.integers(len(SIZES))]
    at = path[rng.integers(41)]
    x, y = at[X] + rng.uniform(-8.0, 20.0), at[Y] + rng.choice([0.0, rng.uniform(-5.0, 5.0)])
    if rng.random() < 0.3:  # bumper to bumper, or side to side, with the ego at that moment
        x = at[X] + PACIFICA.rear_axle_to_center + rng.choice([-1.0, 0.0, 1.0]) * (PACIFICA.length + length) / 2.0
        y = at[Y] + rng.choice([-1.0, 0.0, 1.0]) * (PACIFICA.width + width) / 2.0
    velocity = rng.choice([0.0, 0.0, 5.0, -3.0, 15.0]), rng.choice([0.0, 0.0, 2.0, -2.0])
    boxes = np.empty((41, 5))
    boxes[:, :2] = np.array([x, y]) + 0.1 * np.arange(41)[:, None] * np.array(velocity)
    boxes[:, 2] = rng.choice([0.0, np.pi / 2, np.pi, rng.uniform(-4.0, 4.0)])
    boxes[:, 3:] = length, width
    if rng.random() < 0.6:
        boxes[: rng.integers(41)] = np.nan
    if rng.random() < 0.3:
        boxes[rng.integers(41) :] = np.nan
    if rng.random() < 0.2:
        boxes[rng.random(41) < 0.5] = np.nan
    return boxes


def square(low_m: float, high_m: float) -> np.ndarray:
    """Closed ring (5, 2) between low and high in x, and as wide as it is long, around y = 0."""
    half = (high_m - low_m) / 2.0
    return np.array([[low_m, -half], [high_m, -half], [high_m, half], [low_m, half], [low_m, -half]])


def moved(world: World, origin: np.ndarray) -> World:
    """The whole world in another frame."""
    states, boxes = world.states.copy(), world.boxes.copy()
    crossing = to_world(origin, np.column_stack([world.crossing, np.zeros(len(world.crossing))]))[:, :2]
    states[..., [X, Y, HEADING]] = to_world(origin, states[..., [X, Y, HEADING]])
    boxes[..., :3] = to_world(origin, boxes[..., :3])
    return replace(world, states=states, boxes=boxes, crossing=crossing)


@st.composite
def worlds(draw: st.DrawFn) -> World:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_drives, n_items = draw(st.integers(1, 4)), draw(st.sampled_from([0, 1, 2, 6, 25]))
    states = np.stack([drive(rng) for _ in range(n_drives)])
    items = [item(rng, states[rng.integers(n_drives)]) for _ in range(n_items)]
    if n_items > 2 and draw(st.booleans()):  # many in one place
        items = [items[i % 2] for i in range(n_items)]
    off_lane = rng.choice([0, MULTIPLE_LANES, NON_DRIVABLE, 12], (n_drives, 41)).astype(np.uint8)
    world = World(
        states=states,
        flags=off_lane if draw(st.booleans()) else np.zeros_like(off_lane),
        crossing=square(*draw(st.sampled_from([(-90.0, -80.0), (1.5, 20.0), (-80.0, 80.0)]))),
        boxes=np.stack(items, axis=1) if items else np.empty((41, 0, 5)),
        is_stopped=rng.random(n_items) < 0.4,
        collision_score=rng.choice([0.0, 0.5], n_items),
    )
    origin = draw(st.sampled_from([(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (-63.0, 129.0, 2.2), (3.3e5, 4.7e6, -0.4)]))
    return moved(world, np.array(origin))


@pytest.mark.slow
@settings(max_examples=150)
@given(worlds())
def test_both_rules_equal_the_numpy_version(world: World) -> None:
    np.testing.assert_array_equal(contacts(world, with_index(objects(world))), slow_contacts(world))


@settings(max_examples=25)
@given(worlds())
def test_objects_without_an_index_give_the_same(world: World) -> None:
    np.testing.assert_array_equal(contacts(world, objects(world)), contacts(world, with_index(objects(world))))


def test_what_is_exactly_ahead_may_count_as_not_ahead_where_rounding_lifts_the_cosine() -> None:
    verdicts = set()
    for heading in np.linspace(0.01, 1.5, 60):
        states = np.zeros((1, 41, 11))
        states[..., HEADING], states[..., VX] = heading, 10.0
        box = [6.0 * np.cos(heading), 6.0 * np.sin(heading), heading, 1.0, 1.0]
        world = World(
            states=states,
            flags=np.zeros((1, 41), dtype=np.uint8),
            crossing=square(80.0, 90.0),
            boxes=np.tile(box, (41, 1, 1)),
            is_stopped=np.ones(1, dtype=bool),
            collision_score=np.zeros(1),
        )
        found = contacts(world, with_index(objects(world)))
        np.testing.assert_array_equal(found, slow_contacts(world))
        verdicts.add(float(found[0, 2]))
    assert verdicts == {0.0, np.inf}


def test_objects_left_out_along_a_path_are_those_that_nothing_on_it_touches() -> None:
    x = np.array([0.0, 0.0, 43.5, 44.5, 20.0, np.nan, 43.0])  # the path ends at 40 m
    boxes = np.zeros((41, 7, 5))
    boxes[..., 0], boxes[..., 3], boxes[..., 4] = x, 2.0, 1.0
    boxes[:40, 1, 0], boxes[40, 1, 0] = 500.0, 3.0  # gone at all times but the last
    boxes[:, 4, 1] = 30.0  # aside
    boxes[:40, 6] = np.nan  # there at the last step alone
    states = np.zeros((41, 11))
    states[:, X] = np.arange(41.0) - PACIFICA.rear_axle_to_center
    body = empty_body(41)
    place_body(states, PACIFICA.rear_axle_to_center, body)
    found = np.empty(7, np.uint32)
    n = _list_within_reach(obstacles_of(boxes, np.zeros(7, dtype=bool), np.zeros(7)), body, found)
    assert found[:n].tolist() == [0, 1, 2, 6]
    ego = np.array([40.0, 0.0, 0.0, PACIFICA.length, PACIFICA.width])
    assert [i for i in range(7) if touching(ego, boxes[:, i]).any()] == [2, 6]  # from the path's end
