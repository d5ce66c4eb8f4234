"""What the study compares: setups, each trained with several seeds, and which of them is held against which."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

from planners.evaluation.aggregation import HumanFilter
from planners.study.sweep import TRAININGS, Training

Data = Literal["begin", "real", "recovery", "pdm_closed", "logged"]
Budget = Literal["epochs", "steps"]
SHARES = (0.25, 0.5, 1.0)
RATIOS = (0.25, 0.5, 0.75)
ENSEMBLE = "ensemble"  # stands for a planner; nothing is trained for it
MULTI = ("diffusiondrive", "gtrs_dense")  # the planners of everything but the main table


@dataclass(frozen=True)
class StudySettings:
    """The keys of conf/study.yaml."""

    data: str
    replay: str
    control: str
    begin: str | None
    begin_epochs: int
    benchmark: str
    val: str
    out: str
    report: str
    planners: dict[str, str]
    vocabulary: str
    rounds: int
    seeds: int
    curve_seeds: int
    epochs: int
    batch_size: int
    psnr_db: float
    parts: tuple[str, ...]
    human_filter: HumanFilter = "unfiltered"
    jobs: int | None = None
    minutes: float | None = None

    def __post_init__(self) -> None:
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
    data: Data  # real samples, and those of this expert; `begin`: real samples of other towns alone, where all begin
    rounds: int  # simulated ones, 0 with real samples alone
    budget: Budget  # equal passes over its own data (the paper), or equal optimiser steps
    imitation: Literal["all", "real", "none"] = "all"
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

    def training(self, settings: StudySettings, seed: int, sizes: Sizes) -> Training:
        """One of its trainings."""
        simulated = settings.replay if self.traffic == "replay" else settings.data
        if self.data == "logged":
            simulated = settings.control
        begins = self.data == "begin"
        real = [settings.begin] if begins else [settings.data, *([settings.begin] if settings.begin else [])]
        overrides = [
            f"planner={settings.planners[self.planner]}",
            f"data.real=[{','.join(str(table) for table in real)}]",
            f"data.sim=[{simulated if self.rounds else ''}]",
            f"data.val=[{settings.val}]",
            f"data.real_share={self.real_share}",
            f"mix.imitation={self.imitation}",
            f"mix.sim_ratio={self.sim_ratio}",
            f"planner.training.epochs={settings.begin_epochs if begins else settings.epochs}",
            f"planner.training.batch_size={settings.batch_size}",
            f"seed={seed}",
            "workers=1",
            "validate_every=100",
        ]
        if settings.begin and not begins:
            overrides.append(f"init_from={Path(settings.out) / TRAININGS / begin(self.planner).label_of(0)}")
        if self.planner == "gtrs_dense":
            overrides.append(f"planner.settings.vocabulary={settings.vocabulary}")
        if self.budget == "steps":
            overrides.append(f"steps={sizes.steps}")
        if self.rounds:
            overrides += [f"data.experts=[{self.data}]", f"data.max_round={self.rounds - 1}"]
        if self.psnr == "low":
            overrides += [f"data.psnr_max={settings.psnr_db}"]
        elif self.rounds:
            overrides += [f"data.psnr_min={settings.psnr_db}"]
        if self.psnr != "any":
            overrides += [f"data.limit_sim={sizes.matched}"]
        return Training(self.label_of(seed), tuple(overrides), {**vars(self), "seed": seed})

    def label_of(self, seed: int) -> str:
        """Names one of its trainings."""
        return f"{self.label}-{seed}"


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
    def facts(self) -> dict[str, Any]:
        """Its columns in the tables."""
        return {
            "part": self.part,
            "setup": self.setup.label,
            **vars(self.setup),
            "budget": self.budget,
            "seeds": self.seeds,
        }


def comparisons(settings: StudySettings) -> list[Comparison]:
    """All of the chosen parts, each once, behind the trainings that their planners begin with."""
    chosen = [one for part in settings.parts for one in PARTS[part](settings)]
    asked = {one.setup.planner for one in chosen}
    first = [planner for planner in settings.planners if planner in asked] if settings.begin else []
    found = [Comparison("begin", begin(planner), None, 1) for planner in first]
    for one in chosen:
        reference = None if one.reference is None else trained(one.reference, settings.rounds)
        setup = trained(one.setup, settings.rounds)
        found.append(replace(one, setup=setup, reference=reference, budget=one.setup.budget))
    return list(dict.fromkeys(found))


def with_all_parts(settings: StudySettings) -> StudySettings:
    """The whole study: the chosen parts, then the others."""
    return replace(settings, parts=tuple(dict.fromkeys((*settings.parts, *PARTS))))


def trained(setup: Setup, rounds: int) -> Setup:
    """What is trained for it: all real and pdm_closed samples are what equal steps are counted by, in one training."""
    is_whole = replace(setup, planner="", imitation="all") == Setup("", "pdm_closed", rounds, "steps")
    return replace(setup, budget="epochs") if is_whole and setup.planner != ENSEMBLE else setup


def _main(settings: StudySettings) -> Iterator[Comparison]:
    for planner in settings.planners:
        for budget in BUDGETS:
            real = Setup(planner, "real", 0, budget)
            yield Comparison("main", real, None, settings.seeds)
            for expert in EXPERTS:
                yield Comparison("main", Setup(planner, expert, settings.rounds, budget), real, settings.seeds)
            if planner == "gtrs_dense":
                alone = Setup(planner, "pdm_closed", settings.rounds, budget, imitation="real")
                yield Comparison("main", alone, real, settings.seeds)


def _rounds(settings: StudySettings) -> Iterator[Comparison]:
    for base in _series():
        for budget in BUDGETS:
            real = Setup(base.planner, "real", 0, budget)
            yield Comparison("rounds", real, None, settings.curve_seeds)
            every = range(1, settings.rounds + 1)
            for rounds in every if budget == "epochs" else _few(settings.rounds):
                setup = replace(base, rounds=rounds, budget=budget)
                yield Comparison("rounds", setup, real, settings.curve_seeds)


def _traffic(settings: StudySettings) -> Iterator[Comparison]:
    for planner in MULTI:
        for rounds in _few(settings.rounds):
            for budget in BUDGETS:
                reactive = Setup(planner, "pdm_closed", rounds, budget)
                yield Comparison("traffic", reactive, None, settings.curve_seeds)
                yield Comparison("traffic", replace(reactive, traffic="replay"), reactive, settings.curve_seeds)


def _ratio(settings: StudySettings) -> Iterator[Comparison]:
    for planner in MULTI:
        for budget in BUDGETS:
            natural = Setup(planner, "pdm_closed", settings.rounds, budget)
            yield Comparison("ratio", natural, None, settings.curve_seeds)
            for ratio in RATIOS:
                yield Comparison("ratio", replace(natural, sim_ratio=ratio), natural, settings.curve_seeds)


def _psnr(settings: StudySettings) -> Iterator[Comparison]:
    """As many samples on either side: equal epochs are equal steps."""
    for planner in MULTI:
        low = Setup(planner, "pdm_closed", settings.rounds, "epochs", psnr="low")
        yield Comparison("psnr", low, None, settings.curve_seeds)
        yield Comparison("psnr", replace(low, psnr="high"), low, settings.curve_seeds)


def _rewards(settings: StudySettings) -> Iterator[Comparison]:
    """With real samples alone: is imitation needed there?"""
    for budget in BUDGETS:
        real = Setup("gtrs_dense", "real", 0, budget)
        yield Comparison("rewards", real, None, settings.curve_seeds)
        yield Comparison("rewards", replace(real, imitation="none"), real, settings.curve_seeds)


def _real_share(settings: StudySettings) -> Iterator[Comparison]:
    for planner in MULTI:
        imitation: Literal["all", "real"] = "real" if planner == "gtrs_dense" else "all"
        for share in SHARES:
            for budget in BUDGETS:
                real = Setup(planner, "real", 0, budget, real_share=share)
                both = Setup(planner, "pdm_closed", settings.rounds, budget, imitation=imitation, real_share=share)
                yield Comparison("real_share", real, None, settings.curve_seeds)
                yield Comparison("real_share", both, real, settings.curve_seeds)


def _control(settings: StudySettings) -> Iterator[Comparison]:
    """The same perturbed states with the log's future for a label; in equal steps, as nothing of it is filtered."""
    for planner in settings.planners:
        expert = Setup(planner, "pdm_closed", settings.rounds, "steps")
        yield Comparison("control", expert, None, settings.curve_seeds)
        yield Comparison("control", replace(expert, data="logged"), expert, settings.curve_seeds)


