"""Intervals with closed forms, over clips and seeds; two runs compared through their rows."""

from dataclasses import replace

import numpy as np
import pytest

from planners.aggregation import ClipResult, by_clip, lines_of, score_of, summarise
from planners.bootstrap import paired_interval
from planners.compare import CompareSettings, compare, text_of
from planners.measured import measured
from planners.score_rows import FrameRow
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
    return by_clip([row for i in range(n_clips) for row in clip_of(i, bonus)])


def clip_of(i: int, bonus: float = 0.0) -> list[FrameRow]:
    base = 0.1 * i + bonus
    follow_ups = [((base, base + 0.2), (0.0, 0.0), (0.0, 0.0))] * (1 + i % 2)
    return clip_rows(f"clip{i}", base, (1.0, 1.0), ((0.0, 0.0), (0.0, 0.0)), follow_ups)


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
    for name, interval in found.items():
        expected = 0.0 if name[0] == "stage_one" else 0.25
        np.testing.assert_allclose([interval.difference, interval.low, interval.high], expected, atol=1e-12)
    assert "unfiltered compares with the paper's tables" in text_of(found, 0.95)


def test_means_over_clips_are_those_of_the_table() -> None:
    found = measured([run()], "score")
    means = {name: (one.scores * one.weights).sum() / one.weights.sum() for name, one in found.items()}
    for line in lines_of("run", summarise([row for clip in range(6) for row in clip_of(clip)])):
        assert means[line.stage, line.human_filter] == pytest.approx(score_of(line.columns))
    values = [0.1 * i + 0.1 for i in range(6)]
    assert means["stage_two", "none"] == pytest.approx(sum(values) / 6)  # a clip has two groups
    assert means["follow_ups", "none"] == pytest.approx(sum(v * (1 + i % 2) for i, v in enumerate(values)) / 9)


def test_other_clips_are_not_compared() -> None:
    with pytest.raises(ValueError, match="clip5"):
        compare([run()], [run(n_clips=5)], SETTINGS)
    with pytest.raises(ValueError, match="clip0"):
        compare(
            [run()], [[replace(clip, groups=None) if clip.clip_id == "clip0" else clip for clip in run()]], SETTINGS
        )
