"""What a driver holds while it commits: `python -m tests.bench.bench_driver [executor=ray] [clips=3000]`.

A run of toy samples, which cost next to nothing, commits every `shard_seconds`; after every `each` commits a row says
what the process holds, and who: the C library's allocator (in use, and free but kept), Arrow, and Python, by its number
of blocks and of objects. The rest of its memory is files, stacks, and what compiled libraries ask the system for.
"""

import ctypes
import gc
import os
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from factory.config.arguments import answer
from factory.graph.batch import Gatherer, PendingCommit
from factory.graph.execute import Executor, execute
from factory.store.samples import Store
from tests.factory.toy import ToyWork, refs

HEAD = ("commits", "attempts", "MB", "C in use", "C free", "Arrow", "k blocks", "k objects", "threads")


@dataclass(frozen=True)
class Request:
    """The command line."""

    executor: Executor = "local"
    clips: int = 2000
    shard_seconds: float = 0.3
    each: int = 50  # commits


class Told(Gatherer):
    """Prints a row after some commits."""

    each = 50
    commits = attempts = 0

    def _commit(self, batch: PendingCommit) -> None:
        Told.attempts += sum(map(len, batch.rows.values())) + len(batch.outcomes)
        super()._commit(batch)
        Told.commits += 1
        if Told.commits % Told.each == 0:
            print("".join(f"{value:>11}" for value in _row(Told.commits, Told.attempts)), flush=True)


def main(request: Request) -> None:
    """Print the table."""
    import factory.graph.execute as module

    Told.each, module.Gatherer = request.each, Told  # type: ignore[misc]
    print("".join(f"{name:>11}" for name in HEAD))
    work, workers = ToyWork(n_candidates=10, threshold=0.4), 2 if request.executor == "ray" else None
    with tempfile.TemporaryDirectory() as out:
        given = work, refs(request.clips), ["recovery", "human"], 2, Store(out), request.executor, workers
        summary = execute(*given, shard_seconds=request.shard_seconds, say=str)
    if summary.exit_code:
        raise RuntimeError(f"the run ended with {summary.exit_code}: {summary.message}")


def _row(commits: int, attempts: int) -> list[object]:
    gc.collect()
    rss = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    kept, free = _of_c()
    megabytes = [f"{n / 1e6:.0f}" for n in (rss, kept - free, free, pa.total_allocated_bytes())]
    python = [f"{n / 1e3:.1f}" for n in (sys.getallocatedblocks(), len(gc.get_objects()))]
    return [commits, attempts, *megabytes, *python, len(os.listdir("/proc/self/task"))]


def _of_c() -> tuple[int, int]:
    """Bytes that glibc's allocator has of the system, and those of them that are free, of all its arenas."""
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    with tempfile.NamedTemporaryFile() as file:
        stream = ctypes.c_void_p(libc.fopen(file.name.encode(), b"w"))
        libc.malloc_info(0, stream)
        libc.fclose(stream)
        told = Path(file.name).read_text()
    whole = told[told.rindex("</heap>") :]

    def total(pattern: str) -> int:
        return sum(map(int, re.findall(pattern + r'.* size="(\d+)"', whole)))

    return total('<(?:system type="current|total type="mmap)"'), total('<total type="(?:fast|rest)"')


if __name__ == "__main__":
    sys.exit(answer(sys.modules[__name__], sys.argv[1:]))
