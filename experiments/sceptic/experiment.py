"""An experiment of arms: equal steps on real samples, and on these and as many added ones of each kind.

An arm adds the samples of one run and of some experts, or another run's real samples. All begin with the same weights
and learn for equally many optimiser steps; they are scored on clips that nobody learns from: by the two-stage benchmark
and, where `drives` says so, by driving in closed loop, each against the others, constant velocity and PDM-Closed, with
intervals over towns. What is written goes to `report`: frames.parquet, the tables of it and, of drives,
bounds_held.csv, driving.csv, driving_differences.csv and arms.md, to be read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from experiments.study.data import Recipe, make
from experiments.study.settings import settings_of
from factory.exits import Stopped
from planners.data.index import DataSettings, open_dataset
from planners.study.arms import (
    HeldAgainst,
    against_bounds,
    arm_differences,
    comparison_tables,
    drive_arms,
    read_arm_drives,
    write_arms,
)
from planners.study.setups import Comparison, Setup
from planners.study.sweep import SweepSettings, run
from planners.training.many import TRAININGS, Training

BEGIN, TRAIN, HARD, REAL = "begin", "train", "hard", "real"  # runs that there must be; the arm that adds nothing


@dataclass(frozen=True)
class Arm:
    """What is added to real samples."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}  # a misspelt key is an error

    run: str  # a folder of runs, or several
    experts: tuple[str, ...] = ()  # whose samples; none: the run's real ones
    rounds: int = 0  # of candidates that simulated samples are taken from

    def __post_init__(self) -> None:
        if bool(self.experts) != (self.rounds > 0):
            raise ValueError(f"{self.run}: simulated samples are of experts and of rounds, real ones of neither")


@dataclass(frozen=True, kw_only=True)
class ExperimentSettings(SweepSettings):
    """The keys of sceptic.yaml and labels.yaml."""

    runs: dict[str, str]  # folder below out -> settings of `python -m factory run`
    common: dict[str, str]  # what several runs share
    one_cache: tuple[str, ...]  # runs that render from the same blocks
    vocabulary: str | None  # trajectories that samples are labelled with, made first; null: none
    planners: dict[str, str]  # of conf/planner
    train: tuple[str, ...]  # further overrides of every `planners train`
    begin_steps: int  # that each planner is trained for in other towns first
    steps: int  # of every training behind that, whatever it learns from
    rounds: int  # of candidates, for runs and arms to name
    arms: dict[str, Arm]  # what is added
    added: Literal["more", "fewest"]  # samples to each arm: at most what arm `more` has, or what every arm has
    parts: dict[str, tuple[str, ...]]  # an arm that others are held against, and these others
    psnr_db: float | None  # bound on the blocks of simulated samples; null: none
    seeds: int
    drives: str | None  # settings of `python -m planners drive`; null: the benchmark alone

    def __post_init__(self) -> None:
        super().__post_init__()
        named = {BEGIN, TRAIN, HARD, *(run for arm in self.arms.values() for run in arm.run.split())}
        missing = named - set(self.runs)
        if missing:
            raise ValueError(f"runs lacks {', '.join(sorted(missing))}")
        if unknown := {name for part in self.parts.values() for name in part} - {REAL, *self.arms}:
            raise ValueError(f"parts: {', '.join(sorted(unknown))} is no arm; arms are {REAL}, {', '.join(self.arms)}")
        if self.added == "more" and "more" not in self.arms:
            raise ValueError("added=more: there is no arm more")
        for name in ("begin_steps", "steps", "rounds", "seeds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least 1")
        if not self.planners:
            raise ValueError("planners: name at least one of conf/planner")

    def table(self, name: str) -> str:
        """A run's folder."""
        return str(Path(self.out) / name)

    @property
    def recipe(self) -> Recipe:
        """The data."""
        return Recipe(
            out=self.out,
            minutes=None if self.left_s is None else self.left_s / 60.0,
            only=(),
            words=self.common,
            vocabulary=self.vocabulary,
            one_cache=self.one_cache,
            runs=self.runs,
        )


def setup(settings: ExperimentSettings, planner: str, data: str) -> Setup:
    """An arm's."""
    return Setup(planner, data, settings.arms[data].rounds if data in settings.arms else 0, "steps")


def chosen(settings: ExperimentSettings, arm: Arm, run: str) -> DataSettings:
    """The samples of a run that an arm may take from."""
    if not arm.experts:
        return DataSettings(real=settings.table(run))
    return DataSettings(
        sim=settings.table(run), experts=arm.experts, max_round=arm.rounds - 1, psnr_min=settings.psnr_db
    )


