"""The commands of `python -m factory` and `python -m planners`; nothing heavy is imported until one is called."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from factory import __version__
from factory.config.arguments import ComposedCommand, run_request_command
from factory.config.words import did_you_mean
from factory.exits import BAD_CONFIG


@dataclass(frozen=True)
class Command:
    """One word behind `python -m factory` or `python -m planners`."""

    about: str
    module: str
    name: str = "main"  # of the function there, which is as factory.config.arguments has it

    def function(self) -> Any:
        """What does it: of a request, or a ComposedCommand."""
        return getattr(import_module(self.module), self.name)

    def load(self) -> Callable[[Sequence[str]], int]:
        """What answers: arguments -> exit code."""
        function = self.function()
        return function if isinstance(function, ComposedCommand) else partial(run_request_command, function)


LOOK, KEEP, EXCHANGE, PREPARE = (f"factory.commands.{name}" for name in ("look", "keep", "exchange", "prepare"))
COMMANDS: Mapping[str, Command] = {
    "run": Command("make samples; the same command again goes on", "factory.run"),
    "plan": Command("what a run would take: attempts, samples, hours, GB", PREPARE, "plan"),
    "status": Command("what a run holds, its acceptance funnel, how it ended", LOOK, "status"),
    "failed": Command("failed attempts: file, field, message, how to retry", LOOK, "failed"),
    "retry": Command("try failed attempts again, with the run's own settings", KEEP, "retry"),
    "remake": Command("a stage of a finished run again, under new settings", KEEP, "remake"),
    "lineage": Command("where a sample comes from: clip, candidate, attempt, files", LOOK, "lineage"),
    "show": Command("one sample: numbers, a picture, a film", LOOK, "show"),
    "dashboard": Command("a live page of a run in the browser", LOOK, "dashboard"),
    "report": Command("the same page as one file", LOOK, "report"),
    "export": Command("samples as MCAP, films; all in NAVSIM's layout", EXCHANGE, "export"),
    "import": Command("SimScale's samples, NAVSIM's benchmarks, nuScenes' photos", EXCHANGE, "import_"),
    "explain": Command("one clip: every candidate, why it fell, a film", LOOK, "explain"),
    "vocabulary": Command("build a vocabulary or a recovery table from logs", PREPARE, "vocabulary"),
    "scene": Command("scenes of 3D Gaussians: from photos, info, import, film", EXCHANGE, "scene"),
    "verify": Command("check a run's tables and caches; repair them", KEEP, "verify"),
    "clean": Command("remove orphans and temporary files of a run", KEEP, "clean"),
    "compact": Command("merge a run's small shards", KEEP, "compact"),
    "warm": Command("compile the kernels before the first run", PREPARE, "warm"),
    "completion": Command("completion for bash or zsh", "factory.commands.completion", "completion"),
}

# What is built on the factory: names alone, as nothing here imports it. `python -m planners` is their door.
PLANNERS: Mapping[str, Command] = {
    "train": Command("fit a planner to logged and simulated samples", "planners.training.train"),
    "import": Command("a released checkpoint of the public code as ours", "planners.published.import_planner"),
    "evaluate": Command("EPDMS of planners on held-out clips", "planners.evaluation.evaluate"),
    "compare": Command("how two planners differ, with intervals", "planners.ab.compare"),
    "ab": Command("what more samples are worth: arms, a verdict, tables", "planners.ab.ab"),
    "serve": Command("plans for NAVSIM's evaluation, or a driver of AlpaSim", "planners.serve"),
    "submit": Command("plans of a NAVSIM split as its leaderboard takes them", "planners.navsim.submit"),
    "drive": Command("planners in closed loop, until something ends the drive", "planners.drive.drive"),
    "replay": Command("a planner on one clip as a film", "planners.evaluation.replay"),
}
DOORS = {"factory": COMMANDS, "planners": PLANNERS}  # package -> what `python -m <package>` knows


def command_list(commands: Mapping[str, Command]) -> str:
    """Every command in one line."""
    return "\n".join(f"  {name:<14}{command.about}" for name, command in commands.items())


def dispatch(argv: Sequence[str], commands: Mapping[str, Command], about: str) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(about)
        return 0 if argv else BAD_CONFIG
    if argv[0] in ("-V", "--version"):
        print(f"driving-data-factory {__version__}")
        return 0
    name, *rest = argv
    if name in commands:
        return commands[name].load()(rest)
    door = next((door for door, known in DOORS.items() if name in known), None)
    meant = f"; it is python -m {door} {name}" if door else did_you_mean(name, list(commands))
    print(f"error: there is no command {name}; see --help{meant}", file=sys.stderr)
    return BAD_CONFIG
