"""Clips that do harm, one in a hundred of each kind: `python -m experiments.chaos.poison [clips=100] ...`.

A run of toy samples, `human` alone, in a process of its own (executor=local) or on Ray. Which clips do harm is drawn by
chance. Every other clip's rows must be those of a run without them, the run must end with exit code 3, and each clip
that does harm must be told of by its own kind of failure. A row an executor and kind.
"""

import pickle
import random
import re
import signal
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.datasets.navsim.log import read_frames
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.execute import Execution, RunSummary, execute
from factory.graph.local import Limits
from factory.graph.steps import AcceptedDrive, PreparedClip, RejectedAttempt
from factory.readers.base import ClipRef
from factory.stages.sensors import load_sweeps
from factory.store.samples import Store
from factory.store.verify import verify
from tasks.stages import Rejected
from tasks.world.clip import SensorFile
from tests.factory.datasets.navsim.openscene_writer import merged_pcd
from tests.factory.graph.wild import WildWork
from tests.factory.toy import refs

HUMAN = "human"
LIMITS = Limits(
    seconds={"drive": 30.0, "render": 0.0, "label": 0.0}, gb={"drive": 1.2, "render": 1.2, "label": 1.2}
)  # memory: what stands for 8 GB here
RAN = "code of a pickle ran"  # a file
HOW: Mapping[str, tuple[str, str]] = {  # kind -> what is told of it, and a pattern in the message
    "loop": ("limit", "at work for more than"),
    "compiled loop": ("limit", "at work for more than"),
    "memory": ("limit", "GB"),
    "segfault": ("system", r"at drive\+render\+label|worker died"),
    "os._exit": ("system", r"at drive\+render\+label|worker died"),
    "sys.exit": ("bug", "SystemExit"),
    "NaN": ("bug", "holds NaN or infinity"),
    "raise": ("bug", "ZeroDivisionError"),
    "mutate": ("bug", "read-only"),
    "hostile pickle": ("input", "hostile.pkl"),
    "truncated file": ("input", "truncated.pcd"),
}


class Hostile:
    """Runs code where it is unpickled by pickle itself: it leaves a file."""

    def __init__(self, ran: Path) -> None:
        self.ran = ran

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, (f"open({str(self.ran)!r}, 'w')",)


@dataclass(frozen=True)
class PoisonWork(WildWork):
    """`harm` maps `log:start` of a clip to a kind; those that are files lie in `folder`."""

    harm: tuple[tuple[str, str], ...] = ()
    folder: str = ""

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        match dict(self.harm).get(f"{ref.log_id}:{ref.start_ms}"):
            case "hostile pickle":
                read_frames(Path(self.folder, "hostile.pkl"))
            case "truncated file":
                load_sweeps([SensorFile("lidar", str(Path(self.folder, "truncated.pcd")), 0.0, np.eye(4))])
        return super().prepare(ref)

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        assert isinstance(prepared.payload, dict)
        how = dict(self.harm).get(prepared.payload["name"])
        if how == "raise":
            raise ZeroDivisionError("a bug in a stage")
        driven = super().drive(prepared, candidate, expert)
        if how == "NaN" and isinstance(driven, AcceptedDrive):
            name, row = driven.payload  # type: ignore[misc]
            return replace(driven, payload=(name, row | {"label_10hz": np.full((40, 3), np.nan, np.float32)}))
        return driven


def write_files(folder: Path) -> None:
    (folder / "hostile.pkl").write_bytes(pickle.dumps([Hostile(folder / RAN)]))
    whole = merged_pcd(np.random.default_rng(0).normal(0.0, 20.0, (50, 4)) + 5.0)
    (folder / "truncated.pcd").write_bytes(whole[: len(whole) // 2])


def run(out: Path, work: WildWork, n: int, executor: str, limits: Limits = LIMITS) -> RunSummary:
    store = Store(out)
    return execute(work, refs(n), [HUMAN], 1, store, Execution(executor, 2, isolated=True, limits=limits), say=str)  # type: ignore[arg-type]


def samples_of(out: Path, without: list[str]) -> pa.Table:
    """Rows of the other clips, in the order of their keys."""
    rows = Store(out).samples.read().sort_by("attempt_id")
    return rows.filter(pc.invert(pc.is_in(rows["clip_id"], pa.array(without, pa.string()))))


def trial(folder: Path, executor: str, n: int, seed: int) -> list[str]:
    """Rows of the table. Raises AssertionError where another clip was touched or a reason is wrong."""
    share = max(1, n // 100)
    rng, clips = random.Random(seed), refs(n)
    chosen = rng.sample(range(n), share * len(HOW))
    kinds = {f"{clips[i].log_id}:{clips[i].start_ms}": kind for i, kind in zip(chosen, share * list(HOW))}
    clip_of = {clips[i].clip_id: kind for i, kind in zip(chosen, share * list(HOW))}
    wild = tuple((f"{clip}:{HUMAN}:-1", kind) for clip, kind in kinds.items())
    out, clean = folder / f"{executor}{seed}", folder / f"clean{n}"
    work = PoisonWork(wild=wild, harm=tuple(kinds.items()), folder=str(folder))
    began = time.monotonic()
    summary = run(out, work, n, executor)
    seconds = time.monotonic() - began
    assert summary.exit_code == COMPLETE_WITH_FAILURES, (summary.exit_code, summary.message)
    if not clean.exists():
        assert run(clean, WildWork(), n, "local", Limits()).exit_code == COMPLETE
    mine, undisturbed = samples_of(out, list(clip_of)), samples_of(clean, list(clip_of))
    assert mine.num_rows == undisturbed.num_rows == n - len(chosen), (mine.num_rows, undisturbed.num_rows)
    for name in mine.column_names:
        a, b = (table[name].combine_chunks() for table in (mine, undisturbed))
        assert repr(a.to_pylist()) == repr(b.to_pylist()), f"{name} of another clip is not what it was"
    assert verify(Store(out)).damage == () and len(Store(out).samples) == mine.num_rows
    failed = {row["clip_id"]: row for row in Store(out).outcomes.read().to_pylist() if row["kind"] == "failed"}
    assert set(failed) == set(clip_of), "a clip that does no harm failed, or one that does did not"
    told = []
    for kind, (reason, word) in HOW.items():
        rows = [row for clip, row in failed.items() if clip_of[clip] == kind]
        wrong = [row for row in rows if row["error_kind"] != reason or not re.search(word, row["error"])]
        assert not wrong, (kind, wrong)
        told.append(f"| {executor} | {kind} | {len(rows)} | `{reason}` | {mine.num_rows} of {mine.num_rows} | 3 |")
    told.append(f"| {executor} | all | {len(failed)} | in {seconds:.0f} s | | |")
    return told


def main(clips: int = 100, local: int = 1, ray: int = 1, seed: int = 0) -> None:
    """Prints one table."""
    signal.alarm(3600)
    with tempfile.TemporaryDirectory() as name:
        write_files(Path(name))
        print("| executor | kind | clips | told as | others, byte for byte | exit |\n|---|---|---|---|---|---|")
        for executor in ["local"] * local + ["ray"] * ray:
            print("\n".join(trial(Path(name), executor, clips, seed)), flush=True)
            assert not Path(name, RAN).exists(), "code of a pickle ran"


if __name__ == "__main__":
    main(**{key: int(value) for key, _, value in (word.partition("=") for word in sys.argv[1:])})
