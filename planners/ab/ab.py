"""`python -m planners ab`: does what you would add to your real samples make your planner better?

    python -m planners ab                                  the built-in town, in ten CPU minutes
    python -m planners ab mine.yaml                        your logs: conf/ab.yaml shows the keys
    python -m planners ab arms.recovery=null 'arms.mine={sim: [runs/mine]}'     an arm out, another in
    python -m planners ab mine.yaml minutes=25             a part of it; the same command goes on
    python -m planners ab rows=runs/ab/report              the report again, of its rows; nothing is trained

Every arm learns from the same real samples and what it adds, for equally many optimiser steps, with the same seeds, and
is scored on towns or logs that it did not learn from: by the two-stage EPDMS and, with drives=, in closed loop. With
folds= each town or log is held out once. Constant velocity, going straight and PDM-Closed stand beside them.

Into out/report go

    ab.md        the verdict in one sentence, tables by arm and by town or log
    ab.svg       the same as a picture
    *.parquet    every frame and every drive, of which all of it is made

Exit codes: 0 complete, 2 settings or files that do not fit, 3 a training, evaluation or drive failed, 4 interrupted or
out of minutes, and the same command goes on.
"""

import os
import resource
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.arguments import command
from factory.config.compose import ConfigError, need_run_extra
from factory.exits import INTERRUPTED, Failed, Stopped
from factory.graph.own_process import run_command_in_own_process
from factory.graph.parallel import parallel_map
from factory.graph.steps import TaskStopped
from factory.store.location import Location
from factory.store.samples import FACTS
from factory.wording import time_text
from planners.ab.report import BASELINES, write_report
from planners.ab.rows import DRIVE_SCHEMA, Trained, cluster_of, frames_of, write_ab_rows
from planners.ab.settings import AbSettings, Arm, settings_of
from planners.data.index import Dataset, DataSettings, open_dataset
from planners.evaluation.benchmark_folder import read_clip_logs
from planners.evaluation.planner_names import find_planner
from planners.training.checkpoint import read_record
from planners.training.many import (
    ALONE,
    TRAININGS,
    Training,
    folder_of,
    is_done,
    run_process,
    stop_event,
    train_all,
    train_one,
)

EVALUATIONS, DRIVES, REPORT, TOLD = "evaluations", "drives", "report", "commands.log"
UNTRAINED = {"go_straight": "planners.models.baselines:GoStraight"}  # the other baselines are the commands' own bounds


def folds_of(settings: AbSettings, logs: Sequence[str]) -> list[frozenset[str]]:
    """The clusters of each part; one part of all where none are held out in turn. Raises ConfigError."""
    clusters = sorted({cluster_of(log) for log in logs})
    if settings.folds is None:
        return [frozenset(clusters)]
    n = len(clusters) if settings.folds == "each" else settings.folds
    if len(clusters) < max(n, 2):
        raise ConfigError(f"folds={settings.folds}: the benchmark is of {len(clusters)} towns or logs, too few")
    return [frozenset(clusters[i::n]) for i in range(n)]


def check_apart(settings: AbSettings, logs: Sequence[str]) -> None:
    """Raises ConfigError where an arm learns from what it is scored on."""
    held = {cluster_of(log) for log in logs}
    for name, arm in settings.chosen.items():
        if shared := sorted(held & {cluster_of(log) for log in opened(settings, arm).rows.log_id.tolist()}):
            raise ConfigError(
                f"arm {name} learns from {shared[0]}{f' and {len(shared) - 1} more' if shared[1:] else ''}, which the "
                "benchmark holds: make it of other towns or logs, or give folds=each to hold each out once"
            )


def data_of(settings: AbSettings, arm: Arm) -> DataSettings:
    """The tables of an arm."""
    real = [settings.table(name) for name in (*settings.real, *arm.real)]
    return DataSettings(real=tuple(real), sim=tuple(map(settings.table, arm.sim)), experts=arm.experts)


def opened(settings: AbSettings, arm: Arm) -> Dataset:
    """Its samples. Raises ValueError, FileNotFoundError."""
    return open_dataset(data_of(settings, arm))


