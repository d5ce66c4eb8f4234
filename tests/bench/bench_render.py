"""The CPU rasteriser at 480x270, there and back: `python -m tests.bench.bench_render [SCENE] [--threads 2]`.

Row one is a seeded cloud of 100,000 Gaussians; row two, where a scene file is named, the street of that scene from the
middle of its block. The clock is the wall's; CPU time stands beside it, for a machine that does other things as well.
Before them comes the peak memory of a large picture. PEER=<a checkout of OpenSplat> draws the same views with its
compiled CPU rasteriser in turns with ours; it blurs each Gaussian by 0.3 px^2, ours by 0.1, hence two pictures.
"""

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.stages.scene_file import read_scene
from tasks.render.scene.engine import render
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gradient import backward
from tasks.render.splatting.raster import forward, splat
from tasks.world.clip import Pinhole
from tests.bench.peer_splat import Draw, compiled, drawing, peer_checkout
from tests.bench.timing import cpu_milliseconds, memory_mb, milliseconds

Picture = NDArray[np.float32]

WIDTH, HEIGHT = 480, 270
INTRINSICS = np.array([[0.6 * WIDTH, 0.0, WIDTH / 2], [0.0, 0.6 * WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]])
SIGMA_PX = 2.155  # gives 3.6 tiles per Gaussian
LARGE = (2048, 1536)
REPEATS = 15
PEER_TURNS = 7
BLACK = np.zeros(3, np.float32)
EYE_M = 1.6


def cloud(n: int) -> Gaussians:
    """All over the view, 2 m to 60 m away, opacity 0.1 to 0.9."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(2.0, 60.0, n)
    u, v = rng.uniform(0.0, WIDTH, n), rng.uniform(0.0, HEIGHT, n)
    quats = rng.normal(size=(n, 4))
    rays = np.stack([(u - WIDTH / 2) / INTRINSICS[0, 0], (v - HEIGHT / 2) / INTRINSICS[1, 1], np.ones(n)], 1)
    sigma = SIGMA_PX * depth / INTRINSICS[0, 0]
    return Gaussians(
        (rays * depth[:, None]).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        (np.log(sigma)[:, None] + rng.normal(0.0, 0.4, (n, 3))).astype(np.float32),
        rng.uniform(0.1, 0.9, n).astype(np.float32),
        rng.uniform(0.0, 1.0, (n, 3)).astype(np.float32),
    )


def street_view(scene: Path) -> tuple[Gaussians, NDArray[np.float64]]:
    """The scene's street and the camera that sees most of it: level, from the middle, one of twelve ways."""
    street = read_scene(scene).background
    near, far = np.percentile(street.means[:, :2], [25, 75], axis=0)
    middle = (near + far) / 2.0
    around = np.linalg.norm(street.means[:, :2] - middle, axis=1) < 5.0
    ground = np.percentile(street.means[around if around.any() else slice(None), 2], 10)
    best, most = np.eye(4), -1
    for yaw in np.arange(12) * np.pi / 6.0:
        camera = np.eye(4)
        c, s = np.cos(yaw), np.sin(yaw)
        camera[:3, :3] = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])  # right, down, ahead
        camera[:3, 3] = (*middle, ground + EYE_M)
        seen = len(splat(street, INTRINSICS, camera, WIDTH, HEIGHT).index)
        if seen > most:
            best, most = camera, seen
    return street, best


