"""Many trainings and their evaluation, resumable: what is done is not done again.

A training is a process of `python -m planners train`; on one machine `jobs` of them run side by side, on a Ray cluster
each is a task. All are then evaluated on one benchmark by one process, which prepares every frame once.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from planners.evaluation import record as eval_record
from planners.evaluation.contenders import contender
from planners.evaluation.scores import BOUNDS
from planners.training.progress import Counter

TRAININGS, EVALUATIONS, DONE, LOG = "trainings", "evaluations", "sweep.json", "train.log"
INTERRUPTED = 4
EVALUATED_TOGETHER = 24  # planners in one process at the most
LOOK_EVERY_S = 0.5


@dataclass(frozen=True)
class Training:
    """One training of a sweep."""

    label: str  # names its folder; unique in the sweep
    overrides: tuple[str, ...]  # of planners.training.train, but `out`
    facts: Mapping[str, Any] = field(default_factory=dict)  # its columns in the sweep's tables


@dataclass(frozen=True)
class Means:
    """How a sweep runs."""

    executor: Literal["process", "ray"] = "process"
    jobs: int | None = None  # at a time; None: one a core
    minutes: float | None = None  # after which nothing new begins, and what runs is saved and stopped
    gpus: float = 0.0  # of each training on Ray
    cpus: float = 1.0
    began: float = field(default_factory=time.monotonic)  # what the minutes are counted from

    @property
    def at_once(self) -> int:
        """Processes."""
        return self.jobs or os.cpu_count() or 1

    @property
    def left_s(self) -> float | None:
        """Until nothing new begins."""
        return None if self.minutes is None else max(0.0, self.began + 60.0 * self.minutes - time.monotonic())


class SweepFailed(Exception):
    """Trainings that ended with an error; the others are done."""


def folder_of(out: Path, training: Training) -> Path:
    """Where a training lies under the sweep's folder."""
    return out / TRAININGS / training.label


def is_done(out: Path, training: Training) -> bool:
    """Whether it was trained to its end with these overrides."""
    path = folder_of(out, training) / DONE
    return path.is_file() and json.loads(path.read_text()) == list(training.overrides)


def train_all(trainings: Sequence[Training], out: Path, means: Means) -> bool:
    """Train what is not done; False where time ran out or somebody interrupted before all were.

    Raises ValueError for two trainings of one label, SweepFailed with what each failed training said last.
    """
    labels = [training.label for training in trainings]
    if len(set(labels)) < len(labels):
        raise ValueError(f"labels {sorted({x for x in labels if labels.count(x) > 1})} stand for several trainings")
    left = [training for training in trainings if not is_done(out, training)]
    before = len(trainings) - len(left)
    stop = threading.Event()
    failed: list[str] = []
    with Counter("trainings", len(trainings), before) as counter, _stops(stop, means.left_s):
        done = before
        for training, code in _codes(left, out, means, stop):
            if code == 0:
                done += 1
            elif code != INTERRUPTED:
                failed.append(f"{training.label} (exit {code}): {_last_words(folder_of(out, training) / LOG)}")
            counter.show(done, training.label)
    if failed:
        raise SweepFailed("; ".join(failed))
    return all(is_done(out, training) for training in trainings)


def train_one(training: Training, out: Path, stop: Callable[[], bool] = lambda: False) -> int:
    """Train one in a process of its own and note that it is done; returns its exit code."""
    if stop():
        return INTERRUPTED
    folder = folder_of(out, training)
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "planners", "train", *training.overrides, f"out={folder}"]
    with (folder / LOG).open("w") as log:
        environment = {"OMP_NUM_THREADS": "1", **os.environ}
        child = subprocess.Popen(command, stdout=log, stderr=log, env=environment)  # noqa: S603 - a list, no shell
        asked = False
        while (code := _ended(child, LOOK_EVERY_S)) is None:
            if stop() and not asked:
                child.send_signal(signal.SIGTERM)
                asked = True
    if asked and code == -signal.SIGTERM:  # it had not begun yet
        return INTERRUPTED
    if code == 0:
        (folder / DONE).write_text(json.dumps(list(training.overrides)))
    return code


