"""`ray job submit` twice, from two copies of the project: seconds until the first clip's rows are committed.

    python -m tests.bench.bench_job

The second copy is another upload: whatever is compiled or kept by path would be made anew there. The job is one clip of
a town without sensors, so that its one commit follows its first finished clip; the cluster runs already.
"""

import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

from tests.factory.test_job_submit import SMALL_JOB, Head, checkout, give_compiled_kernels, running_head


def seconds_to_first_commit(head: Head, copy: Path, out: Path, *arguments: str) -> tuple[float, float]:
    """From submission to the first commit of samples, and to the job's end. Raises AssertionError where it fails."""
    commits = out / "samples" / "_delta_log"
    before = len(list(commits.glob("*.json")))
    start, found = time.perf_counter(), threading.Event()
    first: list[float] = []

    def watch() -> None:
        while not found.wait(0.05):
            if len(list(commits.glob("*.json"))) > max(before, 1):  # the first makes the empty table
                first.append(time.perf_counter() - start)
                return

    watcher = threading.Thread(target=watch)
    watcher.start()
    done = head.submit(copy, *arguments)
    ended = time.perf_counter() - start
    found.set()
    watcher.join()
    assert done.returncode == 0 and first, done.stdout + done.stderr
    return first[0], ended


def main() -> None:
    """Print the table."""
    with contextmanager(running_head)() as head, tempfile.TemporaryDirectory() as folder:
        give_compiled_kernels(head)
        print(f"{'copy':<8}{'first commit [s]':>18}{'job [s]':>10}")
        for name in ("first", "second"):
            out = head.folder / name
            copy = checkout(Path(folder) / name)
            (copy / "README.md").write_text(name)
            first, whole = seconds_to_first_commit(head, copy, out, *SMALL_JOB, f"out={out}")
            print(f"{name:<8}{first:>18.1f}{whole:>10.1f}", flush=True)


if __name__ == "__main__":
    main()
