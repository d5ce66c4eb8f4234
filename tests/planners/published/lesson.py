"""A short training that the public code and ours go through alike, and our half of it.

Both begin from the weights of formula.py, see the same samples in the same batches, and draw what a model draws itself
(noise, halves of a vocabulary) from the same seed in every step. Ours is planners.training.fit with the training of
conf/planner/<case>_public.yaml; theirs that of experiments/parity/beside.py.
"""

import csv
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from factory.config.compose import ConfigError
from factory.exits import Stopped
from planners.data.batch import Batch
from planners.published.import_planner import import_weights
from planners.training.callbacks import LOSSES
from planners.training.fit import StepSettings, fit, step_seed
from planners.training.optim import FACTOR, TrainingSettings, build_optimiser
from planners.training.processes import TrainingProcess
from tasks.world.arrays import Array
from tests.planners.published.formula import AGENTS, Doubled, drawn, first_weight, inputs, told_of
from tests.planners.published.ours import (
    Difference,
    batch_of,
    formula_weights,
    gradient_difference,
    gradient_norms,
    preset,
    preset_entry,
)

SAMPLES, BATCH = 8, 2
SEED = 0
ROUNDING_OF_CURVES = 10.0  # 1e-3 of a loss at a tolerance of 1e-4


@dataclass(frozen=True)
class Lesson:
    """What is trained on, and by which settings."""

    case: str
    picture: tuple[int, int]  # width, height
    training: TrainingSettings
    epoch_steps: int  # batches in an epoch, so that `steps` are all of the training's epochs
    steps: int
    double: bool  # in float64, in which rounding is too small to tell

    @property
    def order(self) -> NDArray[np.int64]:
        """(steps, BATCH) int64: samples of every batch; each comes once before any comes again."""
        rounds = -(-self.steps * BATCH // SAMPLES)
        rows = [np.argsort(drawn(f"order {i}", (SAMPLES,)), kind="stable").astype(np.int64) for i in range(rounds)]
        return np.concatenate(rows)[: self.steps * BATCH].reshape(-1, BATCH)

    @property
    def seeds(self) -> Array:
        """(steps,) int64: what `fit` seeds its steps with."""
        return np.array([step_seed(SEED, step, 0) for step in range(self.steps)])


def lesson_of(case: str, picture: tuple[int, int], steps: int, rate: float, double: bool) -> Lesson:
    """All epochs of a preset's training in `steps` steps. Raises ConfigError where they do not divide."""
    training = preset_entry(case, picture).training
    assert training is not None
    training = replace(training, learning_rate=rate)
    if steps % training.epochs:
        raise ConfigError(f"steps={steps}: the {training.epochs} epochs of {case}_public do not divide it")
    return Lesson(case, picture, training, steps // training.epochs, steps, double)


def samples(picture: tuple[int, int]) -> dict[str, Any]:
    """SAMPLES of the formula's, each with one vehicle, ahead, to be found.

    Predictions and vehicles are matched at the least sum of |x| + |y| apart, which two of them make either way round
    where both predictions lie on one side of both vehicles: rounding would say whose heading and size is learnt.
    """
    given = inputs(*picture, SAMPLES)
    given["agents_valid"][:] = np.arange(AGENTS) == 0
    given["agents"][:, 0, 0] = 1.0 + np.abs(given["agents"][:, 0, 0])
    given["agents"][:, 0, 1] *= 0.1
    return given


@dataclass(frozen=True)
class LessonCurve:
    """How a training went."""

    losses: Array  # (n,) float64, of the first n steps
    rates: Array  # (n, groups)
    gradients: Mapping[tuple[str, ...], float]  # of the first step: public matrices -> norm
    optimiser: dict[str, Any]  # see formula.told_of


@dataclass(frozen=True)
class PublicLesson:
    """How it went there, as experiments.parity writes it."""

    lesson: Lesson
    learned: LessonCurve
    names: dict[str, list[int]]  # of its weights, with their shapes
    origin: str


def read_lesson(path: Path) -> PublicLesson:
    """A file of experiments.parity."""
    with np.load(path, allow_pickle=False) as stored:
        told = json.loads(str(stored["told"]))
        losses, rates, norms = stored["losses"], stored["rates"], stored["gradients"]
    width, height = told["picture"]
    lesson = lesson_of(told["case"], (width, height), told["steps"], told["rate"], told["double"])
    gradients: dict[tuple[str, ...], float] = {(name,): float(norm) for name, norm in zip(told["matrices"], norms)}
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    learned = LessonCurve(losses, rates, gradients, told["optimiser"])
    return PublicLesson(lesson, learned, told["names"], f"{told['code']} ({versions})")


def learned(lesson: Lesson, names: Mapping[str, list[int]], first: int, out: Path) -> LessonCurve:
    """Our first `first` steps of a lesson, from the public weights of these names; files go under `out`."""
    given = samples(lesson.picture)
    planner_like = preset(lesson.case, lesson.picture)
    mode: AbstractContextManager[Any] = Doubled() if lesson.double else nullcontext()
    with mode:
        found = import_weights(planner_like, formula_weights(names, given, first_weight), f"the public {lesson.case}")
        batches = _Batches(lesson, first)
        if lesson.double:
            found.planner.double()
        torch.manual_seed(int(lesson.seeds[0]))
        gradients = gradient_norms(found, batches.at(0))
        optimiser = told_of(build_optimiser(lesson.training, found.planner))
        loop = StepSettings(SEED, lesson.steps, log_every=1, checkpoint_every=0)
        with suppress(Stopped):
            fit(found.planner, batches, lesson.training, loop, TrainingProcess(0, 1, torch.device("cpu")), out, {})
    with (out / LOSSES).open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    losses = np.array([float(row["total"]) for row in rows])
    factors = [group.get(FACTOR, 1.0) for group in build_optimiser(lesson.training, found.planner).param_groups]
    rates = np.array([float(row["learning_rate"]) for row in rows])[:, None] * factors
    return LessonCurve(losses, rates, gradients, optimiser)


class _Batches:
    """What `fit` asks of a loader; after the `first` batches it raises Stopped."""

    def __init__(self, lesson: Lesson, first: int) -> None:
        self.lesson, self.first, self.order = lesson, first, lesson.order
        self.all = batch_of(samples(lesson.picture))

    def at(self, step: int) -> Batch:
        """The batch of a step."""
        rows = torch.from_numpy(self.order[step])
        double = self.lesson.double

        def chosen(name: str, value: Any) -> Any:
            if isinstance(value, Mapping):
                return {key: chosen(key, one) for key, one in value.items()}
            if not isinstance(value, Tensor):
                return value and tuple(value[row] for row in rows)
            value = value[rows]
            if double and name == "image":  # the factor that pictures are scaled by is rounded to float32
                return value.double() / 255.0
            return value.double() if double and value.is_floating_point() else value

        return replace(self.all, **{f.name: chosen(f.name, getattr(self.all, f.name)) for f in fields(self.all)})

    def n_batches(self, epoch: int) -> int:
        return self.lesson.epoch_steps

    def epoch(self, epoch: int) -> Iterator[Batch]:
        for step in range(epoch * self.lesson.epoch_steps, (epoch + 1) * self.lesson.epoch_steps):
            if step == self.first:
                raise Stopped(f"{self.first} steps are done")
            yield self.at(step)

    def state(self) -> dict[str, Any]:
        return {"epoch": 0}

    def resume(self, state: Mapping[str, Any]) -> None:
        raise NotImplementedError("a lesson is never gone on with")


def apart(public: LessonCurve, ours: LessonCurve) -> Array:
    """(n,) float64: relative difference of the losses of the steps that both have."""
    n = min(len(public.losses), len(ours.losses))
    return np.abs(ours.losses[:n] - public.losses[:n]) / np.abs(public.losses[:n])


def differences_in_learning(public: LessonCurve, ours: LessonCurve) -> list[Difference]:
    """Gradients of the first step, rates of all steps, and losses, relative."""
    n = min(len(public.losses), len(ours.losses))
    rates, wanted = ours.rates[:n], public.rates[:n]
    if (rates != rates[:, :1]).any() or (wanted != wanted[:, :1]).any():
        raise ConfigError("groups of other rates than the first's are not compared")
    off = np.abs(rates[:, 0] - wanted[:, 0]) / wanted[:, 0]
    losses = apart(public, ours)
    return [
        gradient_difference(public.gradients, ours.gradients),
        Difference(f"rates of {n} steps", float(off.max()), float(wanted.max())),
        Difference(f"losses of {n} steps", float(losses.max()), float(public.losses[:n].max()), ROUNDING_OF_CURVES),
    ]
