"""A clip's own start states beside the vocabulary: the same gates and scores, tried first, and all else as it was."""

from collections.abc import Sequence

import numpy as np
import pytest

from tasks.perturb import NO_STARTS, Candidate, Perturbation, PerturbSettings, perturb
from tasks.rollout.simulate import TrafficSettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import random_stream
from tasks.world.vocabulary import FIRST_START, Vocabulary, kinematic_trajectories
from tests.tasks.streets import street_clip

TRAJECTORIES = kinematic_trajectories(500, seed=0)


def perturbed(
    starts: Array = NO_STARTS, trajectories: Array = TRAJECTORIES, settings: PerturbSettings | None = None
) -> Perturbation | Rejected:
    clip = street_clip()
    rng, chosen = random_stream(0, clip.clip_id, "perturb"), settings or PerturbSettings()
    return perturb(clip, Vocabulary(trajectories), chosen, TrafficSettings(), rng, starts)


@pytest.fixture(scope="module")
def found() -> Perturbation:
    """Without starts."""
    result = perturbed()
    assert isinstance(result, Perturbation)
    return result


def facts(candidates: Sequence[Candidate]) -> list[tuple[object, ...]]:
    return [(c.vocabulary_index, c.cell, c.score, c.reactive_score, c.rollout.ego_states.tobytes()) for c in candidates]


def straight_on(metres: float, aside_m: float = 0.0) -> Array:
    """(40, 3) along the street."""
    s = np.arange(1, 41) / 40
    y = aside_m * (3 * s**2 - 2 * s**3)
    return np.column_stack([metres * s, y, np.arctan2(aside_m * (6 * s - 6 * s**2), metres)])


def test_a_start_is_judged_as_the_vocabulary_s_is_comes_first_and_leaves_those_as_they_were(
    found: Perturbation,
) -> None:
    """Trajectories of candidates, given as starts in another order: the same to the last bit under other names."""
    models = [found.candidates[3], found.candidates[1]]
    result = perturbed(TRAJECTORIES[[model.vocabulary_index for model in models]])
    assert isinstance(result, Perturbation)
    first, others = result.candidates[:2], result.candidates[2:]
    assert [one.vocabulary_index for one in first] == [FIRST_START, FIRST_START - 1]
    assert [one[1:] for one in facts(first)] == [one[1:] for one in facts(models)]
    assert facts(others) == facts(found.candidates)
    counted = {name: n for name, n in result.gate_counts.items() if not name.startswith("start_")}
    assert counted == found.gate_counts


def test_of_two_in_one_cell_the_first_stays_and_cells_of_either_colour_count(found: Perturbation) -> None:
    """Metres along at T+H beyond the log's 32 m: 5 m are cell 1, of the half that the vocabulary leaves out."""
    result = perturbed(np.array([straight_on(37.0), straight_on(37.2)]))
    assert isinstance(result, Perturbation)
    own = [(c.vocabulary_index, c.cell) for c in result.candidates if c.vocabulary_index < 0]
    assert own == [(FIRST_START, (1, 0))]
    assert result.gate_counts["white_cell"] == found.gate_counts["white_cell"]
    assert result.considered.fate[-2:] == ("kept", "not_needed")


def test_starts_that_end_too_far_or_score_too_little_are_dropped_and_counted(found: Perturbation) -> None:
    beyond, off_the_road = straight_on(60.0), straight_on(32.0, -4.0)
    result = perturbed(np.array([beyond, off_the_road]), settings=PerturbSettings(max_lateral_m=8.0))
    assert isinstance(result, Perturbation)
    assert all(candidate.vocabulary_index >= 0 for candidate in result.candidates)
    assert (result.gate_counts["start_reached_gate"], result.gate_counts["start_score"]) == (1, 1)
    assert "start_score" not in found.gate_counts


def test_a_clip_that_no_trajectory_can_follow_still_has_its_starts() -> None:
    standing = np.zeros((3, 40, 3))  # ends 32 m behind the log
    assert isinstance(perturbed(NO_STARTS, standing), Rejected)
    result = perturbed(straight_on(32.0)[None], standing)
    assert isinstance(result, Perturbation)
    assert [candidate.vocabulary_index for candidate in result.candidates] == [FIRST_START]


def test_a_spread_list_keeps_its_bound_and_begins_with_the_starts(found: Perturbation) -> None:
    starts = TRAJECTORIES[[one.vocabulary_index for one in found.candidates[:2]]]
    result = perturbed(starts, settings=PerturbSettings(order="spread", at_most=4))
    assert isinstance(result, Perturbation)
    assert [one.vocabulary_index < 0 for one in result.candidates] == [True, True, False, False]
