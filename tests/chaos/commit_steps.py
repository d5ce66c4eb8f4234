"""A fault at every step of a run's commits: `python -m tests.chaos.commit_steps [EVERY] [ROW ...]` prints a table.

A step is a call that makes, fills, flushes, renames, links or removes a file or folder under `out`, be it Python's,
Arrow's or delta-rs's (tests.chaos.file_steps). At each of them (or one in EVERY) a run is killed, or the call fails
with EIO, or, of writes, half of the bytes are written and then it is killed. After that

- every table reads as in one version of the undisturbed run: before the commit that the step is part of (`old`), or
  with it (`new`); after an error that the run survives also a later one, up to all of it (`went on`);
- verify finds no damage, and a run that was not killed ended with 0, 3 or 4 and no traceback;
- the same command again is complete, and its store is that of the undisturbed run.

Two runs: one on a new folder; one that makes one clip of two again, with other settings (on_change=redo), which
rewrites files without the rows that it replaces, where the logs are about to get their checkpoints. ROW is a part of
what a row is called, as "checkpoints, refused": only such rows are made.
"""

import hashlib
import math
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.graph.driver import SHARD_BYTES
from factory.graph.execute import Execution, execute
from factory.store.reader import SampleTable
from factory.store.samples import OnChange, Store
from factory.store.table import KeyedTable
from factory.store.verify import verify
from tests.chaos.file_steps import FAULTS, Step, Stepped, Trial, stepping, steps_of
from tests.chaos.trials import Findings, assert_same_stores
from tests.factory.toy import ToyWork, refs

EXPERTS = ["recovery", "human"]
INTERVAL = 10  # commits from one checkpoint of a log to the next; delta-rs's own are 100
COMMIT = re.compile(r"(\w+)/_delta_log/(\d{20})\.json")
FINE = ("old", "new", "went on")
Rows = tuple[str, ...]  # a digest of each, in the order of their keys
NONE = -1  # the version of a table that is not there yet
View = dict[str, tuple[int, Rows]]  # table -> the version that a reader sees, and its rows


def new_store(out: str) -> int:
    """Every sample is committed as soon as it is there, whatever the clock says: each run makes the same steps."""
    return _run(out, ToyWork())


def other_settings(out: str) -> int:
    """Of one of the clips that `before_checkpoints` left."""
    return _run(out, ToyWork(threshold=0.4), on_change="redo")


def before_checkpoints(out: str) -> int:
    """Two clips whose rows share files, and logs a few commits short of a checkpoint."""
    code = _run(out, ToyWork(), clips=2, shard_bytes=SHARD_BYTES)
    for table in tables_in(Path(out)):
        table.set_property("delta.checkpointInterval", str(INTERVAL))
        while (version_of(table) + 3) % INTERVAL:
            table.set_property("commits", str(table.version))
    return code


def _run(out: str, work: ToyWork, clips: int = 1, on_change: OnChange = "stop", shard_bytes: int = 1) -> int:
    how = Execution("local", on_change=on_change, shard_bytes=shard_bytes, shard_seconds=math.inf)
    summary = execute(work, refs(clips), EXPERTS, 1, Store(out), how, say=str)
    print(summary.message)
    return summary.exit_code


@dataclass(frozen=True)
class Run:
    """What is disturbed."""

    name: str
    run: Callable[[str], int]
    before: Callable[[str], int] | None = None  # makes what is there already


RUNS = (Run("a new folder", new_store), Run("other settings, with checkpoints", other_settings, before_checkpoints))


def tables_in(out: Path) -> list[KeyedTable]:
    store = Store(out)
    return list(store.tables)


def rows_of(table: KeyedTable) -> Rows:
    """Less what depends on the clock and on how often a run was tried."""
    rows = table.read().sort_by(table.spec.key)
    kept = [name for name in rows.column_names if name not in ("seconds", "tries")]
    return tuple(hashlib.sha256(repr(row).encode()).hexdigest() for row in rows.select(kept).to_pylist())


def view(out: Path) -> View:
    """What a reader finds."""
    return {table.spec.name: (version_of(table), rows_of(table)) for table in tables_in(out)}


def version_of(table: KeyedTable) -> int:
    return NONE if table.version is None else table.version


def versions(out: Path) -> dict[str, dict[int, Rows]]:
    """Table -> its rows at every version that a reader may see."""
    found: dict[str, dict[int, Rows]] = {}
    for table in tables_in(out):
        found[table.spec.name] = {NONE: ()}
        for version in range(version_of(table) + 1):
            assert table._delta is not None
            table._delta.load_as_version(version)
            found[table.spec.name][version] = rows_of(table)
    return found


