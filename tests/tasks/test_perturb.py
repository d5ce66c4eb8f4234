"""Perturbation: gates and grid in closed form, the lazy walk against its slow twin, and its promises on a street."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.experts.pdm_closed import plan_for
from tasks.perturb import (
    Perturbation,
    PerturbSettings,
    first_good_per_cell,
    gate_failures,
    grid_cells,
    perturb,
    spread_out,
)
from tasks.reward.epdms import prepare_scene, score
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.stages import STAGES, Rejected
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, random_stream, scene_of_clip
from tasks.world.frames import to_local, to_world
from tasks.world.vocabulary import OF_LOG, Vocabulary, kinematic_trajectories
from tests.tasks.streets import moved, street_clip

SETTINGS = PerturbSettings()
TRAFFIC = TrafficSettings()


def perturbed(
    clip: Clip,
    trajectories: NDArray[np.float64],
    settings: PerturbSettings = SETTINGS,
    seed: int = 0,
    traffic: TrafficSettings = TRAFFIC,
) -> Perturbation | Rejected:
    rng = random_stream(seed, clip.clip_id, "perturb")
    return perturb(clip, Vocabulary(trajectories), settings, traffic, rng)


@pytest.fixture(scope="module")
def trajectories() -> NDArray[np.float64]:
    return kinematic_trajectories(500, seed=0)


@pytest.fixture(scope="module")
def found(trajectories: NDArray[np.float64]) -> Perturbation:
    result = perturbed(street_clip(), trajectories)
    assert isinstance(result, Perturbation)
    return result


@pytest.mark.parametrize(
    ("gate", "column", "limit"), [("longitudinal", 0, 20.0), ("lateral", 1, 2.0), ("heading", 2, np.deg2rad(20.0))]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_gate_keeps_its_limit_and_drops_what_lies_beyond(gate: str, column: int, limit: float, sign: float) -> None:
    ends = np.zeros((3, 3))
    ends[:, column] = sign * np.array([0.0, limit, limit + 1e-6])
    fails = gate_failures(ends, SETTINGS)
    assert fails[gate].tolist() == [False, False, True]
    assert not any(fails[other].any() for other in fails if other != gate)


def test_the_grid_is_five_metres_by_half_a_metre_with_the_log_in_the_middle_of_a_cell() -> None:
    ends = [[0, 0], [2.49, 0.249], [-2.49, -0.249], [2.51, 0], [0, 0.251], [-2.51, -0.251], [20, 2], [-20, -2]]
    cells = grid_cells(np.column_stack([np.array(ends, float), np.zeros(len(ends))]), SETTINGS)
    assert cells.tolist() == [[0, 0], [0, 0], [0, 0], [1, 0], [0, 1], [-1, -1], [4, 4], [-4, -4]]


@pytest.mark.parametrize(
    "name", ["max_heading_deg", "max_longitudinal_m", "max_lateral_m", "step_longitudinal_m", "step_lateral_m"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_gates_and_steps_are_positive_and_finite(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive and finite"):
        PerturbSettings(**{name: value})


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
def test_a_threshold_that_no_score_can_have_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="epdms_min must be from 0 to 1"):
        PerturbSettings(epdms_min=value)


def filter_then_pick(cells: NDArray[np.int64], order: Sequence[int], good: Sequence[bool]) -> list[int]:
    """The slow twin: every score first, then per cell the first good one of the order; cells as first met."""
    met: dict[tuple[int, ...], None] = {tuple(cells[member].tolist()): None for member in order}
    kept = [member for member in order if good[member]]
    firsts = [next((m for m in kept if tuple(cells[m].tolist()) == cell), None) for cell in met]
    return [member for member in firsts if member is not None]


@given(st.data())
def test_the_lazy_walk_equals_filter_then_pick(data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 60))
    cell = st.tuples(st.integers(-2, 2), st.integers(-2, 2))
    cells = np.array(data.draw(st.lists(cell, min_size=n, max_size=n)), dtype=np.int64).reshape(-1, 2)
    good = np.array(data.draw(st.lists(st.booleans(), min_size=n, max_size=n)), dtype=bool)
    order = data.draw(st.permutations(range(n)))[: data.draw(st.integers(0, n))]
    asked: list[int] = []

    def is_good(members: NDArray[np.int64]) -> NDArray[np.bool_]:
        asked.extend(members.tolist())
        return good[members]

    chosen, needed = first_good_per_cell(cells, np.array(order, dtype=np.int64), is_good)
    assert chosen.tolist() == filter_then_pick(cells, order, good.tolist())
    assert len(asked) == len(set(asked)), "nothing is scored twice"
    taken = {tuple(cells[m].tolist()): order.index(m) for m in chosen}
    upto = [m for k, m in enumerate(order) if k <= taken.get(tuple(cells[m].tolist()), n)]
    assert sorted(needed.tolist()) == sorted(upto), "nothing behind the chosen one"
    assert set(upto) <= set(asked)


def test_candidates_sit_on_black_cells_within_the_gates_one_per_cell(found: Perturbation) -> None:
    assert len(found.candidates) > 10
    cells = [candidate.cell for candidate in found.candidates]
    assert all(sum(cell) % 2 == 0 for cell in cells)
    assert len(set(cells)) == len(cells)
    target = street_clip().ego_states[NOW + HORIZON_STEPS, :3]
    for candidate in found.candidates:
        end = to_local(target, candidate.rollout.ego_states[-1, :3])
        np.testing.assert_allclose(candidate.end_pose, end, atol=1e-9)
        assert not any(gate_failures(end[None], SETTINGS)[gate][0] for gate in ("longitudinal", "lateral", "heading"))
        assert tuple(grid_cells(end[None], SETTINGS)[0]) == candidate.cell


def slow_start_ahead() -> Clip:
    """The car ahead stands 18 m away at T and by its log is gone at once; IDM lets it pick up speed at 1 m/s2."""
    street = street_clip()
    boxes, velocities = street.agents.boxes.copy(), street.agents.velocities.copy()
    time = (np.arange(len(boxes)) - NOW) * STEP_S
    boxes[:, 0, 0] = 18.0 + np.where(time > 0.0, 25.0 * time, 0.0)
    velocities[: NOW + 1, 0], velocities[NOW + 1 :, 0] = 0.0, (25.0, 0.0)
    return replace(street, agents=replace(street.agents, boxes=boxes, velocities=velocities))


def test_a_perturbation_that_only_the_log_makes_room_for_is_dropped(trajectories: NDArray[np.float64]) -> None:
    """What stays and what goes is what the traffic's own answer says, driven and scored once more by hand."""
    clip, traffic = slow_start_ahead(), TrafficSettings(yields=False)
    found = perturbed(clip, trajectories, traffic=traffic)
    counts = found.counts if isinstance(found, Rejected) else found.gate_counts
    assert counts["reactive_score"] > 3
    assert isinstance(found, Perturbation)
    scene, considered = scene_of_clip(clip), found.considered
    reference = plan_for(scene).driven
    by_index = {candidate.vocabulary_index: candidate for candidate in found.candidates}
    for index, fate, replayed in zip(considered.vocabulary_index.tolist(), considered.fate, considered.score):
        assert not np.isfinite(replayed) or (replayed >= SETTINGS.epdms_min) == (fate != "score")
        if fate not in ("kept", "reactive"):
            continue
        rollout = simulate(scene, to_world(scene.ego_state[:3], trajectories[index]), traffic)
        pair = np.stack([reference, rollout.ego_states])
        reacting = score(prepare_scene(scene, rollout.agents), pair, normalise="pairs").pdm_score[1]
        assert (reacting >= SETTINGS.epdms_min) == (fate == "kept")
        if fate == "kept":
            assert by_index[index].reactive_score == reacting
            np.testing.assert_array_equal(by_index[index].rollout.agents.boxes, rollout.agents.boxes)


