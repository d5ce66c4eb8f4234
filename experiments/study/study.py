"""Does simulated data make planners better? Trains, evaluates and compares; README.md beside this file.

    python -m experiments.study.data                                 its data first
    python -m experiments.study.study                                all of it
    python -m experiments.study.study minutes=25                     a part of it: what is done stays done
    python -m experiments.study.study parts=[main,rounds]            some comparisons only
    python -m experiments.study.study minutes=0                      the tables of what is done, again

Seeds of parts are trained and evaluated one after the other, small ones together; when the minutes are out, the tables
hold what is done, and say with how many seeds. They hold every part that is evaluated in `out`, whichever were asked
for now. What is written goes to `report`: frames.parquet, EPDMS of each frame by each planner, and the tables of it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from experiments.study.settings import settings_of
from factory.config.arguments import INPUT_ERRORS, run_command
from factory.config.compose import ConfigError
from planners.data.index import DataSettings, open_dataset
from planners.study.setups import Budget, Comparison, Setup
from planners.study.sweep import SweepSettings, run
from planners.training.many import TRAININGS, Training

BUDGETS: tuple[Budget, ...] = ("epochs", "steps")
EXPERTS = ("recovery", "pdm_closed")
SHARES = (0.25, 0.5, 1.0)
RATIOS = (0.25, 0.5, 0.75)
ENSEMBLE = "ensemble"  # stands for a planner; nothing is trained for it
SCORING = "gtrs_dense"  # the planner that learns from rewards too
MULTI = ("diffusiondrive", SCORING)  # the planners of everything but the main table
PARTS = ("main", "rounds", "traffic", "ratio", "psnr", "rewards", "real_share", "control", "ensemble")


@dataclass(frozen=True, kw_only=True)
class StudySettings(SweepSettings):
    """The keys of study.yaml."""

    data: str  # the training clips' run: real, recovery and pdm_closed samples
    replay: str  # the same clips with traffic=replay, pdm_closed
    control: str  # their perturbed states with the log's own future, whatever its reward
    begin: str | None  # human samples of other towns: every planner is trained on them first, and goes on; null: none
    begin_epochs: int
    val: str  # the held-out clips' human rows, for learning curves
    planners: dict[str, str]  # of conf/planner
    vocabulary: str  # .npy that the samples are labelled with
    rounds: int
    seeds: int  # of the main table
    curve_seeds: int  # of everything else
    epochs: int  # passes over a planner's own data; in equal steps those over all real and pdm_closed samples
    batch_size: int
    psnr_db: float  # the paper's bound
    parts: tuple[str, ...]  # which comparisons

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


def begin(planner: str) -> Setup:
    """What a planner is before the study: trained on real samples of other towns."""
    return Setup(planner, "begin", 0, "epochs")


def training_of(setup: Setup, settings: StudySettings, seed: int, sizes: Sizes, part: str = "") -> Training:
    """One of a setup's trainings."""
    label, facts, unit = setup.label_of(seed), {**vars(setup), "seed": seed}, (part, seed)
    if setup.planner == ENSEMBLE:
        members = (trained(one, setup.rounds) for one in taught(SCORING, setup.budget, setup.rounds))
        return Training(label, (), facts, unit, tuple(one.label_of(seed) for one in members))
    simulated = settings.replay if setup.traffic == "replay" else settings.data
    if setup.data == "logged":
        simulated = settings.control
    begins = setup.data == "begin"
    real = [str(settings.begin)] if begins else [settings.data, *([settings.begin] if settings.begin else [])]
    overrides = [
        *setup.overrides(settings.planners[setup.planner], real, [simulated], [settings.val], seed),
        f"planner.training.epochs={settings.begin_epochs if begins else settings.epochs}",
        f"planner.training.batch_size={settings.batch_size}",
        "workers=1",
        "validate_every=100",
    ]
    if settings.begin and not begins:
        overrides.append(f"init_from={Path(settings.out) / TRAININGS / begin(setup.planner).label_of(0)}")
    if setup.planner == SCORING:
        overrides.append(f"planner.settings.vocabulary={settings.vocabulary}")
    if setup.budget == "steps":
        overrides.append(f"steps={sizes.steps}")
    if setup.psnr == "low":
        overrides += [f"data.psnr_max={settings.psnr_db}"]
    elif setup.rounds:
        overrides += [f"data.psnr_min={settings.psnr_db}"]
    if setup.psnr != "any":
        overrides += [f"data.limit_sim={sizes.matched}"]
    return Training(label, tuple(overrides), facts, unit)


