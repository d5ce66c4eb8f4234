"""The compiled reward equals its slow twin on random worlds, whole; and what must not matter does not."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.reward.epdms import Scores, prepare, score, with_objects
from tests.tasks.reward.random_worlds import random_drives, random_world
from tests.tasks.reward.slow import epdms as slow
from tests.tasks.reward.slow.prepare import prepare as slow_prepare

CLOSE = ("ep", "ep_raw_m", "pdm_score", "multiplier")


def assert_same(ours: Scores, theirs: Scores) -> None:
    for field in fields(Scores):
        one, other = getattr(ours, field.name), getattr(theirs, field.name)
        if field.name in CLOSE:
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-9, err_msg=field.name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), with_history=st.booleans())
def test_kernels_equal_the_slow_twin_on_random_worlds(seed: int, with_history: bool) -> None:
    world = random_world(seed)
    states = random_drives(seed, world["past_states"], 24)
    ours = score(prepare(**world), states, with_history=with_history)
    assert_same(ours, slow.score(slow_prepare(**world), states, with_history=with_history))


@pytest.mark.parametrize("seed", range(4))
def test_chunks_and_the_order_of_rows_objects_and_polygons_change_no_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = random_world(seed + 100)
    states = random_drives(seed, world["past_states"], 40)
    whole = score(prepare(**world), states, normalise="pairs")

    order = np.append(0, 1 + rng.permutation(39))  # row 0 is what "pairs" relates to
    assert_bits(score(prepare(**world), states[order], normalise="pairs"), whole, order)
    for chunk in (np.arange(0, 7), np.append(0, np.arange(7, 40))):
        assert_bits(score(prepare(**world), states[chunk], normalise="pairs"), whole, chunk)

    objects = world["objects"]
    shuffled = rng.permutation(len(objects))
    moved = replace(
        objects,
        track_ids=tuple(objects.track_ids[i] for i in shuffled),
        kinds=tuple(objects.kinds[i] for i in shuffled),
        boxes=objects.boxes[:, shuffled],
        velocities=objects.velocities[:, shuffled],
        valid=objects.valid[:, shuffled],
    )
    polygons = [world["polygons"][i] for i in rng.permutation(len(world["polygons"]))]
    assert_bits(score(prepare(**world | {"objects": moved, "polygons": polygons}), states, normalise="pairs"), whole)


@pytest.mark.parametrize("seed", range(4))
def test_a_scene_among_other_objects_is_the_scene_prepared_with_them(seed: int) -> None:
    world = random_world(seed)
    objects = world["objects"]
    turned = {name: getattr(objects, name)[:, ::-1].copy() for name in ("boxes", "velocities", "valid")}
    others = {"objects": replace(objects, **turned)}
    states = random_drives(seed, world["past_states"], 40)
    prepared = prepare(**world)
    score(prepared, states)  # which indexes the first objects
    assert_bits(
        score(with_objects(prepared, others["objects"], states[0, 0]), states), score(prepare(**world | others), states)
    )
    every = score(prepare(**world | others, drop_touching=False), states)
    assert_bits(score(with_objects(prepared, others["objects"], None), states), every)


def test_a_prepared_scene_from_a_store_of_read_only_memory_scores_the_same() -> None:
    world = random_world(3)
    states = random_drives(3, world["past_states"], 40)
    prepared = prepare(**world)
    whole = score(prepared, states)
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(prepared, protocol=5, buffer_callback=buffers.append)
    again = pickle.loads(body, buffers=[bytes(buffer.raw()) for buffer in buffers])  # our own, as Ray's store gives it
    assert again.centerline.segments.flags.writeable and again.map_index.cells.flags.writeable
    assert_bits(score(again, states), whole)


def assert_bits(ours: Scores, whole: Scores, index: np.ndarray | slice = slice(None)) -> None:
    for field in fields(Scores):
        assert getattr(ours, field.name).tobytes() == getattr(whole, field.name)[index].tobytes(), field.name


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    shift=st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0)),
    turn=st.floats(-3.1, 3.1),
)
def test_moving_and_turning_the_world_changes_no_score(seed: int, shift: tuple[float, float], turn: float) -> None:
    world = random_world(seed)
    states = random_drives(seed, world["past_states"], 16)
    here = score(prepare(**world), states)
    there = score(prepare(**moved_world(world, np.array(shift), turn)), moved_states(states, np.array(shift), turn))
    assert_same(there, here)


def moved_points(points: np.ndarray, shift: np.ndarray, turn: float) -> np.ndarray:
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s], [-s, c]]) + shift


def moved_states(states: np.ndarray, shift: np.ndarray, turn: float) -> np.ndarray:
    out = states.copy()
    out[..., :2] = moved_points(states[..., :2], shift, turn)
    out[..., 2] = (states[..., 2] + turn + np.pi) % (2.0 * np.pi) - np.pi
    return out


def moved_world(world: dict, shift: np.ndarray, turn: float) -> dict:
    objects, line = world["objects"], world["centerline"]
    boxes = objects.boxes.copy()
    boxes[..., :2], boxes[..., 2] = moved_points(boxes[..., :2], shift, turn), boxes[..., 2] + turn
    return world | {
        "past_states": moved_states(world["past_states"], shift, turn),
        "centerline": np.column_stack([moved_points(line[:, :2], shift, turn), line[:, 2] + turn]),
        "polygons": [
            replace(
                polygon,
                ring=moved_points(polygon.ring, shift, turn),
                holes=tuple(moved_points(hole, shift, turn) for hole in polygon.holes),
            )
            for polygon in world["polygons"]
        ],
        "objects": replace(objects, boxes=boxes, velocities=moved_points(objects.velocities, np.zeros(2), turn)),
    }
