"""Intervals with closed forms, over clips and seeds; two runs compared through their rows."""

from dataclasses import replace

import numpy as np
import pytest

from planners.evaluation.aggregation import (
    ClipResult,
    collect_scores,
    group_by_clip,
    summarise,
    summary_lines,
    total_score,
)
from planners.evaluation.bootstrap import paired_interval
from planners.evaluation.compare import (
    CompareSettings,
    compare,
    comparison_text,
    difference_columns,
    is_clear,
)
from planners.evaluation.score_rows import FrameRow
from tests.planners.made_rows import clip_rows

SETTINGS = CompareSettings(a="", b="", draws=500)


def scores(n_seeds: int, n_clips: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(n_seeds, n_clips))


def test_a_run_does_not_differ_from_itself() -> None:
    for n_seeds in (1, 3):
        found = paired_interval(scores(n_seeds, 20), scores(n_seeds, 20), draws=300)
        assert (found.difference, found.low, found.high) == (0.0, 0.0, 0.0)
        assert not found.is_clear


def test_a_constant_shift_is_found_exactly() -> None:
    a = scores(2, 30)
    found = paired_interval(a, a + 0.125, draws=300)
    np.testing.assert_allclose([found.difference, found.low, found.high], 0.125, atol=1e-12)
    assert found.is_clear


