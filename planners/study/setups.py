"""Set-ups: what a planner is trained on, and which are held against which."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any, Literal

Budget = Literal["epochs", "steps"]
Imitation = Literal["all", "real", "none"]
ALL_EXPERTS = "all"
ALONE = {"begin": "other towns", "more": "real, and more real"}  # data without simulated samples, in words


@dataclass(frozen=True)
class Setup:
    """What one planner is trained on, and how long."""

    planner: str
    data: str  # real samples, and those of this expert; `begin`: real samples of other towns alone, where all begin
    rounds: int  # simulated ones, 0 with real samples alone
    budget: Budget  # equal passes over its own data (the paper), or equal optimiser steps
    imitation: Imitation = "all"
    traffic: Literal["reactive", "replay"] = "reactive"
    sim_ratio: float | Literal["natural"] = "natural"
    psnr: Literal["any", "low", "high"] = "any"
    real_share: float = 1.0

    @property
    def label(self) -> str:
        """Names it; what is as usual is left out."""
        parts = [self.planner, self.data if self.rounds == 0 else f"{self.data}{self.rounds}", self.budget]
        parts += {"all": [], "real": ["rewards_only"], "none": ["no_imitation"]}[self.imitation]
        parts += [self.traffic] if self.traffic != "reactive" else []
        parts += [f"ratio{self.sim_ratio}"] if self.sim_ratio != "natural" else []
        parts += [f"psnr_{self.psnr}"] if self.psnr != "any" else []
        parts += [f"share{self.real_share}"] if self.real_share < 1.0 else []
        return "-".join(parts)

    def label_of(self, seed: int) -> str:
        """Names one of its trainings."""
        return f"{self.label}-{seed}"

    def overrides(
        self, planner: str, real: Iterable[str], sim: Iterable[str], val: Iterable[str], seed: int
    ) -> list[str]:
        """Of `python -m planners train`: one of conf/planner, and tables to learn from."""
        chosen = [f"data.max_round={self.rounds - 1}"] if self.rounds else []
        chosen += [f"data.experts=[{self.data}]"] if self.rounds and self.data != ALL_EXPERTS else []
        return [
            f"planner={planner}",
            f"data.real=[{','.join(real)}]",
            f"data.sim=[{','.join(sim) if self.rounds else ''}]",
            f"data.val=[{','.join(val)}]",
            f"data.real_share={self.real_share}",
            f"mix.imitation={self.imitation}",
            f"mix.sim_ratio={self.sim_ratio}",
            f"seed={seed}",
            *chosen,
        ]


@dataclass(frozen=True)
class Comparison:
    """A setup, and the one that it is held against; None: it is itself what others are held against."""

    part: str
    setup: Setup
    reference: Setup | None
    seeds: int
    budget: Budget = "epochs"  # that of the comparison

    @property
    def setups(self) -> tuple[Setup, ...]:
        """Both, or the only one."""
        return (self.setup,) if self.reference is None else (self.setup, self.reference)

    @property
    def facts(self) -> dict[str, Any]:
        """Its columns in the tables."""
        of_setup = {"setup": self.setup.label, **vars(self.setup)}
        return {"part": self.part, **of_setup, "budget": self.budget, "seeds": self.seeds}


def words_of(row: Mapping[str, Any], counted: bool = True) -> str:
    """What a planner was trained on, in words; what is as usual is left out, and the rounds where not `counted`."""
    if row["data"] in ALONE:
        return ALONE[row["data"]]
    rounds = "1 round" if row["rounds"] == 1 else f"{row['rounds']} rounds"
    said = ["real"] if row["rounds"] == 0 else [f"+ {row['data']}", rounds] if counted else [row["data"]]
    said += {"all": [], "real": ["rewards only"], "none": ["no imitation"]}[row["imitation"]]
    said += ["replayed traffic"] if row["traffic"] == "replay" else []
    said += [f"sim ratio {row['sim_ratio']}"] if row["sim_ratio"] != "natural" else []
    said += {"any": [], "low": ["low PSNR"], "high": ["high PSNR"]}[row["psnr"]]
    said += [f"{100.0 * row['real_share']:.0f} % of the real"] if row["real_share"] < 1.0 else []
    return ", ".join(said)


def completed_comparisons(found: Sequence[Comparison], evaluated: Collection[str]) -> list[Comparison]:
    """Comparisons of which both sides are evaluated with the same seeds, all of a part with equally many.

    A part is left out as long as nothing of it is held against anything: other parts share what it would begin with.
    """
    standing: list[tuple[Comparison, int]] = []
    for one in found:
        done = (all(setup.label_of(seed) in evaluated for setup in one.setups) for seed in range(one.seeds))
        if seeds := sum(takewhile(bool, done)):
            standing.append((one, seeds))
    closed = {one.part for one in found if one.reference} - {one.part for one, _ in standing if one.reference}
    fewest = {part: min(n for one, n in standing if one.part == part) for part in {one.part for one, _ in standing}}
    return [replace(one, seeds=fewest[one.part]) for one, _ in standing if one.part not in closed]
