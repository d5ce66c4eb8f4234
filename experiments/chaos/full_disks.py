"""Little space at 20 levels in each place that a run writes to: `python -m experiments.chaos.full_disks ...`.

The place is a file system of its own (tmpfs; only root may mount one), with from nothing to nearly all of what an
undisturbed run takes there, in even steps. A run there is to end as complete, or with exit code 4 and one line, or to
be refused with nothing written; never with a traceback. Then what it committed is held against the undisturbed run and
by verify, space is given, and the same command must end complete, with the same tables. Places:

    out       of the synthetic town, executor=local; runs ask for 4 MB before they begin
    graph     `out` again, of toy samples, which ask for nothing before they begin
    cache     the user's cache, of the synthetic town; compiled kernels lie elsewhere
    tmp       temporary files and Ray's own, of toy samples on Ray
    shm       shared memory, of toy samples on Ray
    shm-later shared memory that others fill once the first clip is being prepared
"""

import ctypes
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow.compute as pc

from experiments.chaos.processes import below, kill, put_away
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.graph.execute import Execution, Executor, execute, rerun_on_new_clusters
from factory.graph.steps import PreparedClip
from factory.readers.base import ClipRef
from factory.run import main as run_main
from factory.store.samples import Store
from factory.store.verify import verify
from tasks.caches import user_cache
from tasks.stages import Rejected
from tests.chaos.trials import Findings, leave_by, untold
from tests.factory.tables import assert_same_rows, tables_of
from tests.factory.toy import ToyWork, ran, refs

