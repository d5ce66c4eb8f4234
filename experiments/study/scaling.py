"""How planners' scores grow with simulated data, as in the paper's scaling figure.

    python -m experiments.study.scaling data.real=[runs/town] data.sim=[runs/town] benchmark=runs/hard \
        planners=[ltf_small,diffusiondrive_small] experts=[recovery,pdm_closed] seeds=2
    ... "+train={all: ['workers=1'], gtrs_dense: ['planner.settings.vocabulary=<file>']}"      settings of the trainings

Trains one planner for every combination of the axes (planners, experts, rounds, sim_ratios, imitation, real_shares)
and seed, evaluates all on one benchmark, holds each against real samples alone, and fits S(N) = a log^2 N + b log N + c
per curve (paper, section 4.3, eq. 7 and 8). N counts real and simulated samples together, log is the natural one. Where
a < 0 the curve has a top, the amount of data beyond which more of it hurts. What it writes is a study's:
frames.parquet, EPDMS of each frame by each planner, and the tables of it; and of the final score curves.csv and
scaling.png.
"""

import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.study.settings import settings_of
from factory.config.arguments import INPUT_ERRORS, run_command
from planners.evaluation.aggregation import score_column, scores_in_percent, stages_shown, write_csv
from planners.study.report import FRAMES, StudyFrames, read_study
from planners.study.setups import Budget, Comparison, Imitation, Setup, words_of
from planners.study.sweep import SweepSettings, run
from planners.training.many import Training
from tasks.world.arrays import Array

SWEEP = "sweep"  # its one part
FEWEST = 4  # points of a curve: three parameters and one degree of freedom for the residuals
COLOURS = ("#1f6fb4", "#d1561c", "#2a8a4a", "#8a4fb0", "#b03a5b", "#6b6b6b")
EVERYONE = "all"


@dataclass(frozen=True)
class SweepData:
    """Tables."""

    real: tuple[str, ...]  # of the factory
    sim: tuple[str, ...]  # with at least as many rounds as are asked for
    val: tuple[str, ...] = ()  # for each training's validation curve


@dataclass(frozen=True, kw_only=True)
class ScalingSettings(SweepSettings):
    """The command's keys."""

    data: SweepData
    planners: tuple[str, ...] = ("ltf",)  # names of conf/planner
    experts: tuple[str, ...] = ("pdm_closed",)  # one curve each; all: samples of every expert together
    rounds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)  # simulated rounds trained on; 0: real samples alone
    sim_ratios: tuple[float | Literal["natural"], ...] = ("natural",)
    imitation: tuple[Imitation, ...] = ("all",)  # real: rewards only on simulated samples
    real_shares: tuple[float, ...] = (1.0,)
    seeds: int = 1
    steps: int | None = None  # optimiser steps of every training; null: the planner's epochs of what it is trained on
    train: dict[str, tuple[str, ...]] = field(default_factory=dict)  # planner, or all -> overrides of `planners train`

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("planners", "experts", "rounds", "sim_ratios", "imitation", "real_shares"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}={list(values)}: at least one, each once")
        unknown = sorted(set(self.train) - {EVERYONE, *self.planners})
        if unknown:
            raise ValueError(f"train: {', '.join(unknown)} is none of {EVERYONE}, {', '.join(self.planners)}")
        if min(self.rounds) < 0:
            raise ValueError(f"rounds={list(self.rounds)}: 0 is real samples alone, 1 the first round with them")
        if self.seeds < 1:
            raise ValueError(f"seeds={self.seeds}: how many, at least 1")


