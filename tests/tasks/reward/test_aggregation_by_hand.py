"""Aggregation against numbers worked out on paper, each beside its arithmetic (docs/reward.md 2k, 2l, 3)."""

import math
from dataclasses import fields

import numpy as np
import pytest

from tasks.reward.aggregate import (
    COLUMNS,
    Group,
    aggregate,
    columns_of,
    final_score,
    follow_up_weights,
    frame_scores,
    group_scores,
    means_of,
)
from tasks.reward.epdms import Scores, human_filtered, score, score_with_ec
from tasks.subscores import MULTIPLIERS, WEIGHTS
from tests.tasks.reward.straight_street import drive, street

NONE = np.nan  # no frame at most 0.55 s before


def one_row(**sub_scores: float) -> Scores:
    """One scored row; sub-scores not named are 1. What human_filtered makes of a perfect human is the row itself."""
    values = {name: np.array([sub_scores.get(name, 1.0)]) for name in (*MULTIPLIERS, *WEIGHTS)}
    others = {field.name: np.zeros(1) for field in fields(Scores) if field.name not in values}
    row = Scores(**values, **others)
    perfect = Scores(**{name: np.ones(1) for name in values}, **others)
    return human_filtered(row, perfect)


def column(row: np.ndarray, name: str) -> float:
    return float(row[..., COLUMNS.index(name)])


def test_a_frames_score_is_over_14_without_and_over_16_with_extended_comfort() -> None:
    # multiplier 0.5 * 1 * 1 * 0.5 = 0.25; weighted 5 * 0.6 + 5 * 1 + 2 * 0 + 2 * 1 = 10
    row = one_row(nc=0.5, ddc=0.5, ep=0.6, lk=0.0)
    assert row.multiplier[0] == 0.25
    assert row.pdm_score[0] == pytest.approx(0.17857142857, abs=1e-11)  # 0.25 * 10 / 14
    assert score_with_ec(row, np.ones(1))[0] == pytest.approx(0.1875)  # 0.25 * (10 + 2) / 16
    assert score_with_ec(row, np.zeros(1))[0] == pytest.approx(0.15625)  # 0.25 * 10 / 16
    assert final_score(row, np.array([1.0]))[0] == pytest.approx(0.1875)
    assert final_score(row, np.array([0.0]))[0] == pytest.approx(0.15625)
    assert final_score(row, np.array([NONE]))[0] == pytest.approx(0.17857142857, abs=1e-11)


def test_the_filter_forgives_what_the_human_fails_entirely_and_nothing_else() -> None:
    # The plan: mult 0 * 0.5 = 0, so 0. The human: NC 0, DDC 0.5.
    plan, human = one_row(nc=0.0, ddc=0.5, ep=0.8, hc=0.0), one_row(nc=0.0, ddc=0.5)
    both = frame_scores(plan, human, ec=1.0)
    assert column(both.unfiltered, "score") == 0.0
    # NC becomes 1, DDC stays 0.5: 0.5 * (5 * 0.8 + 5 + 2 + 0 + 2) / 16 = 0.5 * 13 / 16
    assert column(both.filtered, "score") == pytest.approx(0.40625)
    assert [column(both.filtered, name) for name in ("nc", "ddc", "ep", "hc", "ec")] == [1.0, 0.5, 0.8, 0.0, 1.0]
    assert [column(both.unfiltered, name) for name in ("nc", "ddc", "ep", "hc", "ec")] == [0.0, 0.5, 0.8, 0.0, 1.0]
    # As one-stage tables have it: filtered columns, all of them good, beside a score of 0
    assert (column(both.published, "nc"), column(both.published, "score")) == (1.0, 0.0)
    # Without a frame before: 0.5 * 11 / 14
    without_ec = frame_scores(plan, human)
    assert column(without_ec.filtered, "score") == pytest.approx(0.39285714286, abs=1e-11)
    assert math.isnan(column(without_ec.filtered, "ec"))


def test_a_filtered_weighted_column_enters_the_sum_again() -> None:
    # (4 + 0 + 2 + 2 + 2) / 16 = 0.625 against (4 + 5 + 2 + 2 + 2) / 16 = 0.9375
    both = frame_scores(one_row(ttc=0.0, ep=0.8), one_row(ttc=0.0, lk=0.0), ec=1.0)
    assert (column(both.unfiltered, "score"), column(both.filtered, "score")) == (0.625, 0.9375)
    # Half a collision of the plan is forgiven too where the human has a whole one: 0.5 -> 1
    both = frame_scores(one_row(nc=0.5), one_row(nc=0.0), ec=1.0)
    assert (column(both.unfiltered, "score"), column(both.filtered, "score")) == (0.5, 1.0)