LEVELS, PAGE, ENOUGH = 20, 4096, 16 * 2**30  # the last: more than Ray's object store asks for
OVER_S = 120.0
IMPORTS = ["factory.setup.settings", "factory.setup.calibrate", "factory.stages.benchmark", "tests.factory.toy"]
WORDS = 2000  # characters of what a run said that a finding is told with
SAID = re.compile(r"^error: |run the same command")
TOLD = {
    COMPLETE: "complete",
    COMPLETE_WITH_FAILURES: "with failures",
    INTERRUPTED: "exit code 4",
    BAD_CONFIG: "refused",
}
NEW_NAMESPACE = 0x00020000  # CLONE_NEWNS
SHM = Path("/dev/shm")
TOWN = ["clips.n_clips=3", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none"]
TOWN += ["vocabulary.k=128", "rounds=2", "executor=local", "shard_seconds=0.001"]
BALLAST = 2**20  # bytes of a prepared clip of the toys: what Ray keeps in shared memory


@dataclass(frozen=True)
class HeavyWork(ToyWork):
    """Clips that are large enough for Ray to keep them in shared memory."""

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        clip = super().prepare(ref)
        if isinstance(clip, Rejected):
            return clip
        assert isinstance(clip.payload, dict)
        ballast = np.random.default_rng(ref.start_ms).integers(0, 255, BALLAST, np.uint8)
        return replace(clip, payload={**clip.payload, "ballast": ballast})


def town(out: str, journal: str) -> int:
    """The whole command."""
    return run_main([*TOWN, f"out={out}"])


def toys(out: str, journal: str, executor: Executor = "local") -> int:
    """What it does, after its settings are read."""
    kind, seconds = (HeavyWork, 0.02) if executor == "ray" else (ToyWork, 0.0)
    work = kind(threshold=0.4, journal=journal, seconds=seconds)
    given = work, refs(8), ["recovery", "human"], 2
    how = Execution(executor, 2, shard_seconds=0.05)
    summary = rerun_on_new_clusters(lambda: execute(*given, Store(out), how, say=str), say=str)
    if summary.message:
        print(f"error: {summary.message}", file=sys.stderr)
    return summary.exit_code


def toys_on_ray(out: str, journal: str) -> int:
    return toys(out, journal, "ray")


@dataclass(frozen=True)
class Place:
    """Where there is little space, and which run meets it."""

    run: Callable[[str, str], int]
    again: Callable[[str, str], int]  # the same run, where it may be quicker
    variable: str = ""  # of the environment that names the place; empty: it is `out`, or shared memory
    is_memory: bool = False
    is_later: bool = False


PLACES = {
    "out": Place(town, town),
    "graph": Place(toys, toys),
    "cache": Place(town, town, "XDG_CACHE_HOME"),
    "tmp": Place(toys_on_ray, toys, "TMPDIR"),
    "shm": Place(toys_on_ray, toys, is_memory=True),
    "shm-later": Place(toys_on_ray, toys, is_memory=True, is_later=True),
}


def mount(folder: Path, n_bytes: int) -> None:
    """A file system of its own with so many bytes free."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={PAGE + n_bytes}", "tmpfs", str(folder)], check=True)
    (folder / ".filler").write_bytes(bytes(PAGE))  # of no size at all it would have no end


def resize(folder: Path, n_bytes: int) -> None:
    """So many bytes are free from now on."""
    size = _used(folder) + n_bytes
    subprocess.run(["mount", "-o", f"remount,size={size}", str(folder)], check=True)


def _used(folder: Path) -> int:
    found = os.statvfs(folder)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


@dataclass(frozen=True)
class Trial:
    """A run in a process of its own."""

    name: str  # of its place
    n_bytes: int  # free there
    folder: Path  # of all its files
    is_again: bool = False  # once there is space

    @property
    def place(self) -> Place:
        return PLACES[self.name]

    @property
    def disk(self) -> Path:
        return SHM if self.place.is_memory else self.folder / "disk"

    @property
    def out(self) -> Path:
        return self.folder / ("out" if self.place.variable or self.place.is_memory else "disk/out")

    def file(self, name: str) -> Path:
        return self.folder / (f"again.{name}" if self.is_again else name)


def work(trial: Trial) -> NoReturn:
    """The run, where there is little space."""
    leave_by(partial(_run, trial), trial.file("words"))


def _run(trial: Trial) -> int:
    place = trial.place
    if place.is_memory and not trial.is_again:
        if ctypes.CDLL(None, use_errno=True).unshare(NEW_NAMESPACE):
            raise OSError(ctypes.get_errno(), "no file systems of its own")
        subprocess.run(["mount", "--make-rprivate", "/"], check=True)
        mount(SHM, ENOUGH if place.is_later else trial.n_bytes)
    if place.variable:
        os.environ.setdefault("NUMBA_CACHE_DIR", str(user_cache()))  # which takes minutes to fill
        os.environ[place.variable], tempfile.tempdir = str(trial.disk), None
    if not trial.is_again:
        threading.Thread(target=_watch, args=(trial,), daemon=True).start()
    run = place.again if trial.is_again else place.run
    return run(str(trial.out), str(trial.file("journal")))


def _watch(trial: Trial) -> None:
    """Notes the most that was used at the place; later: fills it."""
    most = at_first = _used(trial.disk)
    is_left = trial.place.is_later and trial.n_bytes < ENOUGH
    while True:
        time.sleep(0.005)
        if is_left and ran(str(trial.file("journal")), "prepare"):
            resize(trial.disk, trial.n_bytes)
            is_left = False
        if (used := _used(trial.disk)) > most:
            most = used
            trial.file("most").write_text(str(most - at_first))


def exit_code(trial: Trial) -> int:
    """Of its run; raises AssertionError where it has none after OVER_S."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(IMPORTS)
    process = context.Process(target=work, args=(trial,))
    process.start()
    assert process.pid is not None
    others: dict[int, str] = {}
    end = time.monotonic() + OVER_S
    while process.is_alive() and time.monotonic() < end:
        others |= below(process.pid)
        process.join(0.5)
    is_over = process.is_alive()
    if is_over:
        kill(process.pid)
        process.join()
    put_away(others)
    assert not is_over, f"no end in {OVER_S:.0f} s"
    assert process.exitcode is not None
    return process.exitcode


def needed(name: str, folder: Path) -> tuple[int, Path]:
    """Bytes that an undisturbed run takes at the place at once, and its `out`. In the folder, which is made."""
    trial = Trial(name, ENOUGH, folder)
    with _mounted(trial):
        assert exit_code(trial) == COMPLETE, trial.file("words").read_text()
        shutil.copytree(trial.out, folder / "undisturbed")
    return int(trial.file("most").read_text()) if trial.file("most").exists() else 0, folder / "undisturbed"


@contextmanager
def _mounted(trial: Trial) -> Iterator[None]:
    (trial.folder / "disk").mkdir(parents=True)
    if trial.place.is_memory:  # in a name space that goes with its process
        yield
        return
    mount(trial.disk, trial.n_bytes)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(trial.disk)], check=True)


