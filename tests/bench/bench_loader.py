"""The loader against the raw decoder: samples a second from the same JPEGs, on the same threads.

    python -m tests.bench.bench_loader [threads=2] [table=<out of a run with images>]

Without a table one is made of the nuScenes keyframe's photos, or of noise where they are not at hand: 400 samples,
three cameras of 512 x 288 and, fewer of them, of 1920 x 1080, at four instants, of which a planner sees the last.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from factory.store.reader import TIME_TOLERANCE_S, SampleTable
from planners.data.batch import ImageLayout, Needs
from planners.data.index import DataSettings, make_feed, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.planners.samples import FRONT_YAWS, camera, jpeg, sample, write_table

SHARED = Path("../shared")
PHOTOS = "data/nuscenes_frame"
BATCH = 16
PASSES = 3


@dataclass
class Rate:
    """The best of several passes."""

    per_second: float = 0.0  # samples, by the clock
    cpu_ms: float = float("inf")  # of this process, a sample: what other programs' load spares

    def time(self, run: Callable[[], int]) -> None:
        """One more pass; `run` returns its samples."""
        clock, cpu = time.perf_counter(), time.process_time()
        n = run()
        self.per_second = max(self.per_second, n / (time.perf_counter() - clock))
        self.cpu_ms = min(self.cpu_ms, 1e3 * (time.process_time() - cpu) / n)


def main(threads: int = 2, table: str | None = None, n: int = 400) -> None:
    """Prints one table."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(f"{threads} threads, batches of {BATCH}, best of {PASSES} passes: samples/s, CPU ms a sample\n")
    ways = ("pictures in memory", "samples in memory", "windows", "windows, from the copy")
    print(f"| samples | picture | raw decode | {' | '.join(f'{way} | share of raw' for way in ways)} |")
    print("|---" * (3 + 2 * len(ways)) + "|")
    with tempfile.TemporaryDirectory() as folder:
        if table is not None:
            compare(table, ImageLayout(), threads, "of the table", f"{folder}/copy")
            return
        for (width, height), count, layouts in (
            ((512, 288), n, ((1092, 274), (1024, 256), (512, 128))),
            ((1920, 1080), n // 8, ((2048, 512), (1024, 256))),
        ):
            out = Path(folder) / f"{width}"
            write_table(out, [photographed(i, width, height) for i in range(count)], group_rows=group_rows(width))
            for layout in layouts:
                picture, name = ImageLayout(width=layout[0], height=layout[1]), f"of 3 x {width} x {height}"
                compare(str(out), picture, threads, name, f"{folder}/copy")


def compare(table: str, layout: ImageLayout, threads: int, name: str, copy: str) -> None:
    """One line: raw; with pictures or samples in memory; from windows that are read in every pass, or of a copy."""
    needs = Needs(image=layout)
    experts = set(SampleTable(table).table(["expert"])["expert"].to_pylist())
    settings = DataSettings(real=table if "human" in experts else (), sim=table if experts != {"human"} else ())
    dataset = open_data(settings)
    feed = make_feed(dataset, needs)
    wanted = dict(zip(dataset.rows.attempt_id.tolist(), feed.cameras))
    jpegs = [
        [
            np.frombuffer(image["jpeg"], np.uint8)
            for image in one["images"]
            if abs(image["time_s"]) <= TIME_TOLERANCE_S and image["camera"] in wanted[one["attempt_id"]]
        ]
        for one in SampleTable(table).iterate(["attempt_id", "images"])
    ]
    total_mb = feed.size.sum() / 2**20
    runs: list[Callable[[], int]] = [lambda: decode_all(jpegs, threads)]
    pictures_mb = len(dataset) * layout.height * layout.width * 3 / 2**20
    whole = MixSettings(shuffle_mb=int(2 * total_mb + pictures_mb) + 1)
    window = MixSettings(shuffle_mb=max(1, int(total_mb / 4)))
    copied = replace(dataset, settings=replace(settings, copy=copy))
    for data, mix in ((dataset, whole), (dataset, whole), (dataset, window), (copied, window)):
        loader = Loader(data, needs, mix, BATCH, workers=threads)
        if len(runs) == 2:
            loader._pictures_bytes = 0  # the same without room for decoded pictures
        runs.append(lambda loader=loader: count(loader))  # type: ignore[misc]
    rates = [Rate() for _ in runs]
    for run in runs:
        run()  # warms up; the loader that keeps samples has read them then, the copy is made
    for _ in range(PASSES):
        for rate, run in zip(rates, runs):  # in turns, so that they share the machine's moods
            rate.time(run)
    raw = rates[0]
    columns = [f"{raw.per_second:.0f}, {raw.cpu_ms:.2f} ms"]
    for rate in rates[1:]:
        columns.append(f"{rate.per_second:.0f}, {rate.cpu_ms:.2f} ms")
        columns.append(f"{100 * rate.per_second / raw.per_second:.0f} %, by CPU {100 * raw.cpu_ms / rate.cpu_ms:.0f} %")
    print(f"| {len(jpegs)} {name} | {layout.width} x {layout.height} | {' | '.join(columns)} |", flush=True)


def decode_all(jpegs: list[list[NDArray[np.uint8]]], threads: int) -> int:
    """The raw decoder: every JPEG in full, eight samples a task, results dropped."""

    def some(start: int) -> None:
        for images in jpegs[start : start + 8]:
            for image in images:
                cv2.imdecode(image, cv2.IMREAD_COLOR)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(some, range(0, len(jpegs), 8)))
    return len(jpegs)