def planned(settings: AbSettings, folds: Sequence[frozenset[str]]) -> list[Training]:
    """Every training, seed by seed. Raises ValueError where a table lacks what an arm asks for."""
    data = {name: opened(settings, arm) for name, arm in settings.chosen.items()}
    found = []
    held_out = [_logs_in(data.values(), fold) if settings.folds else () for fold in folds]
    limits = [_limits(settings, data, logs) for logs in held_out]
    for seed in range(settings.seeds):
        for number, (logs, limit) in enumerate(zip(held_out, limits)):
            for name, arm in settings.chosen.items():
                chosen = data_of(settings, arm)
                tables = {"real": chosen.tables("real"), "sim": chosen.tables("sim"), "experts": chosen.experts}
                words = [f"data.{key}=[{','.join(value)}]" for key, value in tables.items()]
                words += [f"data.limit_sim={limit[name]}"] if limit[name] else []
                words += [f"data.without_logs=[{','.join(logs)}]"] if logs else []
                for planner, own in settings.planners.items():
                    first = [*own.split(), *settings.train.split(), *words, *arm.train.split()]
                    overrides = (*first, f"steps={settings.steps}", f"seed={seed}")
                    label = f"{planner}-{name}-{seed}" + (f"-{number}" if settings.folds else "")
                    facts = {"planner": planner, "arm": name, "seed": seed, "fold": number}
                    found.append(Training(label, overrides, facts))
    return found


def _logs_in(data: Any, fold: frozenset[str]) -> tuple[str, ...]:
    """Logs of all tables that a fold holds out."""
    logs = {str(log) for one in data for log in np.unique(one.rows.log_id)}
    return tuple(sorted(log for log in logs if cluster_of(log) in fold))


def _limits(settings: AbSettings, data: Mapping[str, Dataset], held_out: Sequence[str]) -> dict[str, int | None]:
    """How many simulated samples each arm may take; None: all that it has, or none."""
    there = {name: int((one.rows.simulated & ~np.isin(one.rows.log_id, held_out)).sum()) for name, one in data.items()}
    if settings.added == "all":
        return dict.fromkeys(there)
    own = {name: arm.added for name, arm in settings.chosen.items()}
    most = min((n for name, n in there.items() if n and own[name] is None), default=0)
    most = most if settings.added == "fewest" else settings.added
    return {name: min(n, own[name] or most) or None for name, n in there.items()}


def runs_ahead(settings: AbSettings) -> str:
    """What the factory's runs that are not there yet will take, by three clips of each, and how much is to train then.

    Nothing is made, but the blocks of these clips where they are rendered. Raises Stopped, Failed.
    """
    out, told = Path(settings.out), list[str]()
    for name, words in settings.runs.items():
        if not (out / name / FACTS).is_file():
            said = _call(settings, "factory", "plan", *words.split(), f"out={out / name}").splitlines()
            told += [f"{name}: {line}" for line in said if line.startswith("expected for")]
    n = settings.seeds * len(settings.chosen) * len(settings.planners)
    parts = "log" if settings.folds == "each" else f"of {settings.folds} parts"
    each = f", for each {parts} that is held out" if settings.folds else ""
    told.append(f"then {n} trainings of {settings.steps} steps{each}: the first says what they cost")
    return "\n".join(["to be made:", *told])


def make_runs(settings: AbSettings) -> None:
    """Runs of the factory that are not complete yet. Raises Stopped, Failed."""
    for name, words in settings.runs.items():
        how = [f"executor={settings.executor}", *settings.overrides_left]
        _call(settings, "factory", "run", *words.split(), *how, f"out={Path(settings.out) / name}")


def _call(settings: AbSettings, *words: str) -> str:
    """What one command of this product says, in a process of its own, into a file. Raises Stopped, Failed."""
    told = Path(settings.out) / TOLD
    told.parent.mkdir(parents=True, exist_ok=True)
    print(f"python -m {' '.join(words[:2])}: see {told}", file=sys.stderr)
    with stop_event(settings.left_s) as stop, told.open("a+") as file:
        print(f"\n$ {shlex.join(('python', '-m', *words))}", file=file, flush=True)
        begins = file.tell()
        command = [sys.executable, "-m", *words]
        code = run_process(command, stop.is_set, file, environment=ALONE | os.environ)
        if code == INTERRUPTED or stop.is_set():
            raise Stopped("the same command goes on")
        file.seek(begins)
        said = file.read()
    if code:
        raise Failed(f"python -m {words[0]} {words[1]} ended with exit code {code}")
    return said