def test_every_gated_trajectory_has_a_fate_and_the_counts_agree_with_it(
    found: Perturbation, trajectories: NDArray[np.float64]
) -> None:
    fates, considered = list(found.considered.fate), found.considered
    kept = {int(considered.vocabulary_index[i]) for i, fate in enumerate(fates) if fate == "kept"}
    assert kept == {candidate.vocabulary_index for candidate in found.candidates}
    assert np.isfinite(considered.score[[fate in ("score", "reactive", "kept") for fate in fates]]).all()
    assert np.isnan(considered.score[[fate not in ("score", "reactive", "kept") for fate in fates]]).all()
    assert found.gate_counts["white_cell"] == fates.count("white_cell")
    assert found.gate_counts["replay_score"] == fates.count("score")
    assert found.gate_counts["reactive_score"] == fates.count("reactive")
    raw = [found.gate_counts[f"raw_{gate}"] for gate in ("longitudinal", "lateral", "heading")]
    assert max(raw) <= len(trajectories) - len(fates) <= sum(raw)


def test_the_same_seed_gives_the_same_list_and_another_seed_another_order(
    found: Perturbation, trajectories: NDArray[np.float64]
) -> None:
    again, other = perturbed(street_clip(), trajectories), perturbed(street_clip(), trajectories, seed=1)
    assert isinstance(again, Perturbation)
    assert isinstance(other, Perturbation)
    assert [c.vocabulary_index for c in again.candidates] == [c.vocabulary_index for c in found.candidates]
    for a, b in zip(again.candidates, found.candidates, strict=True):
        np.testing.assert_array_equal(a.rollout.ego_states, b.rollout.ego_states)
        assert (a.score, a.reactive_score) == (b.score, b.reactive_score)
    assert [c.vocabulary_index for c in other.candidates] != [c.vocabulary_index for c in found.candidates]


