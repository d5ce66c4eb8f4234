"""The two-stage aggregation, against numbers made by hand."""

import numpy as np
import pytest

from tasks.reward.two_stage import Group, aggregate, follow_up_weights, group_scores

HERE = np.zeros(2)


def test_weights_are_gaussian_in_the_distance_to_the_plans_end():
    weights = follow_up_weights(HERE, np.array([[0.0, 0.0], [0.3, 0.4]]))
    np.testing.assert_allclose(weights, np.array([1.0, np.exp(-0.25 / 0.2)]) / (1.0 + np.exp(-0.25 / 0.2)))


def test_frames_all_too_far_weigh_the_same():
    np.testing.assert_allclose(follow_up_weights(HERE, np.array([[5.0, 0.0], [2.5, 0.0]])), [0.5, 0.5])
    assert follow_up_weights(HERE, np.array([[1.8, 0.0], [2.5, 0.0]]))[0] > 0.99


def test_a_scenario_multiplies_its_stages_and_averages_now_and_previous():
    now = Group(np.array([1.0, 0.5]), HERE, np.array([[1.0, 0.8], [0.0, 0.4]]), np.array([[0.0, 0.0], [9.0, 0.0]]))
    previous = Group(np.array([0.8, 1.0]), HERE, np.array([[0.5, 0.5], [1.0, 0.0]]), np.array([[7.0, 0.0], [8.0, 0.0]]))
    np.testing.assert_allclose(group_scores(now), [1.0, 0.4])
    np.testing.assert_allclose(group_scores(previous), [0.8 * 0.75, 0.25])
    one = aggregate([(now, previous)])
    np.testing.assert_allclose(one.final, [(1.0 + 0.6) / 2, (0.4 + 0.25) / 2])
    np.testing.assert_allclose(one.stage_one, [0.9, 0.75])
    np.testing.assert_allclose(one.stage_two, [2.5 / 4, 1.7 / 4])
    nothing = Group(np.zeros(2), HERE, np.ones((1, 2)), np.zeros((1, 2)))
    np.testing.assert_allclose(aggregate([(now, previous), (nothing, nothing)]).final, one.final / 2)


def test_a_group_without_follow_up_frames_is_refused():
    with pytest.raises(ValueError, match="follow-up"):
        group_scores(Group(np.ones(1), HERE, np.zeros((0, 1)), np.zeros((0, 2))))
    with pytest.raises(ValueError, match="nothing"):
        aggregate([])
