"""Pictures for a GPU: samples a second and core, by the loader's own path, decoded or kept.

    python -m tests.bench.bench_decoding [samples=48] [cores=<all>] [cameras=3] [width=2048] [height=512]

The photos are the 1920 x 1080 of a real NAVSIM rig where they are at hand, else made of noise. Two tables: where a
picture's time goes, on one thread; the loader with 1, 2, ... workers up to all cores, with pictures decoded in full
(the public code's), at half their size (`reduced`), and kept on disk (`data.pictures`). CPU time is this process's, in
all its threads; "a core" is samples by CPU second, which other programs' load spares, where samples by the clock are
what this machine gave.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
import torch

from planners.data.batch import ImageLayout, Needs
from planners.data.images import PictureCache, picture_key, stitch
from planners.data.index import Dataset, DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tasks.world.arrays import Bytes
from tests.bench.timing import least_and_median_cpu_ms
from tests.planners.samples import camera, sample, write_table
from tests.planners.samples import jpeg as encoded

RIG = Path("../shared/data/openscene_0101")
KEYFRAME = Path("../shared/data/nuscenes_frame")
LEFT_TO_RIGHT = ("CAM_L1", "CAM_L0", "CAM_F0", "CAM_R0", "CAM_R1")
YAWS = dict(zip(LEFT_TO_RIGHT, np.deg2rad([110.0, 55.0, 0.0, -55.0, -110.0]).tolist()))
BATCH = 16
PASSES = 3


def main(samples: int = 48, cores: int | None = None, cameras: int = 3, width: int = 2048, height: int = 512) -> None:
    """Prints both tables."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    names = LEFT_TO_RIGHT[1 : 1 + cameras] if cameras < len(LEFT_TO_RIGHT) else LEFT_TO_RIGHT
    layout = ImageLayout(cameras=names, width=width, height=height, decoding="full")
    photos = photographed(names)
    mean_kb = np.mean([len(jpeg) for one in photos for jpeg in one]) / 1e3
    there = "a real rig's" if RIG.is_dir() else "made-up"
    print(f"{there} photos of 1920 x 1080, {mean_kb:.0f} kB each; {cameras} a sample to {width} x {height}; ", end="")
    print(f"best of {PASSES} passes, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    with tempfile.TemporaryDirectory() as folder:
        split(photos, layout, Path(folder) / "one")
        rates(photos, names, layout, samples, cores or os.cpu_count() or 1, folder)


def photographed(names: Sequence[str]) -> list[list[Bytes]]:
    """The JPEGs of several instants, of one camera after the other."""
    if RIG.is_dir():
        frames = [frame for frame in sorted(RIG.glob("frame_*")) if all((frame / f"{n}.jpg").exists() for n in names)]
        return [[np.fromfile(frame / f"{name}.jpg", np.uint8) for name in names] for frame in frames]
    made = made_up()
    return [[np.frombuffer(made[(i + k) % len(made)], np.uint8) for k in range(len(names))] for i in range(len(made))]


def made_up() -> list[bytes]:
    """JPEGs of 1920 x 1080 and quality 90: of the nuScenes keyframe's photos where they are at hand, else of noise."""
    pictures: list[Bytes] = []
    for file in sorted(KEYFRAME.rglob("*.jpg")):
        photo = cv2.imread(str(file))[..., ::-1]
        pictures += [np.ascontiguousarray(photo[shift:, shift:]) for shift in range(0, 90, 30)]
    if not pictures:
        noise = (np.random.default_rng(seed).integers(0, 256, (135, 240, 3), dtype=np.uint8) for seed in range(12))
        pictures = [cv2.resize(small, (1920, 1080), interpolation=cv2.INTER_CUBIC) for small in noise]
    return [encoded(cv2.resize(one, (1920, 1080), interpolation=cv2.INTER_AREA), 90) for one in pictures]


def split(photos: Sequence[Sequence[Bytes]], layout: ImageLayout, folder: Path) -> None:
    """CPU ms a sample of each step, on one thread, and how far a reduced picture is from the full one."""
    kept = PictureCache(folder, 100.0)
    room, out = np.empty(1920 * 1080 * 3, np.uint8), np.empty((layout.height, layout.width, 3), np.uint8)
    reduced = replace(layout, decoding="reduced")

    def each(call: Callable[[Sequence[Bytes]], object]) -> float:
        least, _ = least_and_median_cpu_ms(lambda: [call(jpegs) for jpegs in photos], PASSES)
        return least / len(photos)

    def decoded(jpegs: Sequence[Bytes], rows: int, columns: int) -> None:
        for jpeg in jpegs:
            simplejpeg.decode_jpeg(jpeg, "RGB", min_height=rows, min_width=columns, buffer=room)

    entries: list[float] = []

    def written(jpegs: Sequence[Bytes]) -> None:
        key = picture_key(jpegs, layout)
        (folder / key[:2] / f"{key[2:]}.rgb").unlink(missing_ok=True)
        kept.stitch(jpegs, layout, out)

    full_ms, whole_ms = each(lambda jpegs: decoded(jpegs, 1080, 1920)), each(lambda j: stitch(j, layout, out))
    half_ms, halves_ms = each(lambda jpegs: decoded(jpegs, 540, 960)), each(lambda j: stitch(j, reduced, out))
    written_ms, read_ms = each(written), each(lambda j: kept.stitch(j, layout, out))
    key_ms = each(lambda jpegs: picture_key(jpegs, layout))
    for jpegs in photos:
        other = np.empty_like(out)
        stitch(jpegs, layout, out)
        stitch(jpegs, reduced, other)
        entries.append(float(np.abs(out.astype(int) - other).mean()))
    print("| picture | JPEG | cut, resize, stitch | digest | write | read, check | all | samples / s, a core |")
    print("|---" * 8 + "|")
    rest = written_ms - whole_ms - key_ms
    lines = {
        "full": (full_ms, whole_ms - full_ms, 0.0, 0.0, 0.0),
        "reduced": (half_ms, halves_ms - half_ms, 0.0, 0.0, 0.0),
        "full, then kept": (full_ms, whole_ms - full_ms, key_ms, rest, 0.0),
        "kept": (0.0, 0.0, key_ms, 0.0, read_ms - key_ms),
    }
    for name, parts in lines.items():
        shown = " | ".join(f"{ms:.2f} ms" if ms else "-" for ms in parts)
        print(f"| {name} | {shown} | {sum(parts):.2f} ms | {1e3 / sum(parts):.0f} |")
    size_mb = (layout.height * layout.width * 3 + 4) / 1e6
    print(f"\na kept picture: {size_mb:.2f} MB, 100,000 of them {100 * size_mb:.0f} GB; a reduced picture is ", end="")
    print(f"{np.mean(entries):.2f} of 255 from the full one in the mean\n", flush=True)


def rates(
    photos: Sequence[Sequence[Bytes]], names: Sequence[str], layout: ImageLayout, n: int, cores: int, folder: str
) -> None:
    """A line for each number of workers."""
    table = Path(folder) / "table"
    write_table(table, [row(i, names, photos[i % len(photos)]) for i in range(n)], group_rows=8)
    settings = DataSettings(real=str(table))
    dataset = open_data(settings)
    kept = replace(dataset, settings=replace(settings, pictures=f"{folder}/pictures"))
    reduced = replace(layout, decoding="reduced")
    ways = {"full": (dataset, layout), "reduced": (dataset, reduced), "kept": (kept, layout)}
    bare_ms = _rate(dataset, Needs(), n, 1)[1]
    print("| workers | " + " | ".join(f"{way}: samples / s | by CPU second, a core" for way in ways) + " |")
    print("|---" * (1 + 2 * len(ways)) + "|")
    for workers in sorted({1, cores} | {w for w in (2, 4, 8, 16, 32) if w < cores}):
        cells = []
        for data, shown in ways.values():
            per_second, cpu_ms = _rate(data, Needs(image=shown), n, workers)
            cells.append(f"{per_second:.0f} | {1e3 / cpu_ms:.0f} ({cpu_ms:.2f} ms)")
        print(f"| {workers} | {' | '.join(cells)} |", flush=True)
    print(f"\na sample without its picture: {bare_ms:.2f} ms of CPU, mostly with the interpreter's lock: ", end="")
    print(f"a process ends at some {1e3 / bare_ms:.0f} samples / s, whatever its workers\n", flush=True)


def _rate(data: Dataset, needs: Needs, n: int, workers: int) -> tuple[float, float]:
    """Samples a second and CPU ms a sample: the best passes, after one that reads the table and keeps pictures."""
    mix = MixSettings(shuffle_mb=n * 2)  # samples stay in memory, decoded pictures do not
    loader = Loader(data, needs, mix, min(BATCH, n), workers=workers)
    best = [0.0, float("inf")]
    for epoch in range(1 + PASSES):
        clock, cpu = time.perf_counter(), time.process_time()
        seen = sum(len(batch) for batch in loader.epoch(epoch))
        if epoch:
            best[0] = max(best[0], seen / (time.perf_counter() - clock))
            best[1] = min(best[1], 1e3 * (time.process_time() - cpu) / seen)
    return best[0], best[1]


def row(number: int, names: Sequence[str], jpegs: Sequence[Bytes]) -> dict[str, object]:
    """A human sample with these photos at now; what is behind a JPEG's end makes them its own."""
    images = [
        {
            "camera": name,
            "time_s": 0.0,
            "ego_pose": np.eye(4).reshape(16),
            "jpeg": jpeg.tobytes() + f"{number}".encode(),
        }
        for name, jpeg in zip(names, jpegs)
    ]
    cameras = [camera(name, YAWS[name], 1920, 1080) for name in names]
    return sample(number, cameras=cameras, images=images, image_source="photo")


if __name__ == "__main__":
    main(**{name: int(value) for name, value in (word.split("=", 1) for word in sys.argv[1:])})