def _ended(child: subprocess.Popen[bytes], within_s: float) -> int | None:
    """Its exit code as soon as there is one; None where it goes on for longer."""
    try:
        return child.wait(within_s)
    except subprocess.TimeoutExpired:
        return None


def _codes(
    trainings: Sequence[Training], out: Path, means: Means, stop: threading.Event
) -> Iterator[tuple[Training, int]]:
    """Exit codes as trainings end."""
    if means.executor == "ray":
        from planners.training.on_ray import each_on_ray

        yield from each_on_ray(train_one, trainings, out, means.cpus, means.gpus, stop)
        return
    with ThreadPoolExecutor(means.at_once) as pool:
        futures = {pool.submit(train_one, training, out, stop.is_set): training for training in trainings}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextlib.contextmanager
def _stops(stop: threading.Event, after_s: float | None) -> Iterator[None]:
    """Sets the event after so many seconds, or at SIGINT and SIGTERM."""
    timer = threading.Timer(after_s, stop.set) if after_s is not None else None
    old: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            old[number] = signal.signal(number, lambda *_: stop.set())
    if timer is not None:
        timer.daemon = True
        timer.start()
    try:
        yield
    finally:
        if timer is not None:
            timer.cancel()
        for what, handler in old.items():
            signal.signal(what, handler)


def evaluate_all(
    trainings: Sequence[Training],
    out: Path,
    benchmark: str,
    *more: str,
    others: Mapping[str, str] | None = None,
    means: Means | None = None,
) -> bool:
    """Evaluate all trainings on a benchmark, into `out`/evaluations; those that are evaluated already are not again.

    Processes of planners.evaluation.evaluate share the planners, a few each at a time, so that a kill costs little.
    more: overrides of theirs; others: further planners, by label. False where time ran out or somebody interrupted
    before all were. Raises SweepFailed.
    """
    means, stop = means or Means(), threading.Event()
    who = [(training.label, str(folder_of(out, training))) for training in trainings] + list((others or {}).items())
    parts = shares_of(who, means.at_once)
    base = [sys.executable, "-m", "planners", "evaluate", f"benchmark={benchmark}", *more, f"out={out / EVALUATIONS}"]
    environment = {"OMP_NUM_THREADS": "1", **os.environ}

    def evaluate(part: Sequence[tuple[str, str]], *how: str) -> bool:
        if stop.is_set():
            return False
        named = ",".join(f"{label}: '{spec}'" for label, spec in part)
        command = [*base, f"planners={{{named}}}", *how]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True)  # noqa: S603 - a list, no shell
        if ended.returncode != 0:
            raise SweepFailed(f"the evaluation ended with exit {ended.returncode}: {ended.stderr.strip()[-500:]}")
        return True

    with (
        Counter("evaluations", len(who)) as counter,
        ThreadPoolExecutor(means.at_once) as pool,
        _stops(stop, means.left_s),
    ):
        done = 0
        ends = pool.map(lambda part: evaluate(part, "bounds=false", "tables=false"), parts)
        for part, was_done in zip(parts, ends):
            done += len(part) * was_done
            counter.show(done)
        return done == len(who) and evaluate(who)  # nothing is left but the bounds and the tables of all


def shares_of(who: Sequence[tuple[str, str]], at_once: int) -> list[Sequence[tuple[str, str]]]:
    """What each process evaluates, taken in turn: neighbours are of one kind, and kinds take different times."""
    n = min(at_once * -(-len(who) // (at_once * EVALUATED_TOGETHER)), len(who))
    return [who[i::n] for i in range(n)]


def is_evaluated(out: Path, label: str, spec: str) -> bool:
    """Whether who `spec` names stands under `label` as it is now, evaluated as the bounds were last."""
    bound, mine = (out / EVALUATIONS / name for name in (BOUNDS[-1], label))
    if not (bound / eval_record.RECORD).is_file():
        return False
    shared = {k: v for k, v in eval_record.read_record(bound).items() if k not in ("planner", "planner_digest")}
    return eval_record.is_done(mine, {"planner_digest": contender(spec).digest, **shared})


def _last_words(log: Path) -> str:
    lines = log.read_text().strip().splitlines() if log.is_file() else []
    return lines[-1] if lines else "it said nothing"
