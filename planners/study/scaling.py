"""`python -m planners scaling`: how planners' scores grow with simulated data, as in the paper's scaling figure.

    python -m planners scaling data.real=[runs/town] data.sim=[runs/town] benchmark=runs/hard \
        planners=[ltf_small,diffusiondrive_small] experts=[recovery,pdm_closed] seeds=[0,1]

Trains one planner for every combination of the axes (planners, experts, rounds, sim_ratios, imitation, real_shares,
seeds), evaluates all on one benchmark, and fits S(N) = a log^2 N + b log N + c per curve. Writes frames.parquet, EPDMS
of each frame by each planner, and the tables and pictures that `python -m planners report` makes of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

from factory.config.compose import compose, fill
from planners.command import command
from planners.study.setups import Imitation, Setup
from planners.study.study import run
from planners.study.sweep import SweepSettings, Training

EVERYONE = "all"


@dataclass(frozen=True)
class SweepData:
    """Tables."""

    real: tuple[str, ...]
    sim: tuple[str, ...]
    val: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ScalingSettings(SweepSettings):
    """The keys of conf/scaling.yaml."""

    data: SweepData
    planners: tuple[str, ...]
    experts: tuple[str, ...]
    rounds: tuple[int, ...]
    sim_ratios: tuple[float | Literal["natural"], ...]
    imitation: tuple[Imitation, ...]
    real_shares: tuple[float, ...]
    seeds: tuple[int, ...]
    steps: int | None = None
    train: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("planners", "experts", "rounds", "sim_ratios", "imitation", "real_shares", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}={list(values)}: at least one, each once")
        unknown = sorted(set(self.train) - {EVERYONE, *self.planners})
        if unknown:
            raise ValueError(f"train: {', '.join(unknown)} is none of {EVERYONE}, {', '.join(self.planners)}")
        if min(self.rounds) < 0:
            raise ValueError(f"rounds={list(self.rounds)}: 0 is real samples alone, 1 the first round with them")


def trainings_of(s: ScalingSettings) -> list[Training]:
    """One for every combination; real samples alone are trained once for all experts, ratios and kinds of imitation."""
    found: dict[str, Training] = {}
    axes = (s.planners, s.experts, s.sim_ratios, s.imitation, s.real_shares, s.rounds, s.seeds)
    for planner, expert, ratio, imitation, share, rounds, seed in product(*axes):
        if rounds == 0:
            expert, ratio = "", "natural"
            imitation = "none" if imitation == "none" else "all"  # with real samples alone, all are real
        setup = Setup(planner, expert, rounds, "epochs", imitation, sim_ratio=ratio, real_share=share)
        facts = {"planner": planner, "expert": expert, "sim_ratio": ratio, "imitation": imitation, "real_share": share}
        facts |= {"rounds": rounds, "seed": seed}
        label = "-".join(str(value) for value in facts.values() if value != "")
        overrides = setup.overrides(planner, s.data.real, s.data.sim, s.data.val, seed)
        overrides += [f"steps={s.steps}"] if s.steps is not None else []
        overrides += [*s.train.get(EVERYONE, ()), *s.train.get(planner, ())]
        found[label] = Training(label, tuple(overrides), facts, ("scaling", 0))
    return list(found.values())


def scale(words: Sequence[str]) -> None:
    """Train, score and report what settings ask for. Raises ConfigError, Stopped, Failed."""
    s = fill(ScalingSettings, compose("scaling", words, ScalingSettings), "scaling")
    everything = trainings_of(s)
    run(s, everything, everything, ())


main = command(scale)
