"""PDM-Closed's compiled proposals equal their slow twin, which asks shapely, on random worlds (docs/reward.md 4)."""

from dataclasses import fields
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.experts.pdm_closed import forecast, proposals
from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.frames import HEADING, VX, X, Y, box_corners
from tasks.world.geometry import rings_distance, rings_touch
from tests.tasks.experts import slow_pdm

Array = NDArray[np.float64]
SHAPES = ("straight", "curved", "hairpin", "loop", "two points", "short")


class World(NamedTuple):
    """What proposals are made from."""

    ego_state: Array
    centerline: Array
    agents: AgentTracks
    lights: tuple[shapely.Polygon, ...]


def centerline_of(shape: str, rng: np.random.Generator) -> Array:
    """(P, 3) somewhere in the world, points 0.75 m apart, some of them repeated."""
    count = {"two points": 2, "short": 6}.get(shape, int(rng.integers(40, 250)))
    turn = {"curved": 0.75 / rng.uniform(15.0, 80.0) * np.sin(np.linspace(0.0, rng.uniform(1.0, 9.0), count))}
    turn["hairpin"] = np.where(abs(np.arange(count) - 25) * 0.75 < 0.5 * np.pi * 5.0, 0.75 / 5.0, 0.0)
    turn["loop"] = np.full(count, 0.75 / rng.uniform(4.0, 12.0))
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(turn.get(shape, np.zeros(count)))
    spacing = 50.0 if shape == "two points" else 0.75
    repeated = rng.random(count) < rng.choice([0.0, 0.05])
    repeated[:2] = False
    step = spacing * ~repeated[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    xy = rng.uniform(-3e3, 3e3, 2) + np.cumsum(step, axis=0)
    return np.column_stack([xy, np.remainder(heading + np.pi, 2.0 * np.pi) - np.pi])


def beside(line: Array, rng: np.random.Generator, count: int, across_m: float) -> Array:
    """(count, 3) poses near points of a line, most of them turned about as the line is."""
    at = line[rng.integers(0, len(line), count)]
    poses = at + rng.normal(size=(count, 3)) * [across_m, across_m, 0.3]
    poses[:, 2] += rng.choice([0.0, np.pi, np.pi / 2.0], count)
    return poses


def world_of(shape: str, n_objects: int, standing: bool, past_the_end: bool, seed: int) -> World:
    rng = np.random.default_rng(seed)
    line = centerline_of(shape, rng)
    ego = np.zeros(11)
    ego[[X, Y, HEADING]] = beside(line[: max(2, len(line) // 2)], rng, 1, 1.0)[0]
    if past_the_end:
        ego[[X, Y]] = line[-1, :2] + rng.uniform(0.0, 8.0) * np.array([np.cos(line[-1, 2]), np.sin(line[-1, 2])])
    ego[VX] = 0.0 if standing else rng.uniform(-1.0, 20.0)

    sizes = rng.uniform([0.3, 0.3], [9.0, 2.5], (n_objects, 2))
    boxes = np.column_stack([beside(line, rng, n_objects, 4.0), sizes])
    speed = rng.uniform(-3.0, 15.0, n_objects) * (rng.random(n_objects) < 0.6)
    velocities = speed[:, None] * np.stack([np.cos(boxes[:, 2]), np.sin(boxes[:, 2])], axis=1)
    valid = rng.random(n_objects) < 0.9  # the others are absent now
    boxes[~valid], velocities[~valid] = np.nan, np.nan
    agents = AgentTracks(
        track_ids=tuple(f"track{i}" for i in range(n_objects)),
        kinds=tuple(rng.choice(list(AgentKind), n_objects)),
        boxes=boxes[None],
        velocities=velocities[None],
        valid=valid[None],
        center_z=np.zeros((1, n_objects)),
        heights=np.ones(n_objects),
    )
    lights = [red_light(pose, rng) for pose in beside(line, rng, int(rng.integers(0, 3)), 1.0)]
    if rng.random() < 0.1:
        lights.append(shapely.Polygon(box_corners(np.append(ego[[X, Y, HEADING]], [30.0, 6.0]))))  # holds the ego
    return World(ego, line, agents, tuple(lights))


def red_light(pose: Array, rng: np.random.Generator) -> shapely.Polygon:
    """A lane connector that bends: a band of width 3.5 m along an arc, concave."""
    angle = np.linspace(0.0, rng.uniform(0.3, 2.0), 12)
    radius = rng.uniform(6.0, 30.0)
    turned = np.stack([np.cos(pose[2] + angle), np.sin(pose[2] + angle)], axis=1)
    ring = np.concatenate([radius * turned, (radius + 3.5) * turned[::-1]])
    return shapely.Polygon(pose[:2] + ring - ring[0])


def assert_equals_its_slow_twin(world: World, limit: float | None) -> None:
    seen = forecast(world.ego_state, world.agents, world.lights)
    slow_seen = slow_pdm.forecast(world.ego_state, world.agents, world.lights)
    for field in fields(slow_seen):
        one, other = getattr(seen, field.name), getattr(slow_seen, field.name)
        if field.name == "drift":  # forward or straight back, here by a sign and there by half a turn
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)

    fast = proposals(world.ego_state, world.centerline, seen, limit)
    slow = slow_pdm.proposals(world.ego_state, world.centerline, slow_seen, limit)
    np.testing.assert_allclose(fast.leads, slow.leads, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(fast.progress_velocity, slow.progress_velocity, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(fast.poses, slow.poses, rtol=0.0, atol=1e-9)


@pytest.mark.slow
@settings(max_examples=80)
@given(
    shape=st.sampled_from(SHAPES),
    n_objects=st.integers(0, 25),
    standing=st.booleans(),
    past_the_end=st.booleans(),
    limit=st.sampled_from([None, 4.0, 30.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_proposals_equal_their_slow_twin(
    shape: str,
    n_objects: int,
    standing: bool,
    past_the_end: bool,
    limit: float | None,
    seed: int,
) -> None:
    assert_equals_its_slow_twin(world_of(shape, n_objects, standing, past_the_end, seed), limit)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_hundred_objects_around_every_shape_of_path_equal_their_slow_twin(shape: str) -> None:
    assert_equals_its_slow_twin(world_of(shape, 100, False, False, seed=3), None)


@settings(max_examples=100)
@given(st.integers(0, 2**32 - 1))
def test_boxes_and_bent_polygons_are_as_far_apart_as_shapely_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = box_corners(np.append(rng.normal(0.0, 8.0, 3), rng.uniform(0.1, 8.0, 2)))
    other = np.asarray(red_light(rng.normal(0.0, 4.0, 3), rng).exterior.coords)[:-1]
    one, two = shapely.Polygon(box), shapely.Polygon(other)
    for first, second in ((box, other), (other, box)):
        rings = (*first.T.copy(), *second.T.copy())
        assert rings_touch(*rings) == one.intersects(two)
        np.testing.assert_allclose(rings_distance(*rings), one.distance(two), rtol=0.0, atol=1e-12)
