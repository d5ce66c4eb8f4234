"""Bytes and reading time of vocabulary labels: K human trajectories from samples of two real logs."""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from factory.config.run import load_config
from factory.graph.execute import Execution, execute
from factory.setup.settings import assemble
from factory.store.reader import SampleTable, labels_of
from factory.store.samples import Store
from factory.store.schema import LABEL_COLUMNS
from tests.bench.timing import milliseconds

K = 8192


def main(shared: Path, n_random: int = 20, k: int = K, clips: int | None = None) -> None:
    """Makes two samples a clip (simulated and human), stores them, prints one table."""
    with tempfile.TemporaryDirectory() as folder:
        human, labelled, out = (
            shared / "data/vocabulary/human_8192x40x3.npy",
            Path(folder) / "few.npy",
            Path(folder) / "out",
        )
        np.save(labelled, np.load(human)[:k])
        overrides = (
            "clips=av2",
            f"clips.root={shared / 'data/av2/sensor/val'}",
            f"vocabulary.file={human}",
            "vocabulary.k=1000",
            f"reward.label_vocabulary={labelled}",
            "experts=[pdm_closed,human]",
            "render=none",
            f"out={out}",
        )
        run = assemble(load_config(overrides))
        store = Store(out)
        summary = execute(
            run.work,
            run.index.refs[:clips],
            run.config.experts,
            1,
            store,
            Execution("local", shard_seconds=1e9),
            say=lambda line: None,
        )
        n, spent = summary.seconds["labels"]
        table = SampleTable(out)
        places = np.random.default_rng(0).integers(0, len(table), n_random).tolist()
        stored = table.sample(0, LABEL_COLUMNS)

        def one_pass() -> None:
            for sample in table.iterate(LABEL_COLUMNS):
                labels_of(sample)

        def at_random() -> None:
            for place in places:
                labels_of(table.sample(place, LABEL_COLUMNS))

        print(f"{len(table)} samples, K = {k:,}\n\n| labels of one sample | |\n|---|---|")
        print(f"| stored, mean | {compressed_bytes(store) / len(table) / 1e3:.1f} kB |")
        print(f"| driven and scored | {spent.cpu_s / n:.3f} CPU s |")
        print(f"| read and decoded in a pass over all | {milliseconds(one_pass, 5) / len(table):.2f} ms |")
        print(f"| read and decoded at random, file open | {milliseconds(at_random, 5) / n_random:.2f} ms |")
        print(f"| decoded | {milliseconds(lambda: labels_of(stored), 50):.2f} ms |")


def compressed_bytes(store: Store) -> int:
    """Of all label columns of all samples."""
    total = 0
    for path in store.samples.live_files():
        metadata = pq.ParquetFile(f"{store.samples.location.uri}/{path}").metadata
        groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
        columns = (group.column(j) for group in groups for j in range(group.num_columns))
        total += sum(column.total_compressed_size for column in columns if column.path_in_schema in LABEL_COLUMNS)
    return total


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