def at_level(name: str, n_bytes: int, golden: Path, folder: Path) -> str:
    """complete, 4, refused, or what is wrong. In the folder, which is made and removed."""
    trial = Trial(name, n_bytes, folder)
    with _mounted(trial):
        try:
            told = _held(trial, exit_code(trial), golden)
            if not trial.place.is_memory:
                resize(trial.disk, ENOUGH)
            assert (code := exit_code(replace(trial, is_again=True))) == COMPLETE, f"{code} in the second run"
            for made, whole in zip(tables_of(trial.out)[1:], tables_of(golden)[1:]):
                assert [untold(row) for row in made] == [untold(row) for row in whole]
            assert_same_rows(tables_of(trial.out)[0], tables_of(golden)[0])
            assert (found := verify(Store(trial.out)).damage) == (), found
        except AssertionError as error:
            words = [
                path.read_text()[-WORDS:] for path in (trial.file("words"), folder / "again.words") if path.exists()
            ]
            told = f"{error}; it said: {' then '.join(words)}"
    shutil.rmtree(folder)
    return told


def _held(trial: Trial, code: int, golden: Path) -> str:
    """What a run there came to. Raises AssertionError."""
    words = trial.file("words").read_text()
    assert code in TOLD, f"exit code {code}"
    assert "Traceback" not in words
    if code in (BAD_CONFIG, INTERRUPTED):
        assert sum(bool(SAID.search(line)) for line in words.splitlines()) == 1, "not one line"
    if code == BAD_CONFIG:
        assert not trial.out.exists() or not any(trial.out.iterdir()), "refused, and something is written"
        return TOLD[code]
    store, (whole, _, _) = Store(trial.out), tables_of(golden)
    committed = store.samples.read().sort_by("attempt_id")
    assert_same_rows(committed, whole.filter(pc.is_in(whole["attempt_id"], committed["attempt_id"])))
    assert (found := verify(store).damage) == (), found
    return TOLD[code]


def main(levels: int = LEVELS, names: Sequence[str] = tuple(PLACES)) -> int:
    """Print the table; the number of findings."""
    findings = 0
    kinds = tuple(dict.fromkeys(TOLD.values()))
    print(
        f"| place | it takes | levels | {' | '.join(kinds)} | anything else |\n|{'---|' * (4 + len(kinds))}", flush=True
    )
    with tempfile.TemporaryDirectory() as root:
        for name in names:
            need, golden = needed(name, Path(root, name))
            found = Findings(kinds)
            for level in range(levels):
                n_bytes = -(-need * level // levels // PAGE) * PAGE
                ended = at_level(name, n_bytes, golden, Path(root, f"{name}.{level}"))
                found.note(f"{name}, {n_bytes:,} bytes free", ended)
            findings += found.n_others
            print(f"| {name} | {need / 1e6:.1f} MB | {found.told.total()} | {found.cells} |", flush=True)
    return findings


if __name__ == "__main__":
    from experiments.chaos.full_disks import main  # so that another process can import what it runs

    sys.exit(bool(main(*map(int, sys.argv[1:2]), names=tuple(sys.argv[2:]) or tuple(PLACES))))
