"""`make mutants`: every kept bug, one at a time, against the tests that should notice; prints the survivors.

Each worker has a copy of the tree of its own; the checkout is only read. Results are kept in runs/mutants by what they
depend on (the packages, the helpers of the tests, the record and its test files), so that the same command goes on
where it stopped. Kernels compiled with a bug in them go to the copy's own cache, not to the user's.
"""

import argparse
import compileall
import hashlib
import json
import os
import py_compile
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import astuple
from pathlib import Path
from queue import SimpleQueue
from threading import Lock

from tasks.kernels.compiled import kernel_sources
from tests.mutants.records import PACKAGES, ROOT, Mutant, Stale, chosen, load, mutated

GOAL = 0.97
FAILED, PASSED, TIMED_OUT = 1, 0, 1000  # pytest's, and ours
NOTICED = {"killed", "timed out"}  # whoever runs the tests sees either
NO_COPY = shutil.ignore_patterns(".*", "runs", "build", "dist", "__pycache__", "*.egg-info")


class Copy:
    """A copy of the tree that bugs are put into, one at a time."""

    def __init__(self, folder: Path) -> None:
        self.root, self.kernels = folder / "tree", folder / "kernels"
        shutil.copytree(ROOT, self.root, ignore=NO_COPY)
        # Checked by content: a bug may leave a file's size and second as they were.
        by_content = py_compile.PycInvalidationMode.CHECKED_HASH
        compileall.compile_dir(self.root, quiet=1, invalidation_mode=by_content)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")

    @contextmanager
    def having(self, mutant: Mutant) -> Iterator[None]:
        """The bug is in the tree meanwhile."""
        path = self.root / mutant.file
        text = path.read_text()
        path.write_text(mutated(mutant, self.root))
        try:
            yield
        finally:
            path.write_text(text)
            shutil.rmtree(self.kernels, ignore_errors=True)

    def passes(self, tests: Sequence[str], limit_s: float, interpreted: bool, own_kernels: bool) -> tuple[int, str]:
        """Exit status of pytest, or TIMED_OUT, and the end of what it said."""
        paths = {"PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        env = {**os.environ, **paths, "NUMBA_DISABLE_JIT": str(int(interpreted))}
        if own_kernels and not interpreted:
            env["NUMBA_CACHE_DIR"] = str(self.kernels)
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", *tests]
        with tempfile.TemporaryFile("w+") as said:
            process = subprocess.Popen(
                command, cwd=self.root, env=env, stdout=said, stderr=said, text=True, start_new_session=True
            )
            try:
                status = process.wait(limit_s)
            except subprocess.TimeoutExpired:
                status = TIMED_OUT
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
            said.seek(0)
            return status, said.read()[-2000:]


class Ledger:
    """What is known already, a line a result."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._lock = path, Lock()
        self._known: dict[str, str] = {}
        if path.exists():
            self._known = {row["key"]: row["verdict"] for row in map(json.loads, path.read_text().splitlines())}
        self._tree = _digest(*sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")))
        tests = (path for path in (ROOT / "tests").rglob("*.py") if not path.name.startswith("test_"))
        helpers = (path for path in tests if path.parent.name != "mutants")
        self._tree += _digest(*sorted(helpers))

    def verdict(self, mutant: Mutant) -> str | None:
        """What came of it, where this very bug was tried in this very tree."""
        return self._known.get(self._key(mutant))

    def keep(self, mutant: Mutant, verdict: str, seconds: float) -> None:
        row = {"key": self._key(mutant), "id": mutant.id, "verdict": verdict, "seconds": round(seconds, 1)}
        with self._lock, self._path.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def _key(self, mutant: Mutant) -> str:
        tests = sorted({ROOT / test.partition("::")[0] for test in mutant.tests})
        return hashlib.sha256(repr((self._tree, astuple(mutant), _digest(*tests))).encode()).hexdigest()[:16]


def _digest(*paths: Path) -> str:
    sha = hashlib.sha256()
    for path in paths:
        sha.update(path.as_posix().encode() + b"\0" + (path.read_bytes() if path.is_file() else b""))
    return sha.hexdigest()


def tried(mutant: Mutant, copy: Copy, kernels: set[str]) -> tuple[str, str]:
    """killed, timed out, survived or broken, and what pytest said. Broken: its tests did not even begin."""
    with copy.having(mutant):
        status, said = copy.passes(mutant.tests, mutant.limit_s, mutant.interpreted, mutant.file in kernels)
    if status < 0:  # died of a signal
        status = FAILED
    return {FAILED: "killed", TIMED_OUT: "timed out", PASSED: "survived"}.get(status, "broken"), said


def sound(mutants: Sequence[Mutant], copy: Copy) -> str | None:
    """What the tests say where they fail without any bug; None where all pass."""
    for interpreted in (False, True):
        tests = sorted({test for m in mutants if m.interpreted == interpreted for test in m.tests})
        if tests:
            status, said = copy.passes(tests, 60 + 120.0 * len(tests), interpreted, own_kernels=False)
            if status != PASSED:
                return said
    return None


def summary(results: Sequence[tuple[Mutant, str]]) -> tuple[str, float]:
    """The survivors, the count of every package, and the share that was killed of all."""
    lines = [f"{verdict}: {m.id} ({m.file}): {m.rule}" for m, verdict in results if verdict != "killed"]
    for name in PACKAGES:
        mine = [verdict for mutant, verdict in results if mutant.package == name]
        if mine:
            killed = sum(verdict in NOTICED for verdict in mine)
            lines.append(f"{name:10} {killed} of {len(mine)} killed, {100 * killed / len(mine):.0f} %")
    rate = sum(verdict in NOTICED for _, verdict in results) / len(results)
    lines.append(f"{'all':10} {100 * rate:.1f} % of {len(results)} killed, goal {100 * GOAL:.0f} %")
    return "\n".join(lines), rate


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="a package, a file or folder, an id; several with commas")
    parser.add_argument("-j", "--jobs", type=int, default=1, help="mutants at a time, a core each")
    parser.add_argument("--unchecked", action="store_true", help="do not run the tests without any bug first")
    arguments = parser.parse_args()
    try:
        mutants = chosen(load(), arguments.only)
        for mutant in mutants:
            mutated(mutant)
    except Stale as error:
        print(error)
        return 2
    ledger = Ledger(ROOT / "runs" / "mutants" / "results.jsonl")
    kernels = {path.relative_to(ROOT).as_posix() for path in kernel_sources(ROOT)}
    results = [(mutant, known) for mutant in mutants if (known := ledger.verdict(mutant)) is not None]
    waiting = [mutant for mutant in mutants if ledger.verdict(mutant) is None]
    print(f"{len(mutants)} mutants, {len(results)} known from before")
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies: SimpleQueue[Copy] = SimpleQueue()
        for i in range(min(arguments.jobs, len(waiting))):
            copies.put(Copy(Path(folder) / str(i)))

        def one(mutant: Mutant) -> tuple[Mutant, str, str, float]:
            copy, start = copies.get(), time.perf_counter()
            try:
                return mutant, *tried(mutant, copy, kernels), time.perf_counter() - start
            finally:
                copies.put(copy)

        if waiting and not arguments.unchecked:
            copy = copies.get()
            said = sound(waiting, copy)
            copies.put(copy)
            if said is not None:
                print(f"{said}\nThe tests fail without any bug: make test passes first")
                return 2
        with ThreadPoolExecutor(arguments.jobs) as pool:
            for done in as_completed([pool.submit(one, mutant) for mutant in waiting]):
                mutant, verdict, said, seconds = done.result()
                if verdict != "broken":
                    ledger.keep(mutant, verdict, seconds)
                results.append((mutant, verdict))
                print(f"{verdict:8} {seconds:5.0f} s  {mutant.id}", flush=True)
                if verdict == "broken":
                    print(said)
    text, rate = summary(results)
    print(text)
    return 0 if rate >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