def test_candidates_come_in_the_order_in_which_the_seeded_walk_met_their_cells(
    found: Perturbation, trajectories: NDArray[np.float64]
) -> None:
    walk = random_stream(0, "street", "perturb").permutation(len(trajectories)).tolist()
    considered = found.considered
    black = [i for i, fate in enumerate(considered.fate) if fate not in ("reached_gate", "white_cell")]
    cells = grid_cells(considered.end_pose, SETTINGS)
    first_met: dict[tuple[int, int], int] = {}
    for i in black:
        cell = (int(cells[i, 0]), int(cells[i, 1]))
        rank = walk.index(int(considered.vocabulary_index[i]))
        first_met[cell] = min(rank, first_met.get(cell, rank))
    ranks = [first_met[candidate.cell] for candidate in found.candidates]
    assert ranks == sorted(ranks)


def test_moving_the_world_moves_the_candidates_along(found: Perturbation, trajectories: NDArray[np.float64]) -> None:
    elsewhere = perturbed(moved(street_clip(), np.array([900.0, -400.0, 2.5])), trajectories)
    assert isinstance(elsewhere, Perturbation)
    assert [c.vocabulary_index for c in elsewhere.candidates] == [c.vocabulary_index for c in found.candidates]
    for a, b in zip(elsewhere.candidates, found.candidates, strict=True):
        np.testing.assert_allclose(a.end_pose, b.end_pose, atol=1e-6)
        assert a.reactive_score == pytest.approx(b.reactive_score, abs=1e-6)


def sideways(offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 40, 3) at the street's 8 m/s, ending so far to the left and along the road again."""
    s = np.arange(1, 41) / 40
    y = offsets_m[:, None] * (3 * s**2 - 2 * s**3)
    heading = np.arctan2(offsets_m[:, None] * (6 * s - 6 * s**2), 32.0)
    return np.stack([np.broadcast_to(32.0 * s, y.shape), y, heading], axis=-1)


def test_a_clip_that_nothing_can_follow_is_rejected_with_a_listed_reason() -> None:
    reasons = next(stage.reasons for stage in STAGES if stage.name == "perturb")
    standing = np.zeros((3, 40, 3))  # ends 32 m behind the log
    result = perturbed(street_clip(), standing)
    assert isinstance(result, Rejected)
    assert (result.stage, result.reason) == ("perturb", "no_gated_candidate")
    off_road = perturbed(street_clip(), sideways(np.arange(8.0, 14.0, 0.25)), PerturbSettings(max_lateral_m=30.0))
    assert isinstance(off_road, Rejected)
    assert off_road.reason == "no_good_candidate"
    assert off_road.counts["replay_score"] > 0 and "replay_score" in off_road.detail
    assert {result.reason, off_road.reason} <= set(reasons)


