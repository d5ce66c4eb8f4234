"""A training of ours goes as the public code's own went (see the records' origin).

`python -m planners parity <public checkout> python=<its interpreter> cases=[ltf,diffusiondrive,gtrs_dense] steps=200
first=20 record=tests/planners/published/recorded` writes the records anew.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.config.arguments import Refused, parse
from factory.config.compose import ConfigError
from planners.published.formula import first_weight
from planners.published.lesson import (
    BATCH,
    RECORDED,
    SAMPLES,
    LessonCurve,
    apart,
    differences_in_learning,
    learned,
    lesson_of,
    read_lesson,
    samples,
    write_beginning,
    write_lesson,
)
from planners.published.parity import Request, run_beside
from planners.training.optim import learning_rate

RECORDS = Path(__file__).parent / "recorded"
FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")
TOLERANCE = 1e-4
HELD = 6  # steps of the record, for a test of a quarter of a minute


@pytest.mark.slow
@pytest.mark.parametrize("case", FAMILIES)
def test_the_first_steps_of_a_training_are_the_public_code_s(case: str, tmp_path: Path) -> None:
    public = read_lesson(RECORDS / f"{case}_256x64_training.npz")
    ours = learned(public.lesson, public.names, HELD, tmp_path)
    rows = differences_in_learning(public.learned, ours)
    assert [row for row in rows if not row.is_within(TOLERANCE)] == []
    assert ours.optimiser == public.learned.optimiser
    assert len(ours.losses) == HELD and "SimScale commit f51ad645" in public.origin


@pytest.mark.parametrize("case", FAMILIES)
def test_rates_are_those_that_the_public_scheduler_set(case: str) -> None:
    public = read_lesson(RECORDS / f"{case}_256x64_training.npz")
    lesson = public.lesson
    ours = [learning_rate(lesson.training, i, lesson.steps, lesson.epoch_steps) for i in range(RECORDED)]
    assert public.learned.rates == pytest.approx(np.broadcast_to(np.array(ours)[:, None], public.learned.rates.shape))
    assert (len(set(ours)) == 1) == (case == "ltf")


def test_each_sample_comes_once_before_any_comes_again() -> None:
    order = lesson_of("ltf", (64, 64), 100, 1e-5, False).order
    assert order.shape == (100, BATCH)
    rounds = order.reshape(-1, SAMPLES)
    assert (np.sort(rounds, axis=1) == np.arange(SAMPLES)).all() and not (rounds[0] == rounds[1]).all()


def test_each_sample_has_one_vehicle_ahead() -> None:
    given = samples((64, 64))
    assert (given["agents_valid"].sum(axis=1) == 1).all()
    x, y = given["agents"][:, 0, 0], given["agents"][:, 0, 1]
    assert (x >= 1.0).all() and (np.abs(np.arctan2(y, x)) < 4 * np.pi / 9).all()


def test_first_weights_are_of_the_kind_that_the_public_code_draws() -> None:
    assert not first_weight("_backbone.lidar_encoder.layer1.0.bn2.weight", (64,)).any()
    assert (first_weight("_backbone.lidar_encoder.layer1.0.bn1.weight", (64,)) == 1.0).all()
    assert first_weight("_backbone.transformers.0.blocks.0.attn.key.weight", (64, 64)).std() == pytest.approx(
        0.02, rel=0.05
    )
    assert first_weight("_status_encoding.weight", (256, 300)).std() == pytest.approx((3 * 300) ** -0.5, rel=0.05)
    assert first_weight("_query_embedding.weight", (31, 256)).std() == pytest.approx(1.0, rel=0.05)
    assert not first_weight("_backbone.transformers.0.pos_emb", (1, 320, 64)).any()


def test_a_curve_is_apart_by_its_largest_relative_difference_and_rates_are_held_too() -> None:
    rates = np.full((3, 1), 0.1)
    public = LessonCurve(np.array([1.0, 2.0, 4.0]), rates, {("a",): 2.0}, {})
    ours = LessonCurve(np.array([1.0, 2.1]), rates[:2] * [[1.0], [2.0]], {("a",): 2.0}, {})
    assert apart(public, ours) == pytest.approx([0.0, 0.05])
    gradients, of_rates, losses = differences_in_learning(public, ours)
    assert (gradients.largest, of_rates.largest, losses.largest) == pytest.approx((0.0, 1.0, 0.05))
    assert replace(losses, largest=9e-4).is_within(TOLERANCE) and not losses.is_within(TOLERANCE)


def test_what_cannot_be_compared_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="steps=150: the 100 epochs of ltf_public do not divide it"):
        lesson_of("ltf", (64, 64), 150, 1e-5, False)
    rates = np.array([[0.1, 0.2]])
    two = LessonCurve(np.array([1.0]), rates, {("a",): 1.0}, {})
    with pytest.raises(ConfigError, match="groups of other rates"):
        differences_in_learning(two, two)
    np.savez(tmp_path / "a.npz", told=np.array("{}"))
    with pytest.raises(ConfigError, match="no record of a public training"):
        read_lesson(tmp_path / "a.npz")
    (tmp_path / "navsim" / "agents").mkdir(parents=True)
    with pytest.raises(Refused, match="first=300: must be within the 200 steps"):
        parse(Request, [str(tmp_path), "python=python", "steps=200", "first=300"])
    with pytest.raises(Refused, match=r"could not run the ltf of .*No module named"):
        run_beside(Request(str(tmp_path), sys.executable), "targets_beside", [str(tmp_path / "b")], "ltf", tmp_path)


def test_a_lesson_is_written_for_the_steps_asked_for_and_a_record_keeps_its_beginning(tmp_path: Path) -> None:
    lesson = lesson_of("ltf", (64, 64), 200, 1e-5, False)
    write_lesson(lesson, tmp_path / "lesson.npz", 30)
    with np.load(tmp_path / "lesson.npz") as given:
        assert given["order"].shape == (30, BATCH) and (given["seeds"] == lesson.seeds).all()
    np.savez(tmp_path / "said.npz", losses=np.arange(30.0), rates=np.ones((30, 2)), gradients=np.arange(40.0))
    write_beginning(tmp_path / "said.npz", tmp_path / "kept" / "it.npz")
    with np.load(tmp_path / "kept" / "it.npz") as kept:
        assert kept["losses"].tolist() == list(range(RECORDED)) and kept["rates"].shape == (RECORDED, 2)
        assert len(kept["gradients"]) == 40
