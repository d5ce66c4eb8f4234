"""The two forms of a table of samples: bytes, and CPU seconds to write and to read them.

make bench NAME=mcap
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from factory.store.location import Location
from factory.store.mcap_files import McapTable, write_mcap_shard
from factory.store.reader import Format, SampleTable
from factory.store.samples import Store
from planners.data.batch import ImageLayout, Needs
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.planners.samples import FRONT_YAWS, jpeg, labels, pictures, sample, write_table

N, SEEN = 128, 60  # samples, agents of each


def row(number: int) -> dict[str, object]:
    """A sample of the size of real ones: agents, a map, three cameras at two instants, labels of 8,192."""
    rng = np.random.default_rng(number)
    blocks = rng.integers(0, 256, (len(FRONT_YAWS), 36, 64, 3), np.uint8).repeat(8, axis=1).repeat(8, axis=2)
    views = pictures({name: jpeg(view, 80) for name, view in zip(FRONT_YAWS, blocks)})
    walk = rng.normal(size=(SEEN, 56, 5)).cumsum(axis=1).astype(np.float32)
    ring = [rng.normal(size=(40, 2)).astype(np.float32) for _ in range(60)]
    world = {
        "agent_ids": [f"agent{i}" for i in range(SEEN)],
        "agent_kinds": ["VEHICLE"] * SEEN,
        "agent_boxes": walk,
        "agent_velocities": rng.normal(size=(SEEN, 56, 2)).cumsum(axis=1).astype(np.float32),
        "agent_valid": np.ones((SEEN, 56), bool),
        "agent_heights": np.ones(SEEN, np.float32),
        "agent_center_z": rng.normal(size=(SEEN, 56)).astype(np.float32),
        "lane_ids": [f"lane{i}" for i in range(60)],
        "lane_polygons": ring,
        "lane_centerlines": [np.pad(line[:20], ((0, 0), (0, 1))) for line in ring],
        "lane_is_intersection": np.zeros(60, bool),
    }
    return sample(number, "recovery", **views, **world, **labels(number, 8192))


def cpu_s(call: Callable[[], object], times: int = 3) -> float:
    """The least of a few."""
    spent = []
    for _ in range(times):
        began = time.process_time()
        call()
        spent.append(time.process_time() - began)
    return min(spent)


def main() -> None:
    folder = Path(tempfile.mkdtemp())
    rows = [row(i) for i in range(N)]
    write_parquet = cpu_s(lambda: write_table(folder / "out", rows, shard_rows=64, group_rows=8), 1)
    location, store = Location.parse(folder / "out"), Store(folder / "out")
    live = store.samples.live_files()
    table = McapTable(location)
    shards = [write_mcap_shard(location, path, part) for path, part in live.items()]
    write_mcap = cpu_s(lambda: [write_mcap_shard(location, path, part) for path, part in live.items()])
    table.claim()
    table.keep_up(store.samples, shards)
    sizes = {
        "parquet": sum(f.n_bytes for f in store.samples.file_facts().values()),
        "mcap": sum(s.size for s in shards),
    }
    written = {"parquet": write_parquet, "mcap": write_mcap}
    needs = Needs(image=ImageLayout(width=256, height=64), labels="vocabulary-1")
    form: Format
    print("| form | KB a sample | ms to write one | to open 128 | to read one | two columns of one | one in a batch |")
    print("|---|---|---|---|---|---|---|")
    for form in ("parquet", "mcap"):
        settings = DataSettings(sim=str(folder / "out"), format=form)
        data = open_data(settings)

        def passed() -> None:
            for _ in Loader(data, needs, MixSettings(), 16, workers=0).epoch(0):  # noqa: B023
                pass

        samples = SampleTable(folder / "out", format=form)
        told = (
            sizes[form] / N / 1e3,
            written[form] / N * 1e3,
            cpu_s(lambda: open_data(settings)) * 1e3,  # noqa: B023
            cpu_s(lambda: list(samples.iterate())) / N * 1e3,  # noqa: B023
            cpu_s(lambda: list(samples.iterate(["stage2_score", "attempt_id"]))) / N * 1e3,  # noqa: B023
            cpu_s(passed) / N * 1e3,
        )
        print(f"| {form} | " + " | ".join(f"{value:.2f}" for value in told) + " |")


if __name__ == "__main__":
    main()