def test_spread_begins_at_the_log_and_then_halves_the_largest_gaps() -> None:
    line = np.column_stack([np.arange(-8.0, 9.0), np.zeros(17)])
    order = spread_out(line, lambda _: True, 9)
    assert line[order, 0].tolist() == [0.0, -8.0, 8.0, -4.0, 4.0, -6.0, -2.0, 2.0, 6.0]
    assert sorted(spread_out(line, lambda _: True, 99)) == list(range(17))
    assert spread_out(np.zeros((3, 2)), lambda _: True, 2) == [0, 1]
    assert spread_out(np.zeros((0, 2)), lambda _: True, 2) == []


@given(st.data())
def test_a_bad_point_leaves_no_mark_on_the_spread(data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 20))
    coordinate = st.integers(-9, 9)
    points = np.array(data.draw(st.lists(st.tuples(coordinate, coordinate), min_size=n, max_size=n)), float)
    points = points.reshape(-1, 2)
    good = np.array(data.draw(st.lists(st.booleans(), min_size=n, max_size=n)), bool)
    at_most = data.draw(st.integers(1, 22))
    asked: list[int] = []

    def is_good(member: int) -> bool:
        asked.append(member)
        return bool(good[member])

    taken = spread_out(points, is_good, at_most)
    only_good = np.flatnonzero(good)
    assert taken == only_good[spread_out(points[good], lambda _: True, at_most)].tolist()
    assert len(set(asked)) == len(asked)
    assert len(taken) == min(at_most, good.sum())


def test_a_dense_grid_takes_every_cell_and_the_first_of_its_spread_are_those_of_a_longer_one(
    trajectories: NDArray[np.float64],
) -> None:
    dense = PerturbSettings(max_longitudinal_m=8.0, step_longitudinal_m=1.0, interleaved=False, order="spread")
    every = perturbed(street_clip(), trajectories, dense)
    few = perturbed(street_clip(), trajectories, replace(dense, at_most=5))
    drawn = perturbed(street_clip(), trajectories, replace(dense, order="drawn"))
    assert isinstance(every, Perturbation) and isinstance(few, Perturbation) and isinstance(drawn, Perturbation)
    cells = [candidate.cell for candidate in every.candidates]
    assert {sum(cell) % 2 for cell in cells} == {0, 1} and len(set(cells)) == len(cells)
    assert every.gate_counts["white_cell"] == 0
    assert [c.vocabulary_index for c in few.candidates] == [c.vocabulary_index for c in every.candidates[:5]]
    assert {c.vocabulary_index for c in drawn.candidates} == {c.vocabulary_index for c in every.candidates}
    ends = np.array([candidate.end_pose[:2] for candidate in every.candidates])
    assert np.hypot(*ends[0]) == np.hypot(*ends.T).min()
    assert few.considered.fate.count("kept") == 5 and "not_needed" in few.considered.fate


def test_a_bound_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="at_most must be positive"):
        PerturbSettings(at_most=0)


def test_the_log_alone_is_the_candidate_that_ends_where_the_log_does(trajectories: NDArray[np.float64]) -> None:
    """Whatever threshold others must reach."""
    clip = street_clip()
    result = perturbed(clip, trajectories, replace(SETTINGS, at_log=True, epdms_min=1.0))
    assert isinstance(result, Perturbation)
    (logged,) = result.candidates
    assert logged.vocabulary_index == OF_LOG and logged.cell == (0, 0)
    np.testing.assert_array_equal(logged.end_pose, np.zeros(3))
    np.testing.assert_array_equal(logged.rollout.ego_states, clip.ego_states[NOW : NOW + HORIZON_STEPS + 1])
    assert 0.0 <= logged.reactive_score <= 1.0


def test_among_replayed_traffic_the_log_alone_is_the_log(trajectories: NDArray[np.float64]) -> None:
    clip = street_clip()
    result = perturbed(clip, trajectories, replace(SETTINGS, at_log=True), traffic=TrafficSettings(mode="replay"))
    assert isinstance(result, Perturbation)
    (logged,) = result.candidates
    np.testing.assert_array_equal(logged.rollout.agents.boxes, clip.agents.boxes[NOW : NOW + HORIZON_STEPS + 1])
    assert logged.score == logged.reactive_score
