"""Many trainings, resumable: what is done is not done again.

A training is a process of `python -m planners train`; `jobs` of them run side by side.
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
from typing import Any, ClassVar, TextIO

from factory.exits import INTERRUPTED, Failed, Stopped, calling_on_stop_signal
from factory.graph.progress import RateBar

TRAININGS, DONE, LOG = "trainings", "sweep.json", "train.log"
LOOK_EVERY_S = 0.5
# Of each process, unless the user says otherwise. glibc gives large arrays back to the system after every step and asks
# for them again, which of a small training is a sixth of its CPU seconds.
ALONE = {"OMP_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": str(2**30), "MALLOC_TRIM_THRESHOLD_": str(2**32)}


@dataclass(frozen=True)
class Training:
    """One planner of a sweep."""

    label: str  # names its folder; unique in the sweep
    overrides: tuple[str, ...] = ()  # of planners.training.train, but `out`
    facts: Mapping[str, Any] = field(default_factory=dict)  # what it is


@dataclass(frozen=True)
class SweepResources:
    """How a sweep runs."""

    jobs: int | None = None  # trainings at a time; null: one a core
    minutes: float | None = None  # after which nothing new begins and what runs is saved; the same command goes on
    began: ClassVar[float]  # what the minutes are counted from; of each, but no setting

    def __post_init__(self) -> None:
        object.__setattr__(self, "began", time.monotonic())

    @property
    def at_once(self) -> int:
        """Processes."""
        return self.jobs or os.cpu_count() or 1

    @property
    def left_s(self) -> float | None:
        """Until nothing new begins."""
        return None if self.minutes is None else max(0.0, self.began + 60.0 * self.minutes - time.monotonic())

    @property
    def overrides_left(self) -> list[str]:
        """What is left, for another command."""
        return [] if self.left_s is None else [f"minutes={self.left_s / 60.0:.3f}"]


def folder_of(out: Path, training: Training) -> Path:
    """Where a training lies under the sweep's folder."""
    return out / TRAININGS / training.label


def is_done(out: Path, training: Training) -> bool:
    """Whether it was trained to its end with these overrides."""
    path = folder_of(out, training) / DONE
    return path.is_file() and json.loads(path.read_text()) == list(training.overrides)


def train_all(trainings: Sequence[Training], out: Path, resources: SweepResources) -> None:
    """Train what is not done.

    Raises ValueError for two trainings of one label, Stopped where time ran out or somebody interrupted before all
    were, Failed with what each failed training said last.
    """
    labels = [training.label for training in trainings]
    if twice := sorted({label for label in labels if labels.count(label) > 1}):
        raise ValueError(f"labels {twice} stand for several trainings")
    left = [training for training in trainings if not is_done(out, training)]
    done, failed = len(trainings) - len(left), list[str]()
    with (
        RateBar("trainings", len(trainings), done) as counter,
        stop_event(resources.left_s) as stop,
        ThreadPoolExecutor(resources.at_once) as pool,
    ):
        codes = {pool.submit(train_one, training, out, stop.is_set): training for training in left}
        for future in as_completed(codes):
            training, code = codes[future], future.result()
            if code == 0:
                done += 1
            elif code != INTERRUPTED:
                failed.append(f"{training.label} (exit {code}): {_last_words(folder_of(out, training) / LOG)}")
            counter.show(done, training.label)
    if failed:
        raise Failed("; ".join(failed))
    if done < len(trainings):
        raise Stopped(f"{done} of {len(trainings)} are trained: the same command goes on")


def train_one(training: Training, out: Path, stop: Callable[[], bool] = lambda: False) -> int:
    """Train one in a process of its own and note that it is done; returns its exit code."""
    if stop():
        return INTERRUPTED
    folder = folder_of(out, training)
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "planners", "train", *training.overrides, f"out={folder}"]
    with (folder / LOG).open("w") as log:
        code = run_process(command, stop, log, log, ALONE | os.environ)
    if stop() and code == -signal.SIGTERM:  # it had not begun yet
        return INTERRUPTED
    if code == 0:
        (folder / DONE).write_text(json.dumps(list(training.overrides)))
    return code


def run_process(
    command: Sequence[str],
    stop: Callable[[], bool],
    stdout: TextIO | None = None,
    stderr: TextIO | None = None,
    environment: Mapping[str, str] | None = None,
) -> int:
    """Of a process, which is asked to end as soon as `stop` says so, and then waited for.

    Its session is its own: what a terminal sends reaches it through `stop` alone, and once.
    """
    child = subprocess.Popen(  # noqa: S603
        command, stdout=stdout, stderr=stderr, env=environment, start_new_session=True
    )
    asked = False
    while True:
        try:
            return child.wait(LOOK_EVERY_S)
        except subprocess.TimeoutExpired:
            if stop() and not asked:
                child.send_signal(signal.SIGTERM)
                asked = True


@contextlib.contextmanager
def stop_event(after_s: float | None) -> Iterator[threading.Event]:
    """Set after so many seconds, or at SIGINT and SIGTERM."""
    stop = threading.Event()
    timer = threading.Timer(after_s or 0.0, stop.set)
    timer.daemon = True
    with calling_on_stop_signal(stop.set):
        if after_s is not None:
            timer.start()
        try:
            yield stop
        finally:
            timer.cancel()


def _last_words(log: Path) -> str:
    lines = log.read_text().strip().splitlines() if log.is_file() else []
    return lines[-1] if lines else "it said nothing"