def row(name: str, scene: Gaussians, camera: NDArray[np.float64], threads: int, peer: Draw | None) -> None:
    """Prints the scene's two lines of the table, there and there and back; the peer's beside the first."""
    view = (scene, INTRINSICS, camera, WIDTH, HEIGHT, BLACK, threads)
    record = forward(*view)
    pairs, seen = len(record.splats.tile_splats), len(record.splats.index)
    upstream = np.random.default_rng(1).normal(size=record.view.rgb.shape).astype(np.float32)
    about = f"{name} | {len(scene):,} | {seen:,} | {pairs / max(seen, 1):.1f}"
    calls: list[tuple[str, Callable[[], object]]] = [
        ("forward", lambda: forward(*view)),
        ("forward + backward", lambda: backward(forward(*view), scene, upstream, threads=threads)),
    ]
    for what, call in calls:
        wall_s = milliseconds(call, REPEATS) / 1e3
        line = (
            f"| {about} | {what} | {1e3 * wall_s:.0f} | {cpu_milliseconds(call, REPEATS):.0f} | {1 / wall_s:.1f} "
            f"| {WIDTH * HEIGHT / wall_s / 1e6:.1f} | {pairs / wall_s / 1e6:.1f} |"
        )
        if peer is not None:
            theirs = drawing(peer, scene, INTRINSICS, camera, WIDTH, HEIGHT)
            line += f" {in_turns(call, theirs, record.view.rgb)} |" if what == "forward" else " | | |"
        print(line, flush=True)


def in_turns(ours: Callable[[], object], theirs: Callable[[], NDArray[np.float32]], picture: Picture) -> str:
    """The peer's CPU time, the ratios to ours of the same turn, and how far the two pictures are apart."""
    mse = float(np.mean((theirs() - picture) ** 2))
    times = np.empty((PEER_TURNS, 2))
    for turn in times:
        for i, call in enumerate((ours, theirs)):
            start = time.process_time()
            call()
            turn[i] = time.process_time() - start
    ratio = times[:, 1] / times[:, 0]
    ratios = " / ".join(f"{value:.1f}" for value in (ratio.min(), np.median(ratio), ratio.max()))
    return f"{1e3 * np.median(times[:, 1]):.0f} | {ratios} | {-10.0 * np.log10(mse):.1f}"


def memory() -> None:
    """Prints how much more memory than before the seeded cloud takes at its peak when drawn large, there and back."""
    intrinsics = INTRINSICS.copy()
    intrinsics[:2] *= LARGE[0] / WIDTH
    scene, view = cloud(100_000), (intrinsics, np.eye(4), *LARGE, BLACK)
    upstream = np.ones((LARGE[1], LARGE[0], 3), np.float32)
    warm = forward(scene.take(np.arange(9)), *view)
    backward(warm, scene, upstream)
    del warm
    before = memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew here
    record = forward(scene, *view)
    there = memory_mb("VmHWM") - before
    backward(record, scene, upstream)
    print(
        f"\n{LARGE[0]}x{LARGE[1]}, {len(scene):,} Gaussians, {len(record.splats.tile_splats):,} intersections: "
        f"peak memory {there:.0f} MB forward, {memory_mb('VmHWM') - before:.0f} MB forward + backward"
    )


def main(scene: Path | None = None, threads: int = 2) -> None:
    """Prints the table; the second row only where a scene file is given."""
    checkout = peer_checkout()
    peer = compiled(checkout) if checkout else None
    memory()  # first, for what others leave behind would be used again
    print(
        f"\nrasteriser, {WIDTH}x{HEIGHT}, {threads} threads, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n"
    )
    columns = ["scene", "Gaussians", "in view", "tiles each", "what", "ms", "CPU ms", "per s", "Mpix/s"]
    columns += ["M intersections/s"]
    if peer:
        columns += ["peer CPU ms", "peer / ours, least / median / most", "PSNR of the two dB"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    row("seeded", cloud(100_000), np.eye(4), threads, peer)
    if scene is not None:
        street, camera = street_view(scene)
        row(scene.stem, street, camera, threads, peer)
        asset = read_scene(scene)
        camera[:3, 3] += asset.origin
        draw = partial(render, asset, [Pinhole(INTRINSICS, camera, WIDTH, HEIGHT)], threads=threads)
        print(f"\nits picture by the engine, sky and all: {cpu_milliseconds(draw, REPEATS):.0f} CPU ms")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, help="a scene file that a reconstruction wrote")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    main(given.scene, given.threads)
