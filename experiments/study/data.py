"""What a study is made of, run after run of the factory.

    python -m experiments.study.data                         clips, blocks, samples and benchmark of the towns
    python -m experiments.study.data minutes=25              a part of it
    python -m experiments.study.data only=[train,hard]       some runs

data.yaml lists the runs. The same command goes on where it stopped.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from experiments.study.settings import settings_of
from factory.config.arguments import INPUT_ERRORS, run_command
from factory.exits import INTERRUPTED, Failed, Stopped, calling_on_stop_signal
from planners.training.many import SweepResources, run_process


@dataclass(frozen=True)
class Recipe:
    """The keys of data.yaml."""

    out: str
    minutes: float | None
    only: tuple[str, ...]
    words: dict[str, str]
    vocabulary: str | None
    one_cache: tuple[str, ...]
    runs: dict[str, str]


def make(recipe: Recipe) -> None:
    """Run what is missing. Raises ValueError, Stopped, Failed."""
    out, resources = Path(recipe.out), SweepResources(minutes=recipe.minutes)
    chosen = {name: words for name, words in recipe.runs.items() if not recipe.only or name.startswith(recipe.only)}
    if not chosen:
        raise ValueError(f"only={','.join(recipe.only)}: none of {', '.join(recipe.runs)} begins so")
    if recipe.vocabulary and not Path(recipe.vocabulary).is_file():
        factory("vocabulary", "kinematic=true", "k=512", f"out={recipe.vocabulary}")
    for name in recipe.one_cache:
        (out / name).mkdir(parents=True, exist_ok=True)
        (out / "blocks").mkdir(exist_ok=True)
        if not (out / name / "cache").is_symlink():
            (out / name / "cache").symlink_to("../blocks")
    for name, settings in chosen.items():
        factory("run", *settings.split(), f"out={out / name}", *resources.overrides_left)


def factory(*words: str) -> None:
    """One command of the factory. Raises Stopped where it was interrupted, Failed where it ended with an error."""
    print("python -m factory", *words, file=sys.stderr)
    stop = Event()
    with calling_on_stop_signal(stop.set):
        code = run_process([sys.executable, "-m", "factory", *words], stop.is_set)
    if code == INTERRUPTED or stop.is_set():
        raise Stopped("the same command goes on")
    if code:
        raise Failed(f"python -m factory {words[0]} ended with exit code {code}")


def data(argv: Sequence[str]) -> None:
    """The command."""
    make(settings_of(Recipe, Path(__file__).with_suffix(".yaml"), argv))


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], data, lambda: __doc__, INPUT_ERRORS))