def comparisons_of(s: ScalingSettings) -> list[Comparison]:
    """Every combination; real samples alone stand once for all experts, ratios and kinds of imitation."""
    budget: Budget = "epochs" if s.steps is None else "steps"
    found = []
    for planner, expert, ratio, imitation, share, rounds in product(
        s.planners, s.experts, s.sim_ratios, s.imitation, s.real_shares, s.rounds
    ):
        alone = Setup(planner, "real", 0, budget, "none" if imitation == "none" else "all", real_share=share)
        more = Setup(planner, expert, rounds, budget, imitation, sim_ratio=ratio, real_share=share)
        one, reference = (more, alone if 0 in s.rounds else None) if rounds else (alone, None)
        found.append(Comparison(SWEEP, one, reference, s.seeds, budget))
    return list(dict.fromkeys(found))


def trainings_of(s: ScalingSettings) -> list[Training]:
    """Of each combination, seed by seed."""
    found = []
    for seed, one in product(range(s.seeds), comparisons_of(s)):
        planner = one.setup.planner
        overrides = one.setup.overrides(planner, s.data.real, s.data.sim, s.data.val, seed)
        overrides += [f"steps={s.steps}"] if s.steps is not None else []
        overrides += [*s.train.get(EVERYONE, ()), *s.train.get(planner, ())]
        facts = {**vars(one.setup), "seed": seed}
        found.append(Training(one.setup.label_of(seed), tuple(overrides), facts, (SWEEP, seed)))
    return found


@dataclass(frozen=True)
class ScalingLaw:
    """A fitted curve."""

    a: float
    b: float
    c: float
    residual_std: float  # sqrt(sum of squared residuals / (points - 3)): half the height of the band

    def score(self, n: Array | float) -> Array:
        """S at data sizes n."""
        log_n = np.log(n)
        return np.asarray(self.a * log_n**2 + self.b * log_n + self.c)

    @property
    def saturation(self) -> float | None:
        """The data size where the curve is highest, exp(-b / 2a); None where it has no top (a >= 0).

        Infinite where that is beyond all numbers.
        """
        if self.a >= 0.0:
            return None
        log_n = -self.b / (2.0 * self.a)
        return math.exp(log_n) if log_n < 700.0 else math.inf


def fit_scaling(n: Sequence[int] | Array, scores: Sequence[float] | Array) -> ScalingLaw:
    """The least-squares curve through scores at data sizes n; the model is linear in a, b, c, so it is exact.

    Raises ValueError for fewer than 4 points, fewer than 3 different sizes, sizes below 1 or scores that are no number.
    """
    sizes, values = np.asarray(n, np.float64), np.asarray(scores, np.float64)
    if sizes.shape != values.shape or sizes.ndim != 1:
        raise ValueError(f"n and scores must be one number a point each, got {sizes.shape} and {values.shape}")
    if len(sizes) < FEWEST:
        raise ValueError(f"{len(sizes)} points: a scaling curve needs at least {FEWEST}; run more rounds")
    if not (np.isfinite(sizes).all() and (sizes >= 1).all() and np.isfinite(values).all()):
        raise ValueError("data sizes must be at least 1 and scores finite")
    if len(np.unique(sizes)) < 3:
        raise ValueError(f"data sizes {sorted(set(sizes.tolist()))}: at least 3 different ones are needed")
    # Columns about the mean of log N: the same curve, and a matrix that is far from singular.
    log_n = np.log(sizes)
    middle = log_n.mean()
    columns = np.stack([(log_n - middle) ** 2, log_n - middle, np.ones_like(log_n)], axis=1)
    (a, slope, level), *_ = np.linalg.lstsq(columns, values, rcond=None)
    residuals = values - columns @ np.array([a, slope, level])
    return ScalingLaw(
        a=float(a),
        b=float(slope - 2.0 * a * middle),
        c=float(level - slope * middle + a * middle**2),
        residual_std=float(np.sqrt((residuals**2).sum() / (len(sizes) - 3))),
    )


