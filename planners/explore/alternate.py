"""`python -m planners alternate`: data, training, exploring, and again, in one command.

    python -m planners alternate out=runs/alternate                         the synthetic town, without pictures
    python -m planners alternate turns=5 minutes=25 ...                     a part of it; the same command goes on
    python -m planners alternate explore=none out=runs/uniform              the vocabulary alone, to be held against
    python -m planners alternate draws=targeted limit=4 ...                 each turn four clips, where it is weak
    python -m planners alternate held_out_clips='clips=synthetic clips.seed=7 ...' ...

Turn 0 makes samples from the vocabulary and trains a planner on them. Then the planner is let drive in the clips. Turn
1 makes samples of where it drifts to, those where it fails first, trains it further on all of them, and so on. A step
is one command of the factory or of planners, in a process of its own; a step that ended is not begun again.

    out/data/<turn>, out/trained/<turn>, out/explored/<turn>, out/held_out/<turn>
    out/steps.json      the commands that are through
    out/turns.csv       a line a turn: samples so far, and how the planner drives

Exit codes: 0 complete, 2 settings that do not fit, 3 a step ended with an error, 4 interrupted or out of minutes.
"""

import csv
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from factory.config.compose import ConfigError, compose, fill
from factory.exits import INTERRUPTED
from factory.store.explored.table import FACTS, open_explored
from factory.store.location import Location
from factory.store.samples import Store
from planners.command import Failed, Stopped, command
from planners.training.checkpoint import read_record
from planners.training.many import Means, exit_code, stops_after

STEPS, TURNS = "steps.json", "turns.csv"