def added(settings: ExperimentSettings) -> dict[str, int]:
    """How many samples each arm adds."""
    there = {
        name: sum(len(open_dataset(chosen(settings, arm, run))) for run in arm.run.split())
        for name, arm in settings.arms.items()
    }
    most = there["more"] if settings.added == "more" else min(there.values())
    return {name: min(n, most) for name, n in there.items()}


def training_of(
    settings: ExperimentSettings, planner: str, data: str, seed: int, n_added: Mapping[str, int]
) -> Training:
    """One training of an arm, or of what all begin with."""
    own = [settings.table(BEGIN)] if data == BEGIN else [settings.table(TRAIN), settings.table(BEGIN)]
    arm = settings.arms.get(data)
    tables = [settings.table(run) for run in arm.run.split()] if arm else []
    real = [*own, *tables] if arm and not arm.experts else own
    overrides = [f"planner={settings.planners[planner]}", f"data.real=[{','.join(real)}]", f"seed={seed}"]
    if arm and arm.experts:
        overrides += [f"data.sim=[{','.join(tables)}]", f"data.experts=[{','.join(arm.experts)}]"]
        overrides += [f"data.max_round={arm.rounds - 1}", f"data.limit_sim={n_added[data]}"]
        overrides += [f"data.psnr_min={settings.psnr_db}"] if settings.psnr_db is not None else []
    overrides += [f"data.val=[{settings.table(HARD)}]", *settings.train]
    if data == BEGIN:
        overrides.append(f"steps={settings.begin_steps}")
    else:
        first = setup(settings, planner, BEGIN).label_of(0)
        overrides += [f"steps={settings.steps}", f"init_from={Path(settings.out) / TRAININGS / first}"]
    one = setup(settings, planner, data)
    return Training(one.label_of(seed), tuple(overrides), {**vars(one), "seed": seed}, (arm_part(data), seed))


def arm_part(data: str) -> str:
    """The part that a training is done in: what all begin with is done before."""
    return BEGIN if data == BEGIN else "arms"


def planned(settings: ExperimentSettings, n_added: Mapping[str, int]) -> list[Training]:
    """All trainings, seed by seed."""
    found = [training_of(settings, planner, BEGIN, 0, n_added) for planner in settings.planners]
    for seed in range(settings.seeds):
        for data in (REAL, *settings.arms):
            found += [training_of(settings, planner, data, seed, n_added) for planner in settings.planners]
    return found


def comparisons(settings: ExperimentSettings) -> list[Comparison]:
    """What is held against what, of each planner."""
    found = []
    for planner in settings.planners:
        for part, (reference, *others) in settings.parts.items():
            base = setup(settings, planner, reference)
            found.append(Comparison(part, base, None, settings.seeds, "steps"))
            found += [Comparison(part, setup(settings, planner, one), base, settings.seeds, "steps") for one in others]
    return found


def experiment(file: str, argv: Sequence[str]) -> None:
    """Make, train, score, drive and report what is missing of the settings beside `file`.

    Raises ConfigError, Stopped, Failed.
    """
    settings = settings_of(ExperimentSettings, Path(file).with_suffix(".yaml"), argv)
    if settings.left_s != 0.0:
        make(settings.recipe)
    everyone, wanted = planned(settings, added(settings)), comparisons(settings)
    arms = [one for one in everyone if one.facts["data"] != BEGIN]
    try:
        run(settings, everyone, everyone, wanted)
        stopped = drive_arms(arms, settings.out, settings.drives, settings) if settings.drives else None
    except Stopped as error:
        stopped = error
    if settings.drives:
        report_drives(settings, arms, wanted)
    if stopped:
        raise stopped


def report_drives(settings: ExperimentSettings, arms: Sequence[Training], wanted: Sequence[Comparison]) -> None:
    """Write and print what is driven so far, and the benchmark beside the bounds."""
    assert settings.drives
    report = Path(settings.report or settings.out)
    pairs = [HeldAgainst(one.part, one.setup.label, one.reference.label) for one in wanted if one.reference]
    driven = read_arm_drives(arms, settings.out, settings.drives)
    if driven:
        found = arm_differences(driven, pairs)
        first = next(iter(settings.parts))
        held = against_bounds(report, [one.setup for one in wanted if one.part == first], settings.seeds)
        write_arms(report, driven, found, held)
        print(comparison_tables(driven, found, held))