def _ensemble(settings: StudySettings) -> Iterator[Comparison]:
    """The mean of what three kinds of data taught, held against rewards alone, as in the paper."""
    for budget in BUDGETS:
        members = _members(budget, settings.rounds)
        for member in members:
            yield Comparison("ensemble", member, None, settings.curve_seeds)
        together = Setup(ENSEMBLE, "pdm_closed", settings.rounds, budget)
        yield Comparison("ensemble", together, members[-1], settings.curve_seeds)


def members_of(budget: Budget, rounds: int) -> list[Setup]:
    """The trainings of an ensemble."""
    return [trained(member, rounds) for member in _members(budget, rounds)]


def _members(budget: Budget, rounds: int) -> list[Setup]:
    """Recovery, planner, rewards only."""
    imitating = [Setup("gtrs_dense", expert, rounds, budget) for expert in EXPERTS]
    return [*imitating, replace(imitating[-1], imitation="real")]


def _few(rounds: int) -> list[int]:
    """The first, the middle and the last."""
    return sorted({1, (rounds + 1) // 2, rounds})


def _series() -> Sequence[Setup]:
    """What is drawn over rounds."""
    imitating = [Setup(planner, expert, 1, "epochs") for planner in MULTI for expert in EXPERTS]
    return [*imitating, Setup("gtrs_dense", "pdm_closed", 1, "epochs", imitation="real")]


BUDGETS: tuple[Budget, ...] = ("epochs", "steps")
PLANNERS_OF_LEG = 48
EXPERTS: tuple[Data, ...] = ("recovery", "pdm_closed")
PARTS = {
    "main": _main,
    "rounds": _rounds,
    "traffic": _traffic,
    "ratio": _ratio,
    "psnr": _psnr,
    "rewards": _rewards,
    "real_share": _real_share,
    "control": _control,
    "ensemble": _ensemble,
}


@dataclass(frozen=True)
class Portion:
    """One seed of one part: what is asked for first, and what the tables say of it."""

    part: str
    seed: int
    trainings: tuple[Training, ...]  # that no portion before it asked for
    ensembles: dict[str, str]  # label -> trainings joined by plus, as planners.evaluation.evaluate takes them

    @property
    def labels(self) -> list[str]:
        """What is evaluated."""
        return [*(training.label for training in self.trainings), *self.ensembles]


def portions(found: Sequence[Comparison], settings: StudySettings, sizes: Sizes) -> list[Portion]:
    """Every setup with every seed that some comparison asks for, each once: part by part, in each seed by seed."""
    planned, seen = [], set[tuple[Setup, int]]()
    for part in dict.fromkeys(one.part for one in found):
        mine = [one for one in found if one.part == part]
        for seed in range(max(one.seeds for one in mine)):
            asked = [one for one in mine if seed < one.seeds]
            setups = dict.fromkeys(s for one in asked for s in (one.setup, one.reference) if s is not None)
            new = [s for s in setups if (s, seed) not in seen]
            seen |= {(s, seed) for s in new}
            new_trainings = tuple(s.training(settings, seed, sizes) for s in new if s.planner != ENSEMBLE)
            joined = {s.label_of(seed): _joined(s, seed, Path(settings.out)) for s in new if s.planner == ENSEMBLE}
            planned.append(Portion(part, seed, new_trainings, joined))
    return planned


def legs(planned: Sequence[Portion]) -> list[list[Portion]]:
    """Portions that are trained at once and then evaluated at once: cores idle at the end of either.

    What all begin with is done before; else as many portions, one after the other, as make PLANNERS_OF_LEG.
    """
    found: list[list[Portion]] = []
    for portion in planned:
        last = found[-1] if found else []
        if not last or last[-1].part == "begin" or sum(len(p.labels) for p in last) >= PLANNERS_OF_LEG:
            found.append([portion])
        else:
            last.append(portion)
    return found


def _joined(ensemble: Setup, seed: int, out: Path) -> str:
    members = members_of(ensemble.budget, ensemble.rounds)
    return "+".join(str(out / TRAININGS / member.label_of(seed)) for member in members)


def so_far(found: Sequence[Comparison], evaluated: Collection[str]) -> list[Comparison]:
    """Comparisons of which both sides are evaluated with the same seeds, all of a part with equally many.

    A part is left out as long as nothing of it is held against anything: other parts share what it would begin with.
    """
    standing = [(one, seeds) for one in found if (seeds := _seeds_of(one, evaluated))]
    of_part: dict[str, int] = {}
    for one, seeds in standing:
        of_part[one.part] = min(seeds, of_part.get(one.part, seeds))
    open_parts = {one.part for one in found if one.reference} - {one.part for one, _ in standing if one.reference}
    return [replace(one, seeds=of_part[one.part]) for one, _ in standing if one.part not in open_parts]


def _seeds_of(one: Comparison, evaluated: Collection[str]) -> int:
    sides = [setup for setup in (one.setup, one.reference) if setup is not None]
    done = (all(setup.label_of(seed) in evaluated for setup in sides) for seed in range(one.seeds))
    return sum(takewhile(bool, done))