@dataclass(frozen=True)
class AlternateSettings:
    """The keys of conf/alternate.yaml. Texts are settings of the commands that they go to, as on a command line."""

    out: str  # folder; the same command on it goes on
    turns: int  # of data, training, exploring
    explore: Literal["planner", "none"]  # planner: later turns take its own states too; none: the vocabulary alone
    draws: Literal["uniform", "targeted"]  # how `limit` draws: all clips alike, or as conf/sample/targeted
    limit: int | None  # clips that a turn draws; null: all
    rounds: int  # samples of each clip and expert that a turn adds at most
    seed: int  # of data and training
    training_clips: str  # of the run and of explore: which clips
    data: str  # of factory run
    later: str  # of factory run from turn 1 on, over `data`
    train: str  # of planners train
    drive: str  # of planners explore
    held_out_clips: str | None  # that nothing is learned from, driven from the log alone; null: none
    minutes: float | None  # after which no step begins; the same command goes on

    def __post_init__(self) -> None:
        """Raises ValueError for what cannot be."""
        for name in ("turns", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: at least 1")
        if "://" in self.out:
            raise ValueError(f"out={self.out}: a folder of this machine")

    def place(self, part: str, turn: int) -> str:
        """A step's folder."""
        return f"{self.out}/{part}/{turn}"

    @property
    def is_one_table(self) -> bool:
        """Whether nothing that a planner showed is asked for: then later turns go on with the samples of turn 0."""
        return self.explore == "none" and self.draws == "uniform"

    def data_of(self, turn: int) -> str:
        """Where a turn's samples are."""
        return self.place("data", 0 if self.is_one_table else turn)

    def budget_of(self, turn: int) -> list[str]:
        """Which clips a turn takes, how many samples of each, and from where."""
        drawn = ["sample.drawn=true", f"limit={self.limit}"] if self.limit is not None else []
        if self.is_one_table:
            # As many more clips a turn; of all clips as many more samples.
            n_clips, n_rounds = (turn + 1, 1) if self.limit else (1, turn + 1)
            drawn = [*drawn[:1], f"limit={n_clips * self.limit}"] if self.limit else []
            return [*drawn, f"rounds={n_rounds * self.rounds}", f"seed={1000 * self.seed}"]
        words = [f"rounds={self.rounds}", f"seed={1000 * self.seed + turn}"]  # another draw each turn
        if turn == 0:
            return [*drawn, *words]
        before = self.place("explored", turn - 1)
        if self.draws == "targeted":
            drawn = ["sample=targeted", f"sample.scores={before}", *drawn[1:]]
        return [*drawn, *words, *([f"explore={before}"] if self.explore == "planner" else [])]


@dataclass(frozen=True)
class Step:
    """One command."""

    name: str
    module: Literal["factory", "planners"]
    words: tuple[str, ...]


def steps_of(settings: AlternateSettings) -> Iterator[Step]:
    """All commands in their order."""
    s, clips = settings, settings.training_clips.split()
    for turn in range(s.turns):
        data, trained = s.data_of(turn), s.place("trained", turn)
        words = ["run", *clips, *s.data.split(), *(s.later.split() if turn else ()), *s.budget_of(turn)]
        yield Step(f"data/{turn}", "factory", (*words, f"out={data}"))
        tables = ",".join(dict.fromkeys(s.data_of(i) for i in range(turn + 1)))
        begins = [f"init_from={s.place('trained', turn - 1)}"] if turn else []
        learned = [f"data.real=[{s.data_of(0)}]", f"data.sim=[{tables}]", f"seed={s.seed}"]
        yield Step(f"trained/{turn}", "planners", ("train", *s.train.split(), *learned, *begins, f"out={trained}"))
        drives = ["explore", f"planner={trained}", *clips, *s.drive.split()]
        yield Step(f"explored/{turn}", "planners", (*drives, f"out={s.place('explored', turn)}"))
        if s.held_out_clips is not None:
            only_log = ["open_loop=false", "handover_s=[]"]
            drives = ["explore", f"planner={trained}", *s.drive.split(), *s.held_out_clips.split(), *only_log]
            yield Step(f"held_out/{turn}", "planners", (*drives, f"out={s.place('held_out', turn)}"))


@dataclass(frozen=True)
class Turn:
    """A line of turns.csv."""

    turn: int
    samples: int  # simulated ones so far
    explored_samples: int  # of them those that begin where a planner drove itself
    clips: int  # explored
    epdms: float  # of the planner's closed loop over the 4 s from T, mean over the clips
    fails: float  # share of these drives that the reward would reject
    drifts: int
    failing: int  # of them those from which the planner fails
    held_out_clips: int
    held_out_epdms: float | None
    held_out_fails: float | None


def turns_of(settings: AlternateSettings, ended: int) -> list[Turn]:
    """Of the first so many turns, from the tables alone."""
    found, explored = [], 0
    for turn in range(ended):
        if turn == 0 or not settings.is_one_table:
            tags = Store(settings.data_of(turn)).samples.read(["tags"])["tags"].to_pylist()
            explored += sum("explored" in of_one for of_one in tags)
        samples = read_record(Path(settings.place("trained", turn)))["samples"]["simulated"]
        own = _driven(settings.place("explored", turn))
        away = (
            _driven(settings.place("held_out", turn)) if settings.held_out_clips is not None else (0, None, None, 0, 0)
        )
        clips, epdms, fails, drifts, failing = own
        assert epdms is not None and fails is not None, "an explored turn has clips"
        found.append(Turn(turn, samples, explored, clips, epdms, fails, drifts, failing, *away[:3]))
    return found


def _driven(folder: str) -> tuple[int, float | None, float | None, int, int]:
    """Clips, mean EPDMS from the log, share of clips in which it fails, drifts, failing ones."""
    rows = open_explored(Location.parse(folder)).read([*FACTS, "score", "fails"]).to_pylist()
    n = len(rows)
    if n == 0:
        return 0, None, None, 0, 0
    counts = [sum(row[name] for row in rows) for name in ("n_drifts", "n_failing")]
    return n, sum(row["score"] for row in rows) / n, sum(bool(row["fails"]) for row in rows) / n, counts[0], counts[1]


def alternate(settings: AlternateSettings) -> list[Turn]:
    """Do what is left; the turns that are through. Raises ConfigError, Stopped, Failed."""
    out, steps = Path(settings.out), list(steps_of(settings))
    done = _done(out)
    known = {step.name: step for step in steps}
    for name, words in done.items():
        if name in known and words != list(known[name].words):
            raise ConfigError(f"{out}/{STEPS}: {name} was made with other settings: choose another out")
    out.mkdir(parents=True, exist_ok=True)
    means = Means(minutes=settings.minutes)
    per_turn = len(steps) // settings.turns
    with stops_after(means.left_s) as stop:
        for i, step in enumerate(steps):
            if step.name not in done:
                if stop.is_set():
                    raise Stopped(f"{i} of {len(steps)} steps are through: the same command goes on")
                print(f"{step.name}: python -m {step.module}", *step.words, file=sys.stderr, flush=True)
                code = exit_code([sys.executable, "-m", step.module, *step.words], stop.is_set)
                if code == INTERRUPTED or (code and stop.is_set()):
                    raise Stopped(f"{i} of {len(steps)} steps are through: the same command goes on")
                if code:
                    raise Failed(f"{step.name}: python -m {step.module} {step.words[0]} ended with exit code {code}")
                done[step.name] = list(step.words)
                (out / STEPS).write_text(json.dumps(done, indent=1) + "\n")
            if (i + 1) % per_turn == 0:
                _write(out / TURNS, turns_of(settings, (i + 1) // per_turn))
    return turns_of(settings, settings.turns)


def _done(out: Path) -> dict[str, list[str]]:
    path = out / STEPS
    found: dict[str, list[str]] = json.loads(path.read_text()) if path.is_file() else {}
    return found


def _write(path: Path, turns: Sequence[Turn]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([field.name for field in fields(Turn)])
        table.writerows([_shown(turn) for turn in turns])


def _shown(turn: Turn) -> list[str]:
    return ["" if value is None else f"{value:.4f}" if isinstance(value, float) else str(value) for value in _of(turn)]


def _of(turn: Turn) -> list[int | float | None]:
    return [getattr(turn, field.name) for field in fields(Turn)]


def told(turns: Sequence[Turn]) -> str:
    """The table of turns for a terminal."""
    lines = [[field.name for field in fields(Turn)], *map(_shown, turns)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def alternate_command(argv: Sequence[str]) -> None:
    """Do and print what a command line asks for. Raises ConfigError, Failed, Stopped."""
    settings = fill(AlternateSettings, compose("alternate", argv, AlternateSettings), "alternate")
    print(told(alternate(settings)))
    print(f"look at {settings.out}/{TURNS}; the planner is {settings.place('trained', settings.turns - 1)}")


main = command(alternate_command, AlternateSettings)