def test_one_stage_means_come_filtered_and_unfiltered_side_by_side() -> None:
    frames = [
        frame_scores(one_row(nc=0.0, ep=0.8), one_row(nc=0.0), ec=1.0),  # 0 | (4 + 5 + 2 + 2 + 2) / 16 = 0.9375
        frame_scores(one_row(ttc=0.0), one_row(), ec=0.0),  # (5 + 0 + 2 + 2 + 0) / 16 = 0.5625 both
        frame_scores(one_row(dac=0.0), one_row(), ec=NONE),  # 0 both
        frame_scores(one_row(ep=0.3), one_row(), ec=NONE),  # (1.5 + 9) / 14 = 0.75 both
    ]
    means = means_of(frames)
    assert column(means.unfiltered, "score") == pytest.approx(0.328125)  # (0 + 0.5625 + 0 + 0.75) / 4
    assert column(means.filtered, "score") == pytest.approx(0.5625)  # (0.9375 + 0.5625 + 0 + 0.75) / 4
    assert (column(means.unfiltered, "nc"), column(means.filtered, "nc")) == (0.75, 1.0)
    assert column(means.filtered, "dac") == 0.75
    assert column(means.filtered, "ep") == pytest.approx(0.775)  # (0.8 + 1 + 1 + 0.3) / 4
    assert column(means.filtered, "ec") == 0.5  # of the two frames that have it
    assert (column(means.published, "nc"), column(means.published, "score")) == (1.0, pytest.approx(0.328125))
    assert math.isnan(column(means_of(frames[2:]).filtered, "ec"))


def test_frames_to_score_are_one_plan_each() -> None:
    two = score(street(), np.concatenate([drive(8.0), drive(4.0)]))
    with pytest.raises(ValueError, match="scores must be one row"):
        frame_scores(two, None)
    with pytest.raises(ValueError, match="human must be one row"):
        frame_scores(one_row(), two)
    with pytest.raises(ValueError, match="frames"):
        means_of([])


def test_a_group_without_follow_up_frames_is_refused() -> None:
    frame = frame_scores(one_row(), None)
    with pytest.raises(ValueError, match="follow-up"):
        group_scores(Group(frame, np.zeros(2), np.zeros((0, len(COLUMNS))), np.zeros((0, 2))))
    with pytest.raises(ValueError, match="nothing"):
        aggregate([])


def test_follow_up_weights_are_exp_of_minus_five_distances_squared() -> None:
    end = np.array([100.0, 50.0])
    # d^2 = 0.04, 0.2: exp(-0.2) = 0.818731, exp(-1) = 0.367879; sum 1.186610
    weights = follow_up_weights(end, np.array([[100.2, 50.0], [100.4, 49.8]]))
    np.testing.assert_allclose(weights, [0.689974, 0.310026], atol=1e-6)
    # Two at the same distance in any direction weigh the same; one far away weighs nothing.
    weights = follow_up_weights(end, np.array([[100.3, 50.4], [99.5, 50.0], [110.0, 50.0]]))
    np.testing.assert_allclose(weights, [0.5, 0.5, 0.0], atol=1e-12)


def test_beyond_1_92_m_and_for_unknown_places_all_follow_ups_weigh_the_same() -> None:
    end = np.zeros(2)
    # exp(-1.91^2 / 0.2) = 1.2e-8 is a weight, exp(-1.93^2 / 0.2) = 0.8e-8 is none (np.isclose to 0 within 1e-8)
    assert follow_up_weights(end, np.array([[1.91, 0.0], [2.5, 0.0]]))[0] > 0.999
    assert follow_up_weights(end, np.array([[1.93, 0.0], [2.5, 0.0]])).tolist() == [0.5, 0.5]
    assert follow_up_weights(end, np.array([[0.0, 0.0], [np.nan, 0.0]])).tolist() == [0.5, 0.5]
    assert follow_up_weights(np.array([np.nan, 0.0]), np.zeros((4, 2))).tolist() == [0.25] * 4


