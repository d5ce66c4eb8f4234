"""A first run on a machine: seconds until its kernels are compiled, its first rows committed and the run done.

    python -m tests.bench.bench_cold [<folder of shared data>]

Two runs of one Argoverse 2 clip without pictures: with an empty cache of its own, and again into another folder. The
first perturb starts as soon as the kernels are there. A line before the table tells how fast the machine is just now:
the same sources have compiled twice as fast on it an hour later.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

SHARED = Path("../shared")
LOOP = 10_000_000
LOOK_S = 0.05


@dataclass(frozen=True)
class Times:
    """Of one run, from its command on."""

    compiled_s: float  # the last part's kernels are in the cache; 0 where they were there
    committed_s: float
    ended_s: float
    cpu_s: float  # of all its processes


def loop_seconds() -> float:
    """CPU time of a plain loop of Python, which no cache and no compiler helps."""
    start, total = time.process_time(), 0
    for k in range(LOOP):
        total += k * k
    return time.process_time() - start


def timed_run(shared: Path, cache: Path, out: Path) -> Times:
    """Run the command; raises CalledProcessError where it fails."""
    command = [sys.executable, "-m", "factory.run", "executor=local", "render=none", "limit=1", "clips=av2"]
    command += [f"clips.root={shared}/data/av2/sensor/val", f"out={out}"]
    command += [f"vocabulary.file={shared}/data/vocabulary/human_8192x40x3.npy"]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    compiled_s = committed_s = 0.0
    n_parts = len(list(cache.rglob("compiled-*")))
    with subprocess.Popen(command, env=os.environ | {"XDG_CACHE_HOME": str(cache)}, stdout=subprocess.DEVNULL) as run:
        while run.poll() is None:
            time.sleep(LOOK_S)
            now_s = time.perf_counter() - start
            if len(parts := list(cache.rglob("compiled-*"))) > n_parts:
                n_parts, compiled_s = len(parts), now_s
            if not committed_s and len(list((out / "samples" / "_delta_log").glob("*.json"))) > 1:
                committed_s = now_s
    if run.returncode:
        raise subprocess.CalledProcessError(run.returncode, command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Times(compiled_s, committed_s, time.perf_counter() - start, cpu_s)


def main(shared: Path) -> None:
    """Print the table."""
    print(f"a loop of {LOOP:,} sums in Python: {loop_seconds():.2f} s")
    print(f"{'cache':<8}{'kernels [s]':>12}{'first commit [s]':>18}{'run [s]':>10}{'CPU [s]':>10}")
    with tempfile.TemporaryDirectory() as folder:
        for name in ("empty", "full"):
            times = timed_run(shared, Path(folder) / "cache", Path(folder) / name)
            print(
                f"{name:<8}{times.compiled_s:>12.1f}{times.committed_s:>18.1f}{times.ended_s:>10.1f}{times.cpu_s:>10.1f}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else SHARED)
