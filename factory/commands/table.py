"""The commands of `python -m factory` and `python -m planners`; nothing heavy is imported until one is called."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module

from factory import __version__
from factory.config.arguments import BAD_ARGUMENTS
from factory.config.words import nearest


@dataclass(frozen=True)
class Command:
    """One word behind `python -m factory`."""

    about: str
    module: str
    function: str = "main"
    takes: str = "request"  # run: settings of conf/run.yaml; request: fields of the module's Request; words: neither

    def load(self) -> Callable[[Sequence[str]], int]:
        """What answers: arguments -> exit code."""
        found: Callable[[Sequence[str]], int] = getattr(import_module(self.module), self.function)
        return found


COMMANDS: Mapping[str, Command] = {
    "run": Command("make samples; the same command again goes on", "factory.run", takes="run"),
    "plan": Command("what a run would take: attempts, samples, hours, GB", "factory.run", "plan", takes="run"),
    "status": Command("what a run holds, and how its newest start ended", "factory.views.status", "status"),
    "funnel": Command("acceptance by expert and round, and why not", "factory.views.status", "funnel"),
    "failed": Command("failed attempts: file, field, message, how to retry", "factory.views.status", "failed"),
    "retry": Command("try failed attempts again, with the run's own settings", "factory.commands.retry"),
    "lineage": Command("where a sample comes from: clip, candidate, attempt, files", "factory.views.lineage"),
    "show": Command("one sample: numbers, a picture, a film", "factory.views.show"),
    "dashboard": Command("a live page of a run in the browser", "factory.commands.dashboard"),
    "report": Command("the same page as one file", "factory.views.board.report"),
    "export": Command("samples as MCAP, Rerun recordings or films", "factory.commands.export"),
    "explain": Command("one clip: every candidate, why it fell, a film", "factory.commands.explain", takes="run"),
    "vocabulary": Command(
        "build a vocabulary or a recovery table from logs", "factory.setup.vocabulary", takes="words"
    ),
    "scene": Command("scene files of 3D Gaussians: info, import, export", "factory.commands.scene", takes="words"),
    "verify": Command("check a run's tables from their files", "factory.commands.verify", takes="words"),
    "warm": Command("compile the kernels before the first run", "factory.commands.warm", takes="words"),
    "completion": Command("completion for bash or zsh", "factory.commands.completion", takes="words"),
}

# What is built on the factory: names alone, as nothing here imports it. `python -m planners` is their door.
PLANNERS: Mapping[str, Command] = {
    "train": Command("fit a planner to logged and simulated samples", "planners.training.train", takes="words"),
    "evaluate": Command("EPDMS of planners on held-out clips", "planners.evaluation.evaluate", takes="words"),
    "compare": Command("how two planners differ, with intervals", "planners.evaluation.compare", takes="words"),
    "scaling": Command("how scores grow with simulated data, by which law", "planners.study.scaling", takes="words"),
    "replay": Command("a planner on one clip as a film", "planners.evaluation.replay", takes="words"),
    "ensemble": Command("several GTRS-Dense models as one", "planners.evaluation.ensemble", takes="words"),
    "analysis": Command("EPDMS on real and simulated frames, by tag", "planners.evaluation.analysis", takes="words"),
    "study": Command("whether simulated data helps: all of docs/study.md", "planners.study.study", takes="words"),
    "study_data": Command("the study's data, by runs of the factory", "planners.study.recipe", "data", takes="words"),
    "study_logs": Command("the study's part on real logs", "planners.study.recipe", "logs", takes="words"),
    "report": Command("a study's tables and pictures from its frames", "planners.study.report", takes="words"),
    "agreement": Command("whether a study made again says the same", "planners.study.agreement", takes="words"),
}
DOORS = {"factory": COMMANDS, "planners": PLANNERS}  # package -> what `python -m <package>` knows


def listed(commands: Mapping[str, Command]) -> str:
    """Every command in one line."""
    return "\n".join(f"  {name:<14}{command.about}" for name, command in commands.items())


def dispatch(argv: Sequence[str], commands: Mapping[str, Command], about: str) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(about)
        return 0 if argv else BAD_ARGUMENTS
    if argv[0] in ("-V", "--version"):
        print(f"driving-data-factory {__version__}")
        return 0
    name, *rest = argv
    if name in commands:
        return commands[name].load()(rest)
    door = next((door for door, known in DOORS.items() if name in known), None)
    meant = f"; it is python -m {door} {name}" if door else nearest(name, list(commands))
    print(f"error: there is no command {name}; see --help{meant}", file=sys.stderr)
    return BAD_ARGUMENTS
