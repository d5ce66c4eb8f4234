"""A planner's drifts beside the vocabulary: the same gates and scores, their order, and what stays as it was."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.drifts import Drift, alternating, index_of, number_of, worst_first
from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.perturb import Candidate, Perturbation, PerturbSettings, perturb
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.chance import stream
from tasks.world.clip import NOW
from tasks.world.frames import to_world
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary
from tests.tasks.streets import street_clip

TRAJECTORIES = kinematic_trajectories(500, seed=0)


def perturbed(
    drifts: Sequence[Drift] = (), trajectories: Array = TRAJECTORIES, settings: PerturbSettings | None = None
) -> Perturbation | Rejected:
    clip = street_clip()
    rng, chosen = stream(0, clip.clip_id, "perturb"), settings or PerturbSettings()
    return perturb(clip, Vocabulary(trajectories), chosen, TrafficSettings(), PdmSettings(), rng, drifts)


@pytest.fixture(scope="module")
def found() -> Perturbation:
    """Without drifts."""
    result = perturbed()
    assert isinstance(result, Perturbation)
    return result


def facts(candidates: Sequence[Candidate]) -> list[tuple[object, ...]]:
    return [
        (c.vocabulary_index, c.cell, c.score, c.reactive_score, c.rollout.ego_states.tobytes(), c.fails)
        for c in candidates
    ]


def driven(local: Array) -> Array:
    """(41, 11) states of a drive along (40, 3) poses in the ego frame at T."""
    start = street_clip().ego_states[NOW]
    states: Array = track(start, to_world(start[:3], local)[None])[0]
    return states


def straight_on(metres: float, aside_m: float = 0.0) -> Array:
    """(40, 3) along the street."""
    s = np.arange(1, 41) / 40
    y = aside_m * (3 * s**2 - 2 * s**3)
    return np.column_stack([metres * s, y, np.arctan2(aside_m * (6 * s - 6 * s**2), metres)])


@given(st.integers(0, 2**20))
def test_no_drift_is_mistaken_for_a_row_of_the_vocabulary(number: int) -> None:
    assert index_of(number) < 0
    assert number_of(index_of(number)) == number
    assert number_of(number) is None


@given(st.lists(st.integers()), st.lists(st.integers()))
def test_two_lists_alternate_until_one_is_at_its_end(first: list[int], second: list[int]) -> None:
    both, n = list(alternating(first, second)), 2 * min(len(first), len(second))
    assert both[0:n:2] == first[: n // 2] and both[1:n:2] == second[: n // 2]
    assert both[n:] == first[n // 2 :] + second[n // 2 :]


def test_where_the_planner_fails_comes_first_and_of_those_the_worst() -> None:
    def one(number: int, score: float, fails: str) -> Drift:
        return Drift(number, np.zeros((41, 11)), score, fails)

    many = [one(0, 0.2, ""), one(1, 0.9, "ep"), one(2, 0.0, "nc"), one(3, 0.95, ""), one(4, 0.0, "dac")]
    assert worst_first(many) == [2, 4, 1, 0, 3]


def test_a_drift_is_a_candidate_as_the_vocabulary_s_is_and_leaves_those_as_they_were(found: Perturbation) -> None:
    """The states of a candidate, drifted: the same scores and the same traffic, before all others."""
    model = found.candidates[3]
    result = perturbed([Drift(7, model.rollout.ego_states, 0.0, "dac")])
    assert isinstance(result, Perturbation)
    first, *others = result.candidates
    assert (first.vocabulary_index, first.fails) == (index_of(7), "dac")
    assert (first.cell, first.score, first.reactive_score) == (model.cell, model.score, model.reactive_score)
    np.testing.assert_array_equal(first.end_pose, model.end_pose)
    np.testing.assert_array_equal(first.rollout.agents.boxes, model.rollout.agents.boxes)
    assert facts(others) == facts(found.candidates)
    assert found.candidates[0].fails is None
    counted = {name: n for name, n in result.gate_counts.items() if not name.startswith("drift_")}
    assert counted == found.gate_counts


def test_failing_ones_lead_and_the_others_take_turns_with_the_vocabulary(found: Perturbation) -> None:
    said = [(0.9, ""), (0.3, "dac"), (0.95, ""), (0.1, "nc")]
    drifts = [Drift(i, found.candidates[i].rollout.ego_states, *one) for i, one in enumerate(said)]
    result = perturbed(drifts)
    assert isinstance(result, Perturbation)
    own = [candidate.vocabulary_index for candidate in found.candidates]
    failing, ready = [index_of(3), index_of(1)], [index_of(0), own[0], index_of(2), own[1]]
    assert [candidate.vocabulary_index for candidate in result.candidates] == failing + ready + own[2:]


def test_of_two_in_one_cell_the_worse_stays_and_cells_of_either_colour_count(found: Perturbation) -> None:
    """Metres along at T+H beyond the log's 32 m: 5 m are cell 1, of the half that the vocabulary leaves out."""
    ahead, near = driven(straight_on(37.0)), driven(straight_on(37.2))
    result = perturbed([Drift(0, near, 0.5, "ep"), Drift(1, ahead, 0.1, "nc")])
    assert isinstance(result, Perturbation)
    drifted = [c for c in result.candidates if c.vocabulary_index < 0]
    assert [(c.vocabulary_index, c.cell) for c in drifted] == [(index_of(1), (1, 0))]
    assert result.gate_counts["white_cell"] == found.gate_counts["white_cell"]
    assert set(result.considered.fate[-2:]) == {"kept", "not_needed"}


def test_drifts_that_end_too_far_or_score_too_little_are_dropped_and_counted(found: Perturbation) -> None:
    beyond = Drift(0, driven(straight_on(60.0)), 0.0, "nc")
    off_the_road = Drift(1, driven(straight_on(32.0, -4.0)), 0.0, "dac")
    result = perturbed([beyond, off_the_road], settings=PerturbSettings(max_lateral_m=8.0))
    assert isinstance(result, Perturbation)
    assert all(candidate.vocabulary_index >= 0 for candidate in result.candidates)
    counts = result.gate_counts
    assert (counts["drift_reached_gate"], counts["drift_score"]) == (1, 1)
    assert "drift_score" not in found.gate_counts


def test_a_clip_that_no_trajectory_can_follow_still_has_the_planner_s_own() -> None:
    standing = np.zeros((3, 40, 3))  # ends 32 m behind the log
    assert isinstance(perturbed((), standing), Rejected)
    result = perturbed([Drift(0, driven(straight_on(32.0)), 1.0, "")], standing)
    assert isinstance(result, Perturbation)
    assert [candidate.vocabulary_index for candidate in result.candidates] == [index_of(0)]


def test_a_spread_list_keeps_its_bound_and_begins_with_what_fails(found: Perturbation) -> None:
    spread = PerturbSettings(order="spread", at_most=4)
    drifts = [Drift(i, found.candidates[i].rollout.ego_states, 0.1, "dac" if i else "") for i in range(3)]
    result = perturbed(drifts, settings=spread)
    assert isinstance(result, Perturbation)
    assert len(result.candidates) == 4
    assert [candidate.fails for candidate in result.candidates[:2]] == ["dac", "dac"]
    assert all(not candidate.fails for candidate in result.candidates[2:])
