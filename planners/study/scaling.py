"""`python -m planners scaling`: how planners' scores grow with simulated data, as in the paper's scaling figure.

    python -m planners scaling data.real=[runs/town] data.sim=[runs/town] benchmark=runs/hard \
        planners=[ltf_small,diffusiondrive_small] experts=[recovery,pdm_closed] seeds=2
    ... "+train={all: ['workers=1'], gtrs_dense: ['planner.settings.vocabulary=<file>']}"      settings of the trainings

Trains one planner for every combination of the axes (planners, experts, rounds, sim_ratios, imitation, real_shares)
and seed, evaluates all on one benchmark, holds each against real samples alone, and fits S(N) = a log^2 N + b log N + c
per curve. What it writes is a study's: frames.parquet, EPDMS of each frame by each planner, and the tables and pictures
that `python -m planners report` makes of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

from factory.config.compose import compose, fill
from planners.command import command
from planners.study.setups import SWEEP, Budget, Comparison, Imitation, Setup
from planners.study.sweep import SweepSettings, run
from planners.training.many import Training

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


def scale(words: Sequence[str]) -> None:
    """Train, score and report what settings ask for. Raises ConfigError, Stopped, Failed."""
    s = fill(ScalingSettings, compose("scaling", words, ScalingSettings), "scaling")
    everything = trainings_of(s)
    run(s, everything, everything, comparisons_of(s))


main = command(scale, ScalingSettings)
