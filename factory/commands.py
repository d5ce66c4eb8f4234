"""The commands of `python -m factory`, on one screen; nothing heavy is imported until one is called."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module


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
    "status": Command("what a run holds, and how its newest start ended", "factory.status", "status"),
    "funnel": Command("acceptance by expert and round, and why not", "factory.status", "funnel"),
    "failed": Command("failed attempts: file, field, message, how to retry", "factory.status", "failed"),
    "retry": Command("try failed attempts again, with the run's own settings", "factory.retry"),
    "lineage": Command("where a sample comes from: clip, candidate, attempt, files", "factory.lineage"),
    "show": Command("one sample: numbers, a picture, a film", "factory.show"),
    "dashboard": Command("a live page of a run in the browser", "factory.dashboard"),
    "report": Command("the same page as one file", "factory.report"),
    "export": Command("samples as MCAP, Rerun recordings or films", "factory.export"),
    "explain": Command("one clip: every candidate, why it fell, a film", "factory.explain", takes="run"),
    "vocabulary": Command("build a vocabulary or a recovery table from logs", "factory.vocabulary", takes="words"),
    "scene": Command("scene files of 3D Gaussians: info, import, export", "factory.scene", takes="words"),
    "verify": Command("check a run's tables from their files", "factory.store.verify", takes="words"),
    "completion": Command("completion for bash or zsh", "factory.completion", takes="words"),
}


def nearest(word: str, known: Sequence[str]) -> str:
    """`; did you mean x?` where one is near, else nothing."""
    found = get_close_matches(word, known, n=1, cutoff=0.6)
    return f"; did you mean {found[0]}?" if found else ""
