"""Two clips, three follow-ups, weights on paper: through the rows, their files and the summary."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planners.evaluation.aggregation import group_by_clip, summarise, summary_lines, total_score
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, read_rows, write_rows
from tasks.reward.aggregate import COLUMNS, FrameScores
from tests.planners.made_rows import clip_rows, row

SCORE = COLUMNS.index("score")


def two_clips() -> list[FrameRow]:
    """Clip a: two follow-ups, near; clip b: one, far away, so it weighs 1 anyway.

    a now:    the plan ends at (10, 0); follow-ups start at (10, 0) and (10, 0.5): d^2 = 0, 0.25;
              weights 1 and exp(-0.25 / 0.2) = 0.286505, normalised 0.777300 and 0.222700
              0.8 * (0.777300 * 1.0 + 0.222700 * 0.5) = 0.8 * 0.888650 = 0.710920
    a before: ends at (5, 0), starts at (9, 0) and (9, 1), all beyond 1.92 m: uniform
              0.6 * (0.4 + 0.2) / 2 = 0.18
    a:        (0.710920 + 0.18) / 2 = 0.445460
    b:        now 1.0 * 0.3 = 0.3, before 0.5 * 0.7 = 0.35: 0.325
    final:    (0.445460 + 0.325) / 2 = 0.385230
    """
    a = clip_rows(
        "a",
        0.9,
        (0.8, 0.6),
        ((10.0, 0.0), (5.0, 0.0)),
        [((1.0, 0.4), (10.0, 0.0), (9.0, 0.0)), ((0.5, 0.2), (10.0, 0.5), (9.0, 1.0))],
    )
    b = clip_rows("b", 0.7, (1.0, 0.5), ((0.0, 0.0), (0.0, 0.0)), [((0.3, 0.7), (30.0, 0.0), (1.0, 0.0))])
    return [*a, *b]


def test_two_clips_and_three_follow_ups_add_up_as_on_paper() -> None:
    summary = summarise(two_clips())
    assert summary.two_stage is not None
    assert total_score(summary.one_stage.unfiltered) == pytest.approx(0.8)  # (0.9 + 0.7) / 2
    assert total_score(summary.two_stage.stage_one.filtered) == pytest.approx(0.725)  # (0.8 + 0.6 + 1 + 0.5) / 4
    # groups: a now 0.888650, a before (0.4 + 0.2) / 2, b 0.3 and 0.7
    assert total_score(summary.two_stage.stage_two) == pytest.approx((0.888650 + 0.3 + 0.3 + 0.7) / 4, abs=1e-6)
    assert total_score(summary.two_stage.follow_ups) == pytest.approx(3.1 / 6)  # of 1, 0.4, 0.5, 0.2, 0.3, 0.7
    assert total_score(summary.two_stage.final.filtered) == pytest.approx(0.385230, abs=1e-6)
    assert (summary.n_clips, summary.n_two_stage, summary.n_follow_ups) == (2, 2, 3)
    clip_a = group_by_clip(two_clips())[0].two_stage
    assert clip_a is not None
    assert total_score(clip_a.final.filtered) == pytest.approx(0.445460, abs=1e-6)


def test_every_column_is_aggregated_alike() -> None:
    final = summarise(two_clips()).two_stage
    assert final is not None
    np.testing.assert_allclose(final.final.filtered, final.final.filtered[SCORE])


def test_the_share_of_clips_in_the_uniform_fallback_is_counted() -> None:
    summary = summarise(two_clips())
    assert summary.uniform_share == 0.5  # b: 30 m away; a is near
    assert summary.uniform_share_before == 0.5  # a: 4 m away; b is 1 m away
    lines = summary_lines("mine", summary)
    assert [(line.stage, line.human_filter, line.n_frames) for line in lines] == [
        ("one_stage", "unfiltered", 2),
        ("one_stage", "filtered", 2),
        ("stage_one", "unfiltered", 4),
        ("stage_one", "filtered", 4),
        ("stage_two", "none", 6),
        ("follow_ups", "none", 6),
        ("final", "unfiltered", 10),
        ("final", "filtered", 10),
    ]
    assert [line.uniform_share for line in lines[-2:]] == [0.5, 0.5]
    assert all(math.isnan(line.uniform_share) for line in lines[:-2])


def test_the_filter_reaches_the_final_score_through_stage_one() -> None:
    rows = two_clips()
    forgiven = FrameScores(np.zeros(len(COLUMNS)), np.ones(len(COLUMNS)))
    rows[1] = replace(rows[1], scores=forgiven)  # stage one of a now: 0, or 1 with the filter
    final = summarise(rows).two_stage
    assert final is not None
    assert total_score(final.final.unfiltered) == pytest.approx(((0.0 + 0.18) / 2 + 0.325) / 2)
    assert total_score(final.final.filtered) == pytest.approx(((0.888650 + 0.18) / 2 + 0.325) / 2, abs=1e-6)


def test_the_order_of_rows_and_clips_changes_nothing() -> None:
    rows = two_clips()
    expected = [line.columns for line in summary_lines("mine", summarise(rows))]
    for seed in range(5):
        shuffled = [rows[i] for i in np.random.default_rng(seed).permutation(len(rows))]
        for line, columns in zip(summary_lines("mine", summarise(shuffled)), expected):
            np.testing.assert_array_equal(line.columns, columns)


def test_rows_come_back_from_their_file_as_they_were(tmp_path: Path) -> None:
    rows = [replace(r, tags=("turning", "slow"), weight=0.25) for r in two_clips()]
    write_rows(tmp_path, rows)
    for mine, stored in zip(rows, read_rows(tmp_path)):
        assert (mine.stage, mine.key, mine.tags, mine.weight) == (stored.stage, stored.key, stored.tags, stored.weight)
        for name in ("start", "end"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(stored, name))
        np.testing.assert_array_equal(mine.scores.filtered, stored.scores.filtered)
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 1 + len(rows)


def test_a_planner_without_plans_in_stage_two_has_no_final_score() -> None:
    rows = [r if r.stage != "stage_two" else row(r.stage, r.key, np.nan, start=tuple(r.start[:2])) for r in two_clips()]
    two = summarise(rows).two_stage
    assert two is not None
    assert np.isnan(two.stage_two).all() and np.isnan(two.follow_ups).all() and np.isnan(two.final.filtered).all()
    assert total_score(two.stage_one.filtered) == pytest.approx(0.725)


def test_clips_without_follow_ups_count_in_one_stage_only() -> None:
    alone = clip_rows("c", 0.2, (0.0, 0.0), ((0.0, 0.0), (0.0, 0.0)), [])
    with_c, without = summarise([*two_clips(), *alone]), summarise(two_clips())
    assert total_score(with_c.one_stage.unfiltered) == pytest.approx(0.6)
    assert with_c.two_stage is not None and without.two_stage is not None
    np.testing.assert_array_equal(with_c.two_stage.final.filtered, without.two_stage.final.filtered)
    assert summarise(alone).two_stage is None


def test_a_lacking_or_doubled_frame_is_named() -> None:
    rows = two_clips()
    with pytest.raises(ValueError, match="clip a, frame follow_up_before 1: no row in stage_two"):
        summarise([r for r in rows if r.key != FrameKey.follow_up("a", 1)[1]])
    with pytest.raises(ValueError, match="clip a, frame human: two rows in one_stage"):
        summarise([*rows, rows[0]])
    with pytest.raises(ValueError, match="clip b: no row"):
        summarise([r for r in rows if not (r.stage == "one_stage" and r.key.clip_id == "b")])
    with pytest.raises(ValueError, match="no frame"):
        summarise([])
