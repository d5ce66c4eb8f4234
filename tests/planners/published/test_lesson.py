"""A training of ours goes as the public code's own went (see the records' origin).

`python -m experiments.parity <public checkout> --python <its interpreter> --what training --first 20 --cases ltf
diffusiondrive gtrs_dense --record tests/planners/published/recorded` writes the records anew.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planners.training.optim import learning_rate
from tests.planners.published.lesson import (
    LessonCurve,
    apart,
    differences_in_learning,
    learned,
    read_lesson,
)

RECORDS = Path(__file__).parent / "recorded"
FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")
TOLERANCE = 1e-4
HELD = 2  # steps of the record: one from the first weights, one from what that made of them


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
    ours = [
        learning_rate(lesson.training, i, lesson.steps, lesson.epoch_steps) for i in range(len(public.learned.rates))
    ]
    assert public.learned.rates == pytest.approx(np.broadcast_to(np.array(ours)[:, None], public.learned.rates.shape))
    assert (len(set(ours)) == 1) == (case == "ltf")


def test_a_curve_is_apart_by_its_largest_relative_difference_and_rates_are_held_too() -> None:
    rates = np.full((3, 1), 0.1)
    public = LessonCurve(np.array([1.0, 2.0, 4.0]), rates, {("a",): 2.0}, {})
    ours = LessonCurve(np.array([1.0, 2.1]), rates[:2] * [[1.0], [2.0]], {("a",): 2.0}, {})
    assert apart(public, ours) == pytest.approx([0.0, 0.05])
    gradients, of_rates, losses = differences_in_learning(public, ours)
    assert (gradients.largest, of_rates.largest, losses.largest) == pytest.approx((0.0, 1.0, 0.05))
    assert replace(losses, largest=9e-4).is_within(TOLERANCE) and not losses.is_within(TOLERANCE)