def scenario() -> tuple[Group, Group]:
    """Now: NC 0 forgiven by the filter, follow-ups near; previous: nothing to forgive, follow-ups 2 m away or more."""
    now = Group(
        # unfiltered 0; filtered (5 * 0.6 + 5 + 2 + 2 + 0) / 16 = 0.75
        stage_one=frame_scores(one_row(nc=0.0, ep=0.6), one_row(nc=0.0), ec=0.0),
        endpoint_xy=np.array([100.0, 50.0]),
        # scores 1 and (5 * 0.2 + 5 + 2 + 2 + 2) / 16 = 0.75
        stage_two=np.stack([frame_scores(one_row(ep=ep), None, ec=1.0).unfiltered for ep in (1.0, 0.2)]),
        starts_xy=np.array([[100.2, 50.0], [100.4, 49.8]]),  # weights 0.689974, 0.310026
    )
    previous = Group(
        # (5 + 5 + 0 + 2 + 0) / 16 = 0.75; the pair's extended comfort stands in both rows
        stage_one=frame_scores(one_row(lk=0.0), one_row(), ec=0.0),
        endpoint_xy=np.array([95.0, 50.0]),
        # scores 0 and (5 + 0 + 2 + 2 + 2) / 16 = 0.6875
        stage_two=np.stack(
            [frame_scores(one_row(**bad), None, ec=1.0).unfiltered for bad in ({"dac": 0.0}, {"ttc": 0.0})]
        ),
        starts_xy=np.array([[97.0, 50.0], [95.0, 40.0]]),  # 2 m, 10 m: 0.5, 0.5
    )
    return now, previous


def test_a_group_multiplies_stage_one_with_weighted_stage_two_column_by_column() -> None:
    now, previous = scenario()
    # Weighted stage two of `now`: score 0.689974 + 0.310026 * 0.75 = 0.922494; EP 0.689974 + 0.310026 * 0.2 = 0.751979
    filtered, unfiltered = group_scores(now).filtered, group_scores(now).unfiltered
    assert column(filtered, "score") == pytest.approx(0.691870, abs=1e-6)  # 0.75 * 0.922494
    assert column(filtered, "ep") == pytest.approx(0.451188, abs=1e-6)  # 0.6 * 0.751979
    assert (column(filtered, "nc"), column(unfiltered, "nc")) == (pytest.approx(1.0), 0.0)
    assert column(unfiltered, "score") == 0.0
    assert column(unfiltered, "ep") == pytest.approx(0.451188, abs=1e-6)
    assert column(filtered, "ec") == 0.0  # 0 * 1
    # `previous`: score 0.75 * (0 + 0.6875) / 2, DAC 1 * (0 + 1) / 2, TTC 1 * (1 + 0) / 2, LK 0 * 1
    before = group_scores(previous).filtered
    assert [column(before, name) for name in ("score", "dac", "ttc", "lk")] == [0.2578125, 0.5, 0.5, 0.0]


def test_two_stage_scores_average_now_and_previous_then_scenarios() -> None:
    now, previous = scenario()
    once = aggregate([(now, previous)])
    assert column(once.final.filtered, "score") == pytest.approx(0.474841, abs=1e-6)  # (0.691870 + 0.257813) / 2
    assert column(once.final.unfiltered, "score") == pytest.approx(0.128906, abs=1e-6)  # (0 + 0.257813) / 2
    assert column(once.final.filtered, "dac") == pytest.approx(0.75)  # (1 + 0.5) / 2
    # A second scenario, perfect in both stages: (x + 1) / 2
    perfect = Group(
        frame_scores(one_row(), one_row(), ec=1.0), np.zeros(2), columns_of(one_row(), np.ones(1)), np.zeros((1, 2))
    )
    twice = aggregate([(now, previous), (perfect, perfect)])
    assert column(twice.final.filtered, "score") == pytest.approx(0.737421, abs=1e-6)
    assert column(twice.final.unfiltered, "score") == pytest.approx(0.564453, abs=1e-6)
    # Stage one: (0.75 + 0.75 + 1 + 1) / 4 filtered, (0 + 0.75 + 1 + 1) / 4 unfiltered
    assert column(twice.stage_one.filtered, "score") == pytest.approx(0.875)
    assert column(twice.stage_one.unfiltered, "score") == pytest.approx(0.6875)
    # Stage two, over groups of weighted means: now 0.922494, previous (0 + 0.6875) / 2, perfect 1 and 1:
    # (0.922494 + 0.34375 + 1 + 1) / 4; EP (0.751979 + 1 + 1 + 1) / 4, DAC (1 + 0.5 + 1 + 1) / 4
    assert column(once.stage_two, "score") == pytest.approx(0.633122, abs=1e-6)  # (0.922494 + 0.34375) / 2
    assert column(twice.stage_two, "score") == pytest.approx(0.816561, abs=1e-6)
    assert column(twice.stage_two, "ep") == pytest.approx(0.937995, abs=1e-6)
    assert column(twice.stage_two, "dac") == pytest.approx(0.875)
    # The plain mean of the six follow-up rows is another number: (1 + 0.75 + 0 + 0.6875 + 1 + 1) / 6
    assert column(twice.follow_ups, "score") == pytest.approx(0.739583, abs=1e-6)
