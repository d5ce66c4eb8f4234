"""`python -m tests.bench.bench_memory`: memory of a rewards-only training with labels of a large vocabulary.

    python -m tests.bench.bench_memory [samples=10000] [k=16384] [shuffle_mb=512] [steps=<an epoch>]

Makes a table of simulated samples with labels of K trajectories and trains gtrs_dense_small on it, in a process of
its own whose memory is looked at. Beside it the same training with 64 samples: what is above that is the data. A step
scores one trajectory in a hundred, which is quicker, but reads the labels of all.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from factory.store.parquet_file import write_shard
from factory.store.samples import Store
from factory.store.schema import sample_row_to_table
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.planners.samples import grey_pictures, labels, sample

FEW = 64
SHARD = 250
LOOK_EVERY_S = 0.05


def main(samples: int = 10_000, k: int = 16_384, shuffle_mb: int = 512, steps: int | None = None) -> None:
    """Prints one table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        vocabulary = Vocabulary(kinematic_trajectories(k, seed=0))
        np.save(folder / "vocabulary.npy", vocabulary.trajectories)
        print(f"K = {k:,}, shuffle_mb={shuffle_mb}, batch 32\n\n| samples | on disk | steps | peak memory |")
        print("|---|---|---|---|")
        for n in (FEW, samples):
            table = write(folder / f"table_{n}", n, k, vocabulary.digest)
            size_mb = sum(file.stat().st_size for file in table.rglob("*.parquet")) / 2**20
            count = n // 32 if steps is None else min(steps, n // 32)
            peak_mb = train(folder, table, shuffle_mb, count)
            print(f"| {n:,} | {size_mb:.0f} MB | {count} | {peak_mb:.0f} MB |", flush=True)


def write(out: Path, n: int, k: int, digest: str) -> Path:
    """A table of simulated samples, a shard at a time."""
    table = Store(out).samples
    shards = []
    for start in range(0, n, SHARD):
        rows = list(rows_of(range(start, min(start + SHARD, n)), k, digest))
        shards.append(write_shard(table.location, table.spec, sample_row_to_table(rows)))
    table.commit(shards)
    return out


def rows_of(numbers: range, k: int, digest: str) -> Iterator[dict[str, Any]]:
    """Random labels, one grey picture."""
    for number in numbers:
        columns: dict[str, Any] = {**grey_pictures(128), **labels(number, k), "label_vocabulary": digest}
        yield sample(number, "pdm_closed", **columns)


def train(folder: Path, table: Path, shuffle_mb: int, steps: int) -> float:
    """The most memory [MB] that the training's process held. Raises RuntimeError where it fails."""
    command = [
        *(sys.executable, "-m", "planners", "train", "planner=gtrs_dense_small", "mix=rewards_only", f"steps={steps}"),
        f"planner.settings.vocabulary={folder / 'vocabulary.npy'}",
        "planner.settings.kept=0.01",
        *(f"data.sim=[{table}]", f"mix.shuffle_mb={shuffle_mb}", f"out={folder / f'trained_{table.name}'}"),
    ]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    peak_kb, status = 0, Path(f"/proc/{child.pid}/status")
    while child.poll() is None:
        found = [line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        peak_kb = max([peak_kb, *map(int, found)])
        time.sleep(LOOK_EVERY_S)
    assert child.stderr is not None
    if child.returncode:
        raise RuntimeError(child.stderr.read()[-2000:])
    return peak_kb / 1024.0


if __name__ == "__main__":
    main(**{name: int(value) for name, value in (argument.split("=", 1) for argument in sys.argv[1:])})
