"""`python -m planners sceptic`: what simulated samples are worth beside other additions; docs/study/sceptic.md.

    python -m planners sceptic                  all of it: data, trainings, benchmark, drives, tables
    python -m planners sceptic minutes=25       a part of it: what is done stays done, and the same command goes on
    python -m planners sceptic minutes=0        the tables of what is done, again

Planners learn for equally many optimiser steps from real samples alone, and from these and as many added ones:

    more         real samples of other logs of the same towns
    redrawn      renderings at logged poses, with the log's own label: the pictures alone are another's
    logged       renderings from perturbed states, with the log's own label
    pdm_closed   renderings from perturbed states, with the pseudo-expert's

They are scored on towns that nobody learns from: by the two-stage benchmark, and by driving in closed loop, on true
pictures, each against the others, constant velocity and PDM-Closed, with intervals over towns. What is written goes to
`report`: what `python -m planners report` makes again of frames.parquet, bounds_held.csv of the benchmark, driving.csv,
driving_differences.csv and arms.md, to be read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.config.compose import compose, fill
from planners.command import Stopped, command
from planners.data.index import DataSettings, open_dataset
from planners.study.arms import HeldAgainst, against_bounds, arms_of, differences_of, drive_arms, text_of, write_arms
from planners.study.recipe import Recipe, make
from planners.study.setups import Comparison, Setup
from planners.study.sweep import SweepSettings, run
from planners.training.many import TRAININGS, Training

BEGIN, REAL, MORE, REDRAWN, LOGGED, EXPERT = "begin", "real", "more", "redrawn", "logged", "pdm_closed"
PARTS: Mapping[str, tuple[str, tuple[str, ...]]] = {  # part -> what others are held against, these others
    "real alone": (REAL, (MORE, REDRAWN, LOGGED, EXPERT)),
    "more real": (MORE, (EXPERT,)),
    "the label": (LOGGED, (EXPERT,)),
    "the state": (REDRAWN, (LOGGED,)),
}
FOLDERS = {REDRAWN: "redrawn", LOGGED: "logged", EXPERT: "train"}  # of simulated samples
RUNS = ("begin", "train", "more", "redrawn", "logged", "hard")


@dataclass(frozen=True, kw_only=True)
class ScepticSettings(SweepSettings):
    """The keys of conf/sceptic.yaml."""

    runs: dict[str, str]  # folder below out -> settings of `python -m factory run`
    common: dict[str, str]  # what several runs share
    one_cache: tuple[str, ...]  # runs that render from the same blocks
    vocabulary: str | None  # trajectories that samples are labelled with, made first; null: none
    planners: dict[str, str]  # of conf/planner
    train: tuple[str, ...]  # further overrides of every `planners train`
    begin_steps: int  # that each planner is trained for in other towns first
    steps: int  # of every training behind that, whatever it learns from
    rounds: int  # of candidates that simulated samples are taken from
    psnr_db: float  # bound on the blocks of simulated samples
    seeds: int
    drives: str  # settings of `python -m planners drive`

    def __post_init__(self) -> None:
        super().__post_init__()
        if set(self.runs) != set(RUNS):
            raise ValueError(f"runs are {', '.join(self.runs)}: there must be {', '.join(RUNS)}")
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
            report=None,
            minutes=None if self.left_s is None else self.left_s / 60.0,
            only=(),
            words=self.common,
            vocabulary=self.vocabulary,
            one_cache=self.one_cache,
            runs=self.runs,
            sweeps={},
        )


def setup(settings: ScepticSettings, planner: str, data: str) -> Setup:
    """An arm's. Redrawn are the logs' own states: there is one round of them."""
    return Setup(planner, data, {REDRAWN: 1}.get(data, settings.rounds) if data in FOLDERS else 0, "steps")


def chosen(settings: ScepticSettings, data: str) -> DataSettings:
    """The simulated samples that an arm may take from."""
    expert = EXPERT if data == EXPERT else LOGGED
    return DataSettings(
        sim=settings.table(FOLDERS[data]), experts=(expert,), max_round=settings.rounds - 1, psnr_min=settings.psnr_db
    )


def added(settings: ScepticSettings) -> dict[str, int]:
    """How many samples each arm adds: as many as `more` has, and fewer only where there are fewer."""
    n = len(open_dataset(DataSettings(real=settings.table("more"))))
    return {MORE: n} | {data: min(n, len(open_dataset(chosen(settings, data)))) for data in FOLDERS}


def training_of(settings: ScepticSettings, planner: str, data: str, seed: int, n_added: Mapping[str, int]) -> Training:
    """One training of an arm, or of what all begin with."""
    own = [settings.table("train"), settings.table("begin")]
    real = {BEGIN: own[1:], MORE: [*own, settings.table("more")]}.get(data, own)
    overrides = [f"planner={settings.planners[planner]}", f"data.real=[{','.join(real)}]", f"seed={seed}"]
    if data in FOLDERS:
        sim = chosen(settings, data)
        overrides += [f"data.sim=[{sim.sim}]", f"data.experts=[{sim.experts[0]}]", f"data.max_round={sim.max_round}"]
        overrides += [f"data.psnr_min={sim.psnr_min}", f"data.limit_sim={n_added[data]}"]
    overrides += [f"data.val=[{settings.table('hard')}]", *settings.train]
    if data == BEGIN:
        overrides.append(f"steps={settings.begin_steps}")
    else:
        first = setup(settings, planner, BEGIN).label_of(0)
        overrides += [f"steps={settings.steps}", f"init_from={Path(settings.out) / TRAININGS / first}"]
    arm = setup(settings, planner, data)
    return Training(arm.label_of(seed), tuple(overrides), {**vars(arm), "seed": seed}, (arm_part(data), seed))


def arm_part(data: str) -> str:
    """The part that a training is done in: what all begin with is done before."""
    return BEGIN if data == BEGIN else "arms"


def planned(settings: ScepticSettings, n_added: Mapping[str, int]) -> list[Training]:
    """All trainings, seed by seed."""
    arms = list(dict.fromkeys(name for reference, others in PARTS.values() for name in (reference, *others)))
    found = [training_of(settings, planner, BEGIN, 0, n_added) for planner in settings.planners]
    for seed in range(settings.seeds):
        found += [training_of(settings, p, data, seed, n_added) for data in arms for p in settings.planners]
    return found


def comparisons(settings: ScepticSettings) -> list[Comparison]:
    """What is held against what, of each planner."""
    found = []
    for planner in settings.planners:
        for part, (reference, others) in PARTS.items():
            base = setup(settings, planner, reference)
            found.append(Comparison(part, base, None, settings.seeds, "steps"))
            found += [Comparison(part, setup(settings, planner, one), base, settings.seeds, "steps") for one in others]
    return found


def sceptic(argv: Sequence[str]) -> None:
    """Make, train, score, drive and report what is missing. Raises ConfigError, Stopped, Failed."""
    settings = fill(ScepticSettings, compose("sceptic", argv, ScepticSettings), "sceptic")
    if settings.left_s != 0.0:
        make(settings.recipe)
    everyone, wanted = planned(settings, added(settings)), comparisons(settings)
    arms = [one for one in everyone if one.facts["data"] != BEGIN]
    try:
        run(settings, everyone, everyone, wanted)
        stopped = drive_arms(arms, settings.out, settings.drives, settings)
    except Stopped as error:
        stopped = error
    report = Path(settings.report or settings.out)
    pairs = [HeldAgainst(one.part, one.setup.label, one.reference.label) for one in wanted if one.reference]
    driven = arms_of(arms, settings.out, settings.drives)
    if driven:
        found = differences_of(driven, pairs)
        held = against_bounds(report, [one.setup for one in wanted if one.part == next(iter(PARTS))], settings.seeds)
        write_arms(report, driven, found, held)
        print(text_of(driven, found, held))
    if stopped:
        raise stopped


main = command(sceptic, ScepticSettings)
