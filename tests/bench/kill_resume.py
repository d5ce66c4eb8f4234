"""Kills the driver of a real run at five moments and resumes it: `python -m tests.bench.kill_resume <overrides>`.

The overrides are those of `python -m factory.run`, without `out` and `executor`. Prints a table: when the driver was
killed, how many samples stood committed, what the same command then executed, and that the tables equal an undisturbed
run's (it stops where they do not).
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from factory.store.samples import Store
from tests.factory.tables import assert_same_tables

MOMENTS = ((0.25, "local"), (0.4, "ray"), (0.55, "local"), (0.7, "ray"), (0.9, "local"))
RAY_START_S = 8.0


def command(overrides: list[str], out: Path, executor: str) -> list[str]:
    return [sys.executable, "-m", "factory.run", *overrides, f"out={out}", f"executor={executor}"]


def finish(overrides: list[str], out: Path, executor: str) -> str:
    """Run to the end; what it says it executed."""
    done = subprocess.run(command(overrides, out, executor), capture_output=True, text=True, check=True)
    return next(line for line in done.stdout.splitlines() if line.startswith("executed"))


def main(overrides: list[str]) -> None:
    """Prints the table."""
    with tempfile.TemporaryDirectory() as folder:
        reference = Path(folder) / "undisturbed"
        began = time.monotonic()
        print(f"undisturbed: {finish(overrides, reference, 'local')}, {time.monotonic() - began:.1f} s\n")
        whole_s = time.monotonic() - began
        print(
            "| killed after | executor | samples then | the same command again | tables equal |\n|---|---|---|---|---|"
        )
        for share, executor in MOMENTS:
            out = Path(folder) / f"killed-{share}"
            driver = subprocess.Popen(
                command(overrides, out, executor), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            time.sleep(whole_s * share + (RAY_START_S if executor == "ray" else 0.0))
            os.kill(driver.pid, signal.SIGKILL)
            driver.wait()
            committed = len(Store(out).samples)
            again = finish(overrides, out, executor)
            assert_same_tables(out, reference)
            print(f"| {share:.0%} | {executor} | {committed} | {again} | yes |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