@dataclass(frozen=True)
class Undisturbed:
    """What a run does where nothing goes wrong."""

    run: Run
    before: Path | None
    out: Path  # as it leaves it
    steps: Sequence[Step]
    rows: Mapping[str, Mapping[int, Rows]]  # of `versions`
    at_first: Mapping[str, int]  # table -> its version

    def expected(self, met: Sequence[Step]) -> dict[str, int]:
        """Table -> the version that readers find after some steps of this run."""
        found = dict(self.at_first)
        for step in met:
            if step.call == "link" and (named := COMMIT.fullmatch(step.path)):
                found[named[1]] = int(named[2])
        return found

    def is_visible(self, met: Sequence[Step]) -> bool:
        """Whether the commit that is being made after some steps, to the end of its copy, can be seen."""
        renamed = {step.path for step in met if step.call == "rename"}
        linked = (COMMIT.fullmatch(step.path) for step in met if step.call == "link")
        copies = {f"{named[1]}/_commits/{named[2]}.json" for named in linked if named}
        last = {name: max(found) for name, found in self.rows.items()}
        return not copies <= renamed or self.expected(met) == last


def undisturbed(run: Run, folder: Path, stepped: Stepped) -> Undisturbed:
    """In the folder, which is made."""
    out, before = folder / "undisturbed", None
    if run.before is not None:
        before = folder / "before"
        run.before(str(before))
        shutil.copytree(before, out)
    out.mkdir(exist_ok=True)
    at_first = {name: version for name, (version, _) in view(out).items()}
    trial = Trial(f"{run.run.__module__}:{run.run.__name__}", str(out), str(folder / "log"), str(folder / "words"))
    assert stepped.exit_code(trial) == COMPLETE, (folder / "words").read_text()
    return Undisturbed(run, before, out, steps_of(folder / "log"), versions(out), at_first)


def disturbed(golden: Undisturbed, number: int, fault: str, folder: Path, stepped: Stepped) -> str:
    """What came of a fault at a step: old, new, went on, or what is wrong. In the folder, which is made and removed."""
    out, words = folder / "out", folder / "words"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if golden.before is not None:
        shutil.copytree(golden.before, out)
    out.mkdir(exist_ok=True)
    function = f"{golden.run.run.__module__}:{golden.run.run.__name__}"
    code = stepped.exit_code(Trial(function, str(out), str(folder / "log"), str(words), number, FAULTS[fault]))
    try:
        met = steps_of(folder / "log")
        assert len(met) >= number, f"there were {len(met)} steps"
        refused = fault == "refused with EIO"
        assert code in ((COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED) if refused else (-signal.SIGKILL,)), code
        assert "Traceback" not in words.read_text()
        told = _seen(golden, met[: number - 1] if refused else met[:-1], out, code)
        assert (found := verify(Store(out)).damage) == (), found
        if len(Store(out).samples):
            assert len(list(SampleTable(out))) == len(Store(out).samples)
        assert stepped.exit_code(Trial(function, str(out), str(folder / "log"), str(words))) == COMPLETE
        assert_same_stores(out, golden.out)
    except Exception as error:
        return f"{type(error).__name__} {error}; it said: {words.read_text().strip()}"
    return told


def _seen(golden: Undisturbed, met: Sequence[Step], out: Path, code: int) -> str:
    """Raises AssertionError where a reader finds what the undisturbed run never showed."""
    seen, expected = view(out), golden.expected(met)
    if code != COMPLETE and {name: version for name, (version, _) in seen.items()} == expected:
        for name, (version, rows) in seen.items():
            assert rows == golden.rows[name][version], f"{name} has other rows in version {version}"
        return "new" if golden.is_visible(met) else "old"
    assert code >= 0, f"neither old nor new: {expected}"
    for name, (version, rows) in seen.items():
        assert version >= expected[name], f"{name} has lost a commit"
        shown = {row for rows in golden.rows[name].values() for row in rows}
        assert shown.issuperset(rows) and len(set(rows)) == len(rows), f"{name} has rows of its own"
    return "went on"


def main(every: int = 1, *rows: str) -> int:
    """Print the table, or some rows of it; the number of findings."""
    findings = 0
    print("| run | fault | steps | old | new | went on | anything else |\n|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as name, stepping(Path(name), __name__) as stepped:
        for place, run in enumerate(RUNS):
            faults = [fault for fault in FAULTS if not rows or any(row in f"{run.name}, {fault}" for row in rows)]
            if not faults:
                continue
            (folder := Path(name) / str(place)).mkdir()
            golden = undisturbed(run, folder, stepped)
            for fault in faults:
                found = Findings(FINE)
                for step in golden.steps[::every]:
                    if fault.startswith("half") and (step.call != "write" or step.n_bytes < 2):
                        continue
                    ended = disturbed(golden, step.number, fault, folder / "trial", stepped)
                    found.note(f"{run.name}, {fault}, {step}", ended)
                findings += found.n_others
                print(f"| {run.name} | {fault} | {found.told.total()} | {found.cells} |", flush=True)
    return findings


if __name__ == "__main__":
    from tests.chaos.commit_steps import main  # so that another process can import what it runs

    sys.exit(bool(main(*map(int, sys.argv[1:2]), *sys.argv[2:])))
