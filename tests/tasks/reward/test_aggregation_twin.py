"""Score formula, human-penalty filter and both aggregations equal their slow twins, one number at a time."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.reward.aggregate import (
    COLUMNS,
    FrameScores,
    Group,
    aggregate,
    columns_of,
    follow_up_weights,
    frame_scores,
    group_scores,
    means_of,
)
from tasks.reward.epdms import Normalise, Scores, human_filtered, relative_progress
from tests.tasks.reward.slow import aggregation as slow

BRIEF = settings(max_examples=50)
HALVES, WHOLES = st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.0, 1.0])
ROWS = st.fixed_dictionaries(
    dict.fromkeys(("nc", "ddc"), HALVES)
    | dict.fromkeys(("dac", "tlc", "ttc", "lk", "hc"), WHOLES)
    | {"ep": st.floats(0.0, 1.0)}
)
COMFORT = st.sampled_from([0.0, 1.0, np.nan])
FRAMES = st.tuples(ROWS, st.none() | ROWS, COMFORT)
METRES = st.floats(0.0, 60.0) | st.sampled_from([5.0, np.nextafter(5.0, 0.0), np.nextafter(5.0, 9.0)])
PLACES = st.tuples(st.floats(-3.0, 3.0) | st.sampled_from([0.0, 1.9, 1.95, np.nan, 1e6]), st.sampled_from([0.0, 0.1]))


def scores_of(rows: list[slow.Row]) -> Scores:
    made = {field.name: np.zeros(len(rows)) for field in fields(Scores)}
    return Scores(**made | {name: np.array([row[name] for row in rows]) for name in slow.SUB_SCORES})


def frame_of(row: slow.Row, human: slow.Row | None, ec: float) -> FrameScores:
    perfect = scores_of([dict.fromkeys(slow.SUB_SCORES, 1.0)])  # its filter changes nothing but adds the score up
    scored = human_filtered(scores_of([row]), perfect)
    return frame_scores(scored, None if human is None else scores_of([human]), ec)


def assert_same(ours: NDArray[np.float64], theirs: slow.Columns) -> None:
    np.testing.assert_allclose(ours, [theirs[name] for name in COLUMNS], rtol=0, atol=1e-12)


def assert_both_same(ours: FrameScores, unfiltered: slow.Columns, filtered: slow.Columns) -> None:
    assert_same(ours.unfiltered, unfiltered)
    assert_same(ours.filtered, filtered)


@BRIEF
@given(plans=st.lists(st.tuples(ROWS, COMFORT), min_size=1, max_size=5), human=ROWS)
def test_the_filter_and_the_final_score_are_those_of_each_row(
    plans: list[tuple[slow.Row, float]], human: slow.Row
) -> None:
    filtered = human_filtered(scores_of([row for row, _ in plans]), scores_of([human]))
    for columns, (row, ec) in zip(columns_of(filtered, np.array([ec for _, ec in plans])), plans):
        assert_same(columns, slow.frame(row, human, ec)[1])


@BRIEF
@given(
    rows=st.lists(st.tuples(METRES, st.sampled_from([0.0, 0.25, 0.5, 1.0])), min_size=1, max_size=5),
    normalise=st.sampled_from(["batch", "pairs"]),
)
def test_progress_is_relative_row_by_row(rows: list[tuple[float, float]], normalise: Normalise) -> None:
    metres, multipliers = np.array(rows).T
    ours = relative_progress(metres, multipliers, normalise == "pairs")
    assert ours.tolist() == slow.relative_progress(*zip(*rows), normalise)


@BRIEF
@given(frames=st.lists(FRAMES, min_size=1, max_size=4))
def test_one_stage_means_are_those_of_each_column(frames: list[tuple[slow.Row, slow.Row | None, float]]) -> None:
    unfiltered, filtered = zip(*(slow.frame(*frame) for frame in frames))
    assert_both_same(means_of([frame_of(*frame) for frame in frames]), slow.means(unfiltered), slow.means(filtered))


@BRIEF
@given(end=PLACES, starts=st.lists(PLACES, min_size=1, max_size=5))
@example(end=(0.0, 0.0), starts=[(1.9193, 0.0), (5.0, 0.0)])  # exp(-1.9193^2 / 0.2) = 1.002e-8, just a weight
@example(end=(0.0, 0.0), starts=[(1.9195, 0.0), (5.0, 0.0)])  # 0.998e-8, none
def test_follow_up_weights_are_those_of_each_distance(
    end: tuple[float, float], starts: list[tuple[float, float]]
) -> None:
    ours = follow_up_weights(np.array(end), np.array(starts))
    np.testing.assert_allclose(ours, slow.follow_up_weights(end, starts), rtol=0, atol=1e-12)


GROUPS = st.tuples(FRAMES, PLACES, st.lists(st.tuples(ROWS, COMFORT, PLACES), min_size=1, max_size=3))


@BRIEF
@given(scenarios=st.lists(st.tuples(GROUPS, GROUPS), min_size=1, max_size=3))
def test_two_stage_scores_are_those_of_each_number(scenarios: list[tuple[tuple, tuple]]) -> None:
    ours = aggregate([(group_of(*now), group_of(*before)) for now, before in scenarios])
    firsts = [slow.frame(*group[0]) for pair in scenarios for group in pair]
    seconds = [slow.frame(row, None, ec)[0] for pair in scenarios for group in pair for row, ec, _ in group[2]]
    assert_both_same(ours.stage_one, *(slow.means(columns) for columns in zip(*firsts)))
    assert_same(ours.stage_two, slow.means([slow_stage_two(*group) for pair in scenarios for group in pair]))
    assert_same(ours.follow_ups, slow.plain_means(seconds))
    pairs = [[slow_group(*group) for group in pair] for pair in scenarios]
    for both, which in ((ours.final.unfiltered, 0), (ours.final.filtered, 1)):
        assert_same(both, slow.means([slow.means([group[which] for group in pair]) for pair in pairs]))


def group_of(frame: tuple, end: tuple[float, float], follow_ups: list[tuple]) -> Group:
    after = np.stack([frame_of(row, None, ec).unfiltered for row, ec, _ in follow_ups])
    return Group(frame_of(*frame), np.array(end), after, np.array([start for _, _, start in follow_ups]))


def slow_group(frame: tuple, end: tuple[float, float], follow_ups: list[tuple]) -> list[slow.Columns]:
    """Unfiltered, filtered."""
    return [slow.group(columns, *slow_follow_ups(end, follow_ups)) for columns in slow.frame(*frame)]


def slow_stage_two(_frame: tuple, end: tuple[float, float], follow_ups: list[tuple]) -> slow.Columns:
    return slow.weighted(*slow_follow_ups(end, follow_ups))


def slow_follow_ups(end: tuple[float, float], follow_ups: list[tuple]) -> tuple[list[float], list[slow.Columns]]:
    """Weights, columns."""
    weights = slow.follow_up_weights(end, [start for _, _, start in follow_ups])
    return weights, [slow.frame(row, None, ec)[0] for row, ec, _ in follow_ups]


def test_frames_to_score_are_one_plan_each_and_a_group_has_follow_ups() -> None:
    one, two = (scores_of([dict.fromkeys(slow.SUB_SCORES, 1.0)] * n) for n in (1, 2))
    with pytest.raises(ValueError, match="scores must be one row"):
        frame_scores(two, None)
    with pytest.raises(ValueError, match="human must be one row"):
        frame_scores(one, two)
    with pytest.raises(ValueError, match="frames"):
        means_of([])
    with pytest.raises(ValueError, match="follow-up"):
        group_scores(Group(frame_scores(one, None), np.zeros(2), np.zeros((0, len(COLUMNS))), np.zeros((0, 2))))
    with pytest.raises(ValueError, match="nothing"):
        aggregate([])
