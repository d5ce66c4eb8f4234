"""The study's list of set-ups: what is trained on what, which is held against which, and in what order.

Everything is compared twice: in equal passes over a planner's own data, as the paper does, and in equal optimiser
steps, since more data in equal passes is more training as well.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

from planners.study.sweep import TRAININGS, SweepSettings, Training

Budget = Literal["epochs", "steps"]
Imitation = Literal["all", "real", "none"]
BUDGETS: tuple[Budget, ...] = ("epochs", "steps")
EXPERTS = ("recovery", "pdm_closed")
ALL_EXPERTS = "all"
SHARES = (0.25, 0.5, 1.0)
RATIOS = (0.25, 0.5, 0.75)
ENSEMBLE = "ensemble"  # stands for a planner; nothing is trained for it
SCORING = "gtrs_dense"  # the planner that learns from rewards too
MULTI = ("diffusiondrive", SCORING)  # the planners of everything but the main table
SWEEP = "sweep"  # the one part of `python -m planners scaling`
PARTS = ("main", "rounds", "traffic", "ratio", "psnr", "rewards", "real_share", "control", "ensemble")


@dataclass(frozen=True, kw_only=True)
class StudySettings(SweepSettings):
    """The keys of conf/study.yaml."""

    data: str
    replay: str
    control: str
    begin: str | None
    begin_epochs: int
    val: str
    planners: dict[str, str]
    vocabulary: str
    rounds: int
    seeds: int
    curve_seeds: int
    epochs: int
    batch_size: int
    psnr_db: float
    parts: tuple[str, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = sorted(set(self.parts) - set(PARTS))
        if unknown or not self.parts:
            raise ValueError(f"parts={list(self.parts)}: some of {', '.join(PARTS)}")
        missing = sorted({"ltf", *MULTI} - set(self.planners))
        if missing:
            raise ValueError(f"planners lacks {', '.join(missing)}")


@dataclass(frozen=True)
class Sizes:
    """What the tables hold, as far as the plan depends on it."""

    steps: int  # of budget=steps: those of `epochs` passes over all real and pdm_closed samples
    matched: int | None = None  # simulated samples on either side of psnr_db where their number is held equal


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

    def training(self, settings: StudySettings, seed: int, sizes: Sizes, part: str = "") -> Training:
        """One of its trainings in the study."""
        label, facts, unit = self.label_of(seed), {**vars(self), "seed": seed}, (part, seed)
        if self.planner == ENSEMBLE:
            members = (trained(one, self.rounds) for one in taught(SCORING, self.budget, self.rounds))
            return Training(label, (), facts, unit, tuple(one.label_of(seed) for one in members))
        simulated = settings.replay if self.traffic == "replay" else settings.data
        if self.data == "logged":
            simulated = settings.control
        begins = self.data == "begin"
        real = [str(settings.begin)] if begins else [settings.data, *([settings.begin] if settings.begin else [])]
        overrides = [
            *self.overrides(settings.planners[self.planner], real, [simulated], [settings.val], seed),
            f"planner.training.epochs={settings.begin_epochs if begins else settings.epochs}",
            f"planner.training.batch_size={settings.batch_size}",
            "workers=1",
            "validate_every=100",
        ]
        if settings.begin and not begins:
            overrides.append(f"init_from={Path(settings.out) / TRAININGS / begin(self.planner).label_of(0)}")
        if self.planner == SCORING:
            overrides.append(f"planner.settings.vocabulary={settings.vocabulary}")
        if self.budget == "steps":
            overrides.append(f"steps={sizes.steps}")
        if self.psnr == "low":
            overrides += [f"data.psnr_max={settings.psnr_db}"]
        elif self.rounds:
            overrides += [f"data.psnr_min={settings.psnr_db}"]
        if self.psnr != "any":
            overrides += [f"data.limit_sim={sizes.matched}"]
        return Training(label, tuple(overrides), facts, unit)


def begin(planner: str) -> Setup:
    """What a planner is before the study: trained on real samples of other towns."""
    return Setup(planner, "begin", 0, "epochs")


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
    if row["data"] == "begin":
        return "other towns"
    rounds = "1 round" if row["rounds"] == 1 else f"{row['rounds']} rounds"
    said = ["real"] if row["rounds"] == 0 else [f"+ {row['data']}", rounds] if counted else [row["data"]]
    said += {"all": [], "real": ["rewards only"], "none": ["no imitation"]}[row["imitation"]]
    said += ["replayed traffic"] if row["traffic"] == "replay" else []
    said += [f"sim ratio {row['sim_ratio']}"] if row["sim_ratio"] != "natural" else []
    said += {"any": [], "low": ["low PSNR"], "high": ["high PSNR"]}[row["psnr"]]
    said += [f"{100.0 * row['real_share']:.0f} % of the real"] if row["real_share"] < 1.0 else []
    return ", ".join(said)


def taught(planner: str, budget: Budget, rounds: int) -> list[Setup]:
    """With each expert and, of the planner that can, on rewards alone."""
    found = [Setup(planner, expert, rounds, budget) for expert in EXPERTS]
    return [*found, replace(found[-1], imitation="real")] if planner == SCORING else found


def groups(settings: StudySettings) -> dict[str, list[tuple[Setup, list[Setup]]]]:
    """Of each part: setups that others are held against, and these others."""
    rounds = {
        "epochs": [*range(1, settings.rounds + 1)],
        "steps": sorted({1, (settings.rounds + 1) // 2, settings.rounds}),
    }

    def real(planner: str, budget: Budget, **more: Any) -> Setup:
        return Setup(planner, "real", 0, budget, **more)

    def sim(
        planner: str, budget: Budget, data: str = "pdm_closed", rounds: int = settings.rounds, **more: Any
    ) -> Setup:
        return Setup(planner, data, rounds, budget, **more)

    both: list[tuple[str, Budget]] = [(planner, budget) for planner in MULTI for budget in BUDGETS]
    series = [one for planner in MULTI for one in taught(planner, "epochs", settings.rounds)]
    members = {budget: taught(SCORING, budget, settings.rounds) for budget in BUDGETS}
    imitation = {SCORING: "real"}
    return {
        "main": [(real(p, b), taught(p, b, settings.rounds)) for p in settings.planners for b in BUDGETS],
        "rounds": [
            (real(one.planner, b), [replace(one, rounds=n, budget=b) for n in rounds[b]])
            for one in series
            for b in BUDGETS
        ],
        "traffic": [
            (sim(p, b, rounds=n), [sim(p, b, rounds=n, traffic="replay")])
            for p in MULTI
            for n in rounds["steps"]
            for b in BUDGETS
        ],
        "ratio": [(sim(p, b), [sim(p, b, sim_ratio=ratio) for ratio in RATIOS]) for p, b in both],
        # As many samples on either side: equal epochs are equal steps.
        "psnr": [(sim(p, "epochs", psnr="low"), [sim(p, "epochs", psnr="high")]) for p in MULTI],
        # With real samples alone: is imitation needed there?
        "rewards": [(real(SCORING, b), [real(SCORING, b, imitation="none")]) for b in BUDGETS],
        "real_share": [
            (real(p, b, real_share=s), [sim(p, b, real_share=s, imitation=imitation.get(p, "all"))])
            for p in MULTI
            for s in SHARES
            for b in BUDGETS
        ],
        # The same perturbed states with the log's future for a label; in equal steps, as nothing of it is filtered.
        "control": [(sim(p, "steps"), [sim(p, "steps", "logged")]) for p in settings.planners],
        # The mean of what three kinds of data taught, held against rewards alone, as in the paper.
        "ensemble": [(one, [sim(ENSEMBLE, b)] if one is members[b][-1] else []) for b in BUDGETS for one in members[b]],
    }


def comparisons(settings: StudySettings) -> list[Comparison]:
    """All of the chosen parts, each once, behind the trainings that their planners begin with."""
    of_part = groups(settings)
    chosen = [(part, *group) for part in settings.parts for group in of_part[part]]
    asked = {one.planner for _, base, others in chosen for one in (base, *others)}
    first = [planner for planner in settings.planners if planner in asked] if settings.begin else []
    found = [Comparison("begin", begin(planner), None, 1) for planner in first]
    for part, base, others in chosen:
        reference, seeds = trained(base, settings.rounds), settings.seeds if part == "main" else settings.curve_seeds
        found.append(Comparison(part, reference, None, seeds, base.budget))
        found += [Comparison(part, trained(one, settings.rounds), reference, seeds, one.budget) for one in others]
    return list(dict.fromkeys(found))


def with_all_parts(settings: StudySettings) -> StudySettings:
    """The whole study: the chosen parts, then the others."""
    return replace(settings, parts=tuple(dict.fromkeys((*settings.parts, *PARTS))))


def trained(setup: Setup, rounds: int) -> Setup:
    """What is trained for it: all real and pdm_closed samples are what equal steps are counted by, in one training."""
    is_whole = replace(setup, planner="", imitation="all") == Setup("", "pdm_closed", rounds, "steps")
    return replace(setup, budget="epochs") if is_whole and setup.planner != ENSEMBLE else setup


def planned(found: Sequence[Comparison], settings: StudySettings, sizes: Sizes) -> list[Training]:
    """Every setup with every seed that some comparison asks for, each once: part by part, in each seed by seed."""
    trainings: dict[str, Training] = {}
    for part in dict.fromkeys(one.part for one in found):
        mine = [one for one in found if one.part == part]
        for seed in range(max(one.seeds for one in mine)):
            for one in mine:
                for setup in one.setups if seed < one.seeds else ():
                    if setup.label_of(seed) not in trainings:
                        trainings[setup.label_of(seed)] = setup.training(settings, seed, sizes, part)
    return list(trainings.values())


def so_far(found: Sequence[Comparison], evaluated: Collection[str]) -> list[Comparison]:
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