def taught(planner: str, budget: Budget, rounds: int) -> list[Setup]:
    """With each expert and, of the planner that can, on rewards alone."""
    found = [Setup(planner, expert, rounds, budget) for expert in EXPERTS]
    return [*found, replace(found[-1], imitation="real")] if planner == SCORING else found


def groups(settings: StudySettings) -> dict[str, list[tuple[Setup, list[Setup]]]]:
    """The list: of each part setups that others are held against, and these others.

    Everything is compared twice: in equal passes over a planner's own data, as the paper does, and in equal optimiser
    steps, since more data in equal passes is more training as well.
    """
    rounds = {
        "epochs": [*range(1, settings.rounds + 1)],
        "steps": sorted({1, (settings.rounds + 1) // 2, settings.rounds}),
    }

    def real(planner: str, budget: Budget, **more: Any) -> Setup:
        return Setup(planner, "real", 0, budget, **more)

    def sim(planner: str, budget: Budget, data: str = "pdm_closed", **more: Any) -> Setup:
        return Setup(planner, data, budget=budget, **{"rounds": settings.rounds, **more})

    series = [one for planner in MULTI for one in taught(planner, "epochs", settings.rounds)]
    members = {budget: taught(SCORING, budget, settings.rounds) for budget in BUDGETS}
    imitation = {SCORING: "real"}
    return {
        "main": [(real(p, b), taught(p, b, settings.rounds)) for p, b in product(settings.planners, BUDGETS)],
        "rounds": [
            (real(one.planner, b), [replace(one, rounds=n, budget=b) for n in rounds[b]])
            for one, b in product(series, BUDGETS)
        ],
        "traffic": [
            (sim(p, b, rounds=n), [sim(p, b, rounds=n, traffic="replay")])
            for p, n, b in product(MULTI, rounds["steps"], BUDGETS)
        ],
        "ratio": [(sim(p, b), [sim(p, b, sim_ratio=ratio) for ratio in RATIOS]) for p, b in product(MULTI, BUDGETS)],
        # As many samples on either side: equal epochs are equal steps.
        "psnr": [(sim(p, "epochs", psnr="low"), [sim(p, "epochs", psnr="high")]) for p in MULTI],
        # With real samples alone: is imitation needed there?
        "rewards": [(real(SCORING, b), [real(SCORING, b, imitation="none")]) for b in BUDGETS],
        "real_share": [
            (real(p, b, real_share=s), [sim(p, b, real_share=s, imitation=imitation.get(p, "all"))])
            for p, s, b in product(MULTI, SHARES, BUDGETS)
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
                        trainings[setup.label_of(seed)] = training_of(setup, settings, seed, sizes, part)
    return list(trainings.values())


def sizes_of(settings: StudySettings) -> Sizes:
    """What the plan depends on. Raises ConfigError where one side of the PSNR bound has no samples and is asked for."""
    sim = DataSettings(sim=settings.data, experts=("pdm_closed",), max_round=settings.rounds - 1)
    high = open_dataset(replace(sim, psnr_min=settings.psnr_db))
    real = sum(len(open_dataset(DataSettings(real=table))) for table in (settings.data, settings.begin) if table)
    steps = settings.epochs * ((real + len(high)) // settings.batch_size)
    try:
        low = open_dataset(replace(sim, psnr_max=settings.psnr_db))
    except ValueError as error:
        if "psnr" not in settings.parts:
            return Sizes(steps)
        raise ConfigError(f"part psnr: {error}; leave it out of parts, or choose another psnr_db") from error
    return Sizes(steps, min(len(low), len(high)))


def study(argv: Sequence[str]) -> None:
    """Train, score and report what settings ask for. Raises ConfigError, Stopped, Failed."""
    settings = settings_of(StudySettings, Path(__file__).with_suffix(".yaml"), argv)
    sizes, whole = sizes_of(settings), with_all_parts(settings)
    wanted = comparisons(whole)
    run(settings, planned(comparisons(settings), settings, sizes), planned(wanted, whole, sizes), wanted)


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], study, lambda: __doc__, INPUT_ERRORS))
