"""The two-stage aggregation, against numbers made by hand."""

import numpy as np
import pytest

from tasks.reward.one_stage import FrameScores
from tasks.reward.two_stage import Group, aggregate, follow_up_weights, group_scores

HERE = np.zeros(2)


def test_weights_are_gaussian_in_the_distance_to_the_plans_end():
    weights = follow_up_weights(HERE, np.array([[0.0, 0.0], [0.3, 0.4]]))
    np.testing.assert_allclose(weights, np.array([1.0, np.exp(-0.25 / 0.2)]) / (1.0 + np.exp(-0.25 / 0.2)))


def test_frames_all_too_far_weigh_the_same():
    np.testing.assert_allclose(follow_up_weights(HERE, np.array([[5.0, 0.0], [2.5, 0.0]])), [0.5, 0.5])
    assert follow_up_weights(HERE, np.array([[1.8, 0.0], [2.5, 0.0]]))[0] > 0.99


def group(stage_one: list[float], stage_two: list[list[float]], starts_x: list[float]) -> Group:
    row = np.array(stage_one)
    return Group(FrameScores(row, row), HERE, np.array(stage_two), np.column_stack([starts_x, np.zeros(len(starts_x))]))


def test_a_scenario_multiplies_its_stages_and_averages_now_and_previous():
    now = group([1.0, 0.5], [[1.0, 0.8], [0.0, 0.4]], [0.0, 9.0])
    previous = group([0.8, 1.0], [[0.5, 0.5], [1.0, 0.0]], [7.0, 8.0])
    np.testing.assert_allclose(group_scores(now).filtered, [1.0, 0.4])
    np.testing.assert_allclose(group_scores(previous).filtered, [0.8 * 0.75, 0.25])
    one = aggregate([(now, previous)])
    np.testing.assert_allclose(one.final.filtered, [(1.0 + 0.6) / 2, (0.4 + 0.25) / 2])
    np.testing.assert_allclose(one.stage_one.filtered, [0.9, 0.75])
    # now: all the weight on (1, 0.8); previous: uniform, (0.75, 0.25)
    np.testing.assert_allclose(one.stage_two, [(1.0 + 0.75) / 2, (0.8 + 0.25) / 2])
    np.testing.assert_allclose(one.follow_ups, [2.5 / 4, 1.7 / 4])
    nothing = group([0.0, 0.0], [[1.0, 1.0]], [0.0])
    np.testing.assert_allclose(aggregate([(now, previous), (nothing, nothing)]).final.filtered, one.final.filtered / 2)


def test_in_stage_two_a_group_counts_once_however_many_follow_ups_it_has():
    row = [1.0]
    many = group(row, [[0.2]] * 9, [5.0] * 9)
    one, pair = group(row, [[0.8]], [0.0]), group(row, [[0.4], [1.0]], [0.0, 0.0])
    both = aggregate([(many, one), (one, pair)])
    np.testing.assert_allclose(both.stage_two, [(0.2 + 0.8 + 0.8 + 0.7) / 4])
    np.testing.assert_allclose(both.follow_ups, [(9 * 0.2 + 0.8 + 0.8 + 0.4 + 1.0) / 13])


def test_stage_two_is_the_final_score_of_a_planner_that_is_perfect_in_stage_one():
    rng = np.random.default_rng(3)
    groups = [group([1.0, 1.0], rng.uniform(size=(4, 2)).tolist(), rng.uniform(0.0, 1.0, 4).tolist()) for _ in range(6)]
    found = aggregate(list(zip(groups[:3], groups[3:])))
    np.testing.assert_allclose(found.stage_two, found.final.unfiltered, rtol=1e-12)
    assert (np.abs(found.stage_two - found.follow_ups) > 1e-3).all()


def test_a_group_without_follow_up_frames_is_refused():
    row = FrameScores(np.ones(1), np.ones(1))
    with pytest.raises(ValueError, match="follow-up"):
        group_scores(Group(row, HERE, np.zeros((0, 1)), np.zeros((0, 2))))
    with pytest.raises(ValueError, match="nothing"):
        aggregate([])