def count(loader: Loader) -> int:
    """Samples of the next epoch."""
    return sum(len(batch) for batch in loader.epoch(int(loader.state()["epoch"])))


def photographed(number: int, width: int, height: int) -> dict[str, object]:
    """A human sample with three front cameras at four instants."""
    photos = views(width, height)
    images = [
        {
            "camera": name,
            "time_s": time_s,
            "ego_pose": np.eye(4).reshape(16),
            "jpeg": photos[(number + i) % len(photos)] + f"{number} {time_s}".encode(),  # no two are stored as one
        }
        for time_s in (-1.5, -1.0, -0.5, 0.0)
        for i, name in enumerate(FRONT_YAWS)
    ]
    cameras = [camera(name, yaw, width, height) for name, yaw in FRONT_YAWS.items()]
    return sample(number, cameras=cameras, images=images, image_source="photo")


_VIEWS: dict[tuple[int, int], list[bytes]] = {}


def views(width: int, height: int) -> list[bytes]:
    """Different JPEGs of one size and of quality 90, the factory's own."""
    if (width, height) not in _VIEWS:
        _VIEWS[width, height] = [
            jpeg(cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA), 90) for photo in photos()
        ]
    return _VIEWS[width, height]


def photos() -> Iterator[NDArray[np.uint8]]:
    """RGB pictures 16 : 9."""
    files = sorted((SHARED / PHOTOS).rglob("*.jpg"))
    for file in files:
        photo = cv2.imread(str(file))[..., ::-1]
        for shift in range(0, 90, 30):  # other blocks of the same photo
            yield np.ascontiguousarray(photo[shift:, shift:])
    if not files:
        for seed in range(12):
            rng = np.random.default_rng(seed)
            small = rng.integers(0, 256, (135, 240, 3), dtype=np.uint8)
            yield cv2.resize(small, (1920, 1080), interpolation=cv2.INTER_CUBIC)


def group_rows(width: int) -> int:
    """As many as the factory's writer puts into a row group of 4 MB."""
    return max(1, 2**22 // (12 * len(views(width, width * 9 // 16)[0])))


if __name__ == "__main__":
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    main(int(given.get("threads", 2)), given.get("table"), int(given.get("n", 400)))
