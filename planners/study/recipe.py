"""`python -m planners study_data` and `study_logs`: what a study is made of, run after run and sweep after sweep.

    python -m planners study_data                            clips, blocks, samples and benchmark of the towns
    python -m planners study_data minutes=25                 a part of it
    python -m planners study_logs shared=../shared           real logs without images: data, trainings, tables
    python -m planners study_logs only=[nuscenes]

conf/study_data.yaml and conf/study_logs.yaml list runs and sweeps. The same command goes on where it stopped.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from factory.config.compose import compose, fill
from factory.exits import INTERRUPTED, asked_to_stop
from planners.command import Failed, Stopped, command
from planners.study.scaling import scale
from planners.training.many import Means, exit_code


@dataclass(frozen=True)
class Recipe:
    """The keys of conf/study_data.yaml and conf/study_logs.yaml."""

    out: str
    report: str | None
    minutes: float | None
    only: tuple[str, ...]
    words: dict[str, str]
    vocabulary: str | None
    one_cache: tuple[str, ...]
    runs: dict[str, str]
    sweeps: dict[str, str]
    shared: str | None = None

    def chosen(self, of: dict[str, str]) -> dict[str, list[str]]:
        """Folder -> settings."""
        return {name: text.split() for name, text in of.items() if not self.only or name.startswith(self.only)}


def make(recipe: Recipe) -> None:
    """Run what is missing. Raises ValueError, Stopped, Failed."""
    out, means = Path(recipe.out), Means(minutes=recipe.minutes)
    runs, sweeps = recipe.chosen(recipe.runs), recipe.chosen(recipe.sweeps)
    if not runs and not sweeps:
        raise ValueError(f"only={','.join(recipe.only)}: none of {', '.join((*recipe.runs, *recipe.sweeps))} begins so")
    if recipe.shared and not (Path(recipe.shared) / "data").is_dir():
        raise ValueError(f"no logs at {recipe.shared}/data: give shared=<folder with data/av2, data/scenarionet, ...>")
    if recipe.vocabulary and not Path(recipe.vocabulary).is_file():
        factory("vocabulary", "kinematic=true", "k=512", f"out={recipe.vocabulary}")
    for name in recipe.one_cache:
        (out / name).mkdir(parents=True, exist_ok=True)
        (out / "blocks").mkdir(exist_ok=True)
        if not (out / name / "cache").is_symlink():
            (out / name / "cache").symlink_to("../blocks")
    for name, settings in runs.items():
        factory("run", *settings, f"out={out / name}", *means.words)
    for name, settings in sweeps.items():
        beside = (out / name).parent
        data = [f"data.{what}=[{beside / 'train'}]" for what in ("real", "sim")]
        data += [f"data.val=[{beside / 'hard'}]", f"benchmark={beside / 'hard'}"]
        scale([*settings, *data, f"out={out / name}", f"report={recipe.report}/{name}", *means.words])


def factory(*words: str) -> None:
    """One command of the factory. Raises Stopped where it was interrupted, Failed where it ended with an error."""
    _done("factory", *words)


def planners(*words: str) -> None:
    """One command of the planners. Raises as `factory`."""
    _done("planners", *words)


def _done(package: str, *words: str) -> None:
    print("python -m", package, *words, file=sys.stderr)
    stop = Event()
    with asked_to_stop(stop.set):
        code = exit_code([sys.executable, "-m", package, *words], stop.is_set)
    if code == INTERRUPTED or stop.is_set():
        raise Stopped("the same command goes on")
    if code:
        raise Failed(f"python -m {package} {words[0]} ended with exit code {code}")


@command
def data(argv: Sequence[str]) -> None:
    """`python -m planners study_data`."""
    make(fill(Recipe, compose("study_data", argv, Recipe), "study_data"))


@command
def logs(argv: Sequence[str]) -> None:
    """`python -m planners study_logs`."""
    make(fill(Recipe, compose("study_logs", argv, Recipe), "study_logs"))