def train(settings: AbSettings, trainings: Sequence[Training]) -> None:
    """What is not trained yet, here or on the nodes of a cluster. Raises Stopped, Failed."""
    out = Path(settings.out)
    if settings.executor == "local":
        return train_all(trainings, out, settings)
    left = [one for one in trainings if not is_done(out, one)]
    try:
        for label, code in parallel_map(
            partial(_train_there, out=out), left, "ray", settings.jobs, Location.parse(out)
        ):
            if code:
                raise Failed(f"{label} ended with exit code {code}: see {out / 'trainings' / label / 'train.log'}")
    except TaskStopped as error:
        raise Stopped("the same command goes on") from error


def _train_there(one: Training, out: Path) -> tuple[str, int]:
    return one.label, train_one(one, out)


@dataclass(frozen=True)
class Part:
    """What one fold is scored on of one benchmark."""

    benchmark: int  # place in the settings
    fold: int
    logs: tuple[str, ...]

    def folder(self, out: Path) -> Path:
        """Of the evaluated planners."""
        return out / EVALUATIONS / f"{self.benchmark}-{self.fold}"


def parts_of(folds: Sequence[frozenset[str]], logs: Sequence[Sequence[str]]) -> list[Part]:
    """Every fold's logs of every benchmark, whose logs are given, where it has any."""
    return [
        Part(place, number, held)
        for number, fold in enumerate(folds)
        for place, there in enumerate(logs)
        if (held := tuple(sorted({log for log in there if cluster_of(log) in fold})))
    ]


def score(
    settings: AbSettings, trainings: Sequence[Training], parts: Sequence[Part], executor: str | None = None
) -> None:
    """Evaluate and drive these, each where it did not learn. Raises Stopped, Failed."""
    out = Path(settings.out)
    for part in parts:
        mine = {one.label: str(folder_of(out, one)) for one in trainings if one.facts["fold"] == part.fold}
        named = ",".join(f"{label}: '{spec}'" for label, spec in {**UNTRAINED, **mine}.items())
        words = [f"planners={{{named}}}", *([f"only_logs=[{','.join(part.logs)}]"] if settings.folds else [])]
        benchmark = f"benchmark={settings.table(settings.benchmark[part.benchmark])}"
        _call(settings, "planners", "evaluate", benchmark, *words, "tables=false", f"out={part.folder(out)}")
        if settings.drives:
            how = [f"executor={executor or settings.executor}", f"workers={settings.at_once}", f"out={out / DRIVES}"]
            _call(settings, "planners", "drive", *settings.drives[part.benchmark].split(), *how, *words)


def cost_ahead(settings: AbSettings, trainings: Sequence[Training], parts: Sequence[Part]) -> str:
    """What those to come will cost, by the first of each planner, which this makes and scores, here also on Ray.

    Too much rather than too little: those of a seed start their evaluation and their drives together.
    Raises Stopped, Failed.
    """
    out, total_s, told = Path(settings.out), 0.0, list[str]()
    left = [one for one in trainings if not is_done(out, one)]
    score(settings, [], parts, "local")  # baselines, which are driven once for all
    for name in settings.planners:
        if mine := [one for one in left if one.facts["planner"] == name]:
            began_s = _spent_s()
            train_all(mine[:1], out, settings)
            trained_s = _spent_s()
            score(settings, mine[:1], [part for part in parts if part.fold == mine[0].facts["fold"]], "local")
            each_s = trained_s - began_s, _spent_s() - trained_s
            told.append(f"{len(mine) - 1} of {name}, {each_s[0]:.0f} CPU s to train and {each_s[1]:.0f} to score each")
            total_s += (len(mine) - 1) * sum(each_s)
    return (
        f"still to train: {'; '.join(told) or 'none'}: at most {time_text(total_s)} of CPU, "
        f"{time_text(total_s / settings.at_once)} at {settings.at_once} at once (less: arms.<name>=null or seeds=; "
        "in parts: minutes=)"
    )