def test_the_interval_of_a_mean_is_that_of_the_normal_law() -> None:
    # differences +-1 in equal parts: the mean of n draws has standard deviation 1 / sqrt(n)
    n = 400
    b = np.tile([1.0, -1.0], n // 2)[None]
    found = paired_interval(np.zeros((1, n)), b, draws=20_000)
    assert found.difference == 0.0
    np.testing.assert_allclose([found.low, found.high], [-1.96 / np.sqrt(n), 1.96 / np.sqrt(n)], rtol=0.05)
    narrower = paired_interval(np.zeros((1, n)), b, draws=20_000, confidence=0.6827)
    np.testing.assert_allclose([narrower.low, narrower.high], [-1.0 / np.sqrt(n), 1.0 / np.sqrt(n)], rtol=0.1)


def test_noise_that_both_share_does_not_widen_a_paired_interval() -> None:
    shared = 10.0 * scores(1, 50)
    found = paired_interval(shared, shared + 0.1 + 0.01 * scores(1, 50, 1), draws=500)
    assert 0.1 <= found.low < found.high <= 0.11


def test_seeds_widen_the_interval_where_trainings_differ() -> None:
    # every clip alike, three trainings 0, 1, 2 better: only the draw of seeds moves the mean
    a = np.zeros((3, 40))
    b = np.repeat([[0.0], [1.0], [2.0]], 40, axis=1)
    paired = paired_interval(a, b, draws=4000)
    assert paired.difference == 1.0 and paired.low == 0.0 and paired.high == 2.0  # all draws the same: 2 / 27 > 2.5 %
    alone = paired_interval(a[:1], b, draws=4000)  # other numbers of trainings: each side draws by itself
    assert alone.difference == 1.0 and alone.low == 0.0 and alone.high == 2.0
    assert paired_interval(a[:1], b[1:2], draws=100).low == 1.0


def test_weights_count_a_clip_as_often_as_it_has_frames() -> None:
    a, b = np.zeros((1, 2)), np.array([[1.0, 4.0]])
    weights = np.array([[2.0, 1.0]])
    found = paired_interval(a, b, weights=(weights, weights), draws=2000)
    assert found.difference == pytest.approx(2.0)  # (2 * 1 + 1 * 4) / 3
    assert (found.low, found.high) == (1.0, 4.0)  # a quarter of the draws hold one clip alone


def test_over_many_clusters_of_one_clip_each_the_interval_is_that_over_clips() -> None:
    a, b = scores(3, 400), scores(3, 400, 1)
    alone = paired_interval(a, b, draws=2000)
    within = paired_interval(a, b, clusters=[f"log{i}" for i in range(400)], draws=2000)
    assert within.low <= alone.low < alone.high <= within.high
    assert within.high - within.low == pytest.approx(alone.high - alone.low, rel=0.02)


def test_clips_that_are_alike_within_a_cluster_count_as_one() -> None:
    # 5 copies of each of 20 clips: over clips the interval shrinks by sqrt(5), over clusters it stays what it was
    one = scores(1, 20, 1) - 0.5
    copies = np.repeat(one, 5, axis=1)
    names = np.repeat(np.arange(20), 5).tolist()
    zeros, zeros_of_copies = np.zeros_like(one), np.zeros_like(copies)
    over_one = paired_interval(zeros, one, clusters=range(20), draws=4000)
    over_clips = paired_interval(zeros_of_copies, copies, draws=4000)
    over_clusters = paired_interval(zeros_of_copies, copies, clusters=names, draws=4000)
    width = over_one.high - over_one.low
    assert over_clusters.high - over_clusters.low == pytest.approx(width, rel=1e-9)
    assert over_clips.high - over_clips.low == pytest.approx(width / np.sqrt(5.0), rel=0.15)


def test_over_few_clusters_the_interval_is_students() -> None:
    # two clips in each of six towns, which are 1 .. 6 better: 3.5 +- 2.5706 (t, five degrees) * sqrt(3.5 / 6)
    b = np.repeat(np.arange(1.0, 7.0), 2)[None]
    towns = np.repeat(list("uvwxyz"), 2).tolist()
    found = paired_interval(np.zeros_like(b), b, clusters=towns, draws=3000)
    half = 2.570582 * np.sqrt(3.5 / 6.0)
    np.testing.assert_allclose([found.difference, *found.student], [3.5, 3.5 - half, 3.5 + half], rtol=1e-6)
    assert found.low <= found.student[0] and found.high >= found.student[1]


def test_an_interval_of_shares_does_not_leave_them() -> None:
    b = np.array([[1.0, *[0.0] * 7]])
    found = paired_interval(np.zeros_like(b), b, clusters=range(8), draws=500)
    assert found.student == (0.0, pytest.approx(0.125 * (1.0 + 2.364624)))
    assert found.low == 0.0 and found.high <= 1.0
    assert paired_interval(np.zeros_like(b), 1.0 - b, clusters=range(8), draws=500).high == 1.0


def test_of_one_cluster_there_is_no_interval() -> None:
    found = paired_interval(scores(2, 8), scores(2, 8) + 1.0, clusters=["log"] * 8, draws=100)
    assert found.difference == pytest.approx(1.0)
    assert np.isnan([found.low, found.high]).all() and not found.is_clear


def test_clusters_are_named_for_every_clip() -> None:
    with pytest.raises(ValueError, match="one for each of 5 clips, got 4"):
        paired_interval(scores(1, 5), scores(1, 5), clusters=["a"] * 4)


def test_a_seed_decides_the_draws() -> None:
    a, b = scores(2, 30), scores(2, 30, 1)
    first = paired_interval(a, b, draws=300, seed=4)
    assert first == paired_interval(a, b, draws=300, seed=4)
    assert first != paired_interval(a, b, draws=300, seed=5)
    mirrored = paired_interval(b, a, draws=300, seed=4)
    np.testing.assert_allclose([mirrored.low, mirrored.high], [-first.high, -first.low], atol=1e-12)


def test_nonsense_is_refused() -> None:
    good = scores(1, 5)
    with pytest.raises(ValueError, match="same clips"):
        paired_interval(good, scores(1, 6))
    with pytest.raises(ValueError, match="not numbers"):
        paired_interval(good, np.full((1, 5), np.nan))
    with pytest.raises(ValueError, match="confidence"):
        paired_interval(good, good, confidence=1.0)
    with pytest.raises(ValueError, match="weights of b"):
        paired_interval(good, good, weights=(np.ones((1, 5)), np.zeros((1, 5))))


def run(bonus: float = 0.0, n_clips: int = 6) -> list[ClipResult]:
    """Clips whose plans all end on their follow-ups, so that every weight is known."""
    return group_by_clip([row for i in range(n_clips) for row in clip_of(i, bonus)])


def clip_of(i: int, bonus: float = 0.0) -> list[FrameRow]:
    base = 0.1 * i + bonus
    follow_ups = [((base, base + 0.2), (0.0, 0.0), (0.0, 0.0))] * (1 + i % 2)
    log_id = f"town-{i // 4}-{i // 2:04d}-curve"  # two clips a log, two logs a town
    return clip_rows(f"clip{i}", base, (1.0, 1.0), ((0.0, 0.0), (0.0, 0.0)), follow_ups, log_id)


def test_runs_are_compared_in_every_stage() -> None:
    found = compare([run()], [run(0.25)], SETTINGS)
    assert list(found) == [
        ("one_stage", "unfiltered"),
        ("one_stage", "filtered"),
        ("stage_one", "unfiltered"),
        ("stage_one", "filtered"),
        ("stage_two", "none"),
        ("follow_ups", "none"),
        ("final", "unfiltered"),
        ("final", "filtered"),
    ]
    for name, by_level in found.items():
        expected = 0.0 if name[0] == "stage_one" else 0.25
        for interval in by_level.values():
            np.testing.assert_allclose([interval.difference, interval.low, interval.high], expected, atol=1e-12)
    assert "unfiltered compares with the paper's tables" in comparison_text(found, 0.95)


def test_means_over_clips_are_those_of_the_table() -> None:
    found = collect_scores([run()], "score")
    means = {name: (one.scores * one.weights).sum() / one.weights.sum() for name, one in found.items()}
    for line in summary_lines("run", summarise([row for clip in range(6) for row in clip_of(clip)])):
        assert means[line.stage, line.human_filter] == pytest.approx(total_score(line.columns))
    values = [0.1 * i + 0.1 for i in range(6)]
    assert means["stage_two", "none"] == pytest.approx(sum(values) / 6)  # a clip has two groups
    assert means["follow_ups", "none"] == pytest.approx(sum(v * (1 + i % 2) for i, v in enumerate(values)) / 9)


def test_runs_are_compared_over_clips_logs_and_towns() -> None:
    a, b = run(n_clips=8), [*run(n_clips=4), *run(0.3, n_clips=8)[4:]]  # the second town alone is better
    found = compare([a], [b], SETTINGS)["final", "unfiltered"]
    assert list(found) == ["clip", "log", "town"]
    clip, log, town = ((one.low, one.high) for one in found.values())
    assert town[0] < log[0] < 0.0 < clip[0] and town[1] > log[1] > clip[1]
    of_one_town = compare([run(n_clips=4)], [run(0.1, n_clips=4)], SETTINGS)
    assert np.isnan(of_one_town["final", "unfiltered"]["town"].low)
    assert not is_clear(of_one_town["final", "unfiltered"])
    assert "only one" in comparison_text(of_one_town, 0.95)
    row = difference_columns(of_one_town["final", "unfiltered"])
    assert row["low_town"] == row["high_town"] == "" and row["low_log"] != ""


def test_runs_of_unknown_logs_are_compared_over_clips_and_it_is_said() -> None:
    unknown = [[replace(clip, log_id="") for clip in run()]]
    found = compare(unknown, unknown, SETTINGS)
    assert {tuple(by_level) for by_level in found.values()} == {("clip",)}
    assert "do not say which log" in comparison_text(found, 0.95)


def test_other_clips_are_not_compared() -> None:
    with pytest.raises(ValueError, match="clip5"):
        compare([run()], [run(n_clips=5)], SETTINGS)
    with pytest.raises(ValueError, match="clip0"):
        compare(
            [run()], [[replace(clip, groups=None) if clip.clip_id == "clip0" else clip for clip in run()]], SETTINGS
        )