@dataclass(frozen=True)
class Curve:
    """The trainings of one planner with one kind of data."""

    planner: str
    label: str
    samples: tuple[int, ...]  # of each training, real and simulated
    scores: tuple[float, ...]  # percent
    law: ScalingLaw | None  # None: fewer than 4 data sizes

    def row(self) -> dict[str, Any]:
        """Of the table of curves; empty where there is no fit."""
        top = None if self.law is None else self.law.saturation
        fit = {name: getattr(self.law, name, "") for name in ("a", "b", "c", "residual_std")}
        head = {"planner": self.planner, "curve": self.label, "trainings": len(self.samples)}
        return {**head, **fit, "saturation_samples": "" if top is None else f"{top:.0f}"}


def curves_of(frames: StudyFrames, score: str) -> list[Curve]:
    """A score over the number of samples: a curve for each planner and kind of data, real samples alone in each."""
    samples = {facts["training"]: facts["real"] + facts["simulated"] for facts in frames.trainings}
    curves = []
    for (planner, name), labels in _series(frames).items():
        sizes = tuple(samples[label] for label in labels)
        values = tuple(scores_in_percent(frames.clips[label])[score] for label in labels)
        law = fit_scaling(sizes, values) if len(set(sizes)) >= FEWEST else None
        curves.append(Curve(planner, name, sizes, values, law))
    return curves


def _series(frames: StudyFrames) -> Mapping[tuple[str, str], list[str]]:
    """(panel, curve) -> trainings."""
    found = defaultdict[tuple[str, str], dict[str, None]](dict)
    of_setup = defaultdict[str, list[str]](list)
    for facts in frames.trainings:
        of_setup[facts["training"].rpartition("-")[0]].append(facts["training"])
    for one in frames.comparisons:
        if one.setup.rounds:
            labels = [label for setup in reversed(one.setups) for label in of_setup[setup.label]]
            curve = f"{one.setup.planner}, equal {one.budget}", words_of(one.facts, counted=False)
            found[curve] |= dict.fromkeys(labels)
    return {name: list(labels) for name, labels in found.items()}


def draw_curves(curves: Sequence[Curve], score: str, path: Path) -> None:
    """The paper's scaling figure: a panel for each planner, its points, fitted curves, residual bands and tops."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    planners = list(dict.fromkeys(curve.planner for curve in curves))
    figure, axes = pyplot.subplots(1, len(planners), figsize=(1.0 + 4.4 * len(planners), 4.2), squeeze=False)
    for panel, planner in zip(axes[0], planners):
        mine = [curve for curve in curves if curve.planner == planner]
        for colour, curve in zip(COLOURS * len(mine), mine):
            panel.plot(curve.samples, curve.scores, "o", color=colour, label=curve.label)
            if curve.law is None:
                continue
            along = np.geomspace(min(curve.samples), max(curve.samples), 100)
            middle, half = curve.law.score(along), curve.law.residual_std
            panel.plot(along, middle, color=colour)
            panel.fill_between(along, middle - half, middle + half, color=colour, alpha=0.15, linewidth=0)
            top = curve.law.saturation
            if top is not None and along[0] <= top <= along[-1]:
                panel.plot([top], [float(curve.law.score(top))], "*", color=colour, markersize=13)
        panel.set(xscale="log", title=planner, xlabel="samples, real and simulated")
        panel.legend(fontsize=8)
    axes[0][0].set_ylabel(f"{score} [%]")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def scale(words: Sequence[str]) -> None:
    """Train, score and report what settings ask for. Raises ConfigError, Stopped, Failed."""
    s = settings_of(ScalingSettings, Path(__file__).with_suffix(".yaml"), words)
    everything = trainings_of(s)
    run(s, everything, everything, comparisons_of(s))
    report, final = Path(s.report or s.out), ("final", stages_shown(s.human_filter)["final"])
    curves = curves_of(read_study(report / FRAMES), score_column(*final))
    write_csv(report / "curves.csv", [curve.row() for curve in curves])
    draw_curves(curves, f"two-stage EPDMS, {final[1]}", report / "scaling.png")


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], scale, lambda: __doc__, INPUT_ERRORS))