def _spent_s() -> float:
    """CPU seconds of all processes that were waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


def report(
    settings: AbSettings, trainings: Sequence[Training], folds: Sequence[frozenset[str]], parts: Sequence[Part]
) -> str:
    """Keep the rows of these, every clip by who did not learn from it, and write the report; its text."""
    out = Path(settings.out)
    held = {one.label: (trained_of(one, out), folds[one.facts["fold"]]) for one in trainings}
    trained: dict[str, Trained] = {}
    for who, _ in held.values():
        trained.setdefault(who.label, who)
    together = sorted(trainings, key=lambda one: held[one.label][0].label)  # the folds of one one behind the other
    frames = [
        frames_of(part.folder(out) / one.label, held[one.label][0].label)
        for one in together
        for part in parts
        if part.fold == one.facts["fold"]
    ]
    frames += [frames_of(part.folder(out) / name, name) for name in BASELINES for part in parts]
    drives = []
    if settings.drives:
        wanted: dict[str, list[tuple[str, frozenset[str] | None]]] = {
            find_planner(UNTRAINED.get(name, name)).digest: [(name, None)] for name in BASELINES
        }
        for label, (who, fold) in held.items():
            digest = find_planner(str(out / TRAININGS / label)).digest
            wanted.setdefault(digest, []).append((who.label, fold if settings.folds else None))
        drives = _drive_rows(out / DRIVES, wanted)
    asked = {name: getattr(settings, name) for name in ("reference", "claim", "confidence", "steps")}
    write_ab_rows(out / REPORT, list(trained.values()), asked, frames, drives)
    return write_report(out / REPORT)


def trained_of(one: Training, out: Path) -> Trained:
    """Under whose label its rows stand, that of all folds of an arm, a planner and a seed; samples of its own fold."""
    samples = read_record(folder_of(out, one))["samples"]
    facts = one.facts
    return Trained(facts["planner"], facts["arm"], facts["seed"], samples["real"], samples["simulated"])


def _drive_rows(
    folder: Path, wanted: Mapping[str, Sequence[tuple[str, frozenset[str] | None]]]
) -> list[dict[str, Any]]:
    """Of the table of drives, under the labels of who drove; of a fold's planner those of the clips held out."""
    from planners.drive.work import FACTS, open_drives  # with PyTorch

    found = []
    for row in open_drives(Location.parse(folder)).read(FACTS).to_pylist():
        for label, fold in wanted.get(row["planner_digest"], ()):
            if fold is None or cluster_of(row["log_id"]) in fold:
                found.append({name: row.get(name) for name in DRIVE_SCHEMA.names} | {"training": label})
    return found


def experiment(settings: AbSettings) -> None:
    """All that is missing, seed by seed, and the report of the seeds that are whole. Raises as its parts."""
    if settings.rows is not None:
        print(write_report(Path(settings.rows)))
        return
    print(runs_ahead(settings), file=sys.stderr)
    make_runs(settings)
    by_benchmark = [list(read_clip_logs(settings.table(name)).values()) for name in settings.benchmark]
    logs = [log for there in by_benchmark for log in there]
    if settings.folds is None:
        check_apart(settings, logs)
    folds = folds_of(settings, logs)
    parts = parts_of(folds, by_benchmark)
    wanted = planned(settings, folds)
    print(
        f"{settings.seeds} seeds of {len(wanted) // settings.seeds} trainings, {settings.steps} steps each; told "
        f"of {len(logs)} clips in {len(parts)} parts",
        file=sys.stderr,
    )
    done: list[Training] = []
    stopped = None
    try:
        print(cost_ahead(settings, wanted, parts), file=sys.stderr)
        for seed, batch in groupby(wanted, key=lambda one: one.facts["seed"]):
            mine, began = list(batch), time.monotonic()
            train(settings, mine)
            score(settings, mine, parts)
            done += mine
            took = time_text(time.monotonic() - began)
            print(f"seed {seed}: {took}; {settings.seeds - seed - 1} more are to come", file=sys.stderr)
    except Stopped as error:
        stopped = error
    if done:
        print(report(settings, done, folds, parts))
    if stopped:
        raise stopped


@command("ab", AbSettings)
def main(argv: Sequence[str]) -> int | None:
    """The command. Raises ConfigError, Stopped, Failed."""
    settings = settings_of(argv)
    if settings.executor == "ray":
        need_run_extra("ray")
        return run_command_in_own_process(_main_on_ray, tuple(argv))
    experiment(settings)
    return None


def _main_on_ray(argv: Sequence[str]) -> int:
    return replace(main, does=lambda words: experiment(settings_of(words)))(argv)
