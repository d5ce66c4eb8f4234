"""The CPU rasteriser at 480x270, there and back: `python -m tests.bench.bench_render [SCENE] [--threads 2]`.

Row one is a seeded cloud of 100,000 Gaussians; row two, where a scene file is named, the street of that scene from the
middle of its block. The clock is the wall's; CPU time stands beside it, for a machine that does other things as well.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.stages.scene_file import read_scene
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gradient import backward
from tasks.render.splatting.raster import forward, project_and_sort
from tests.bench.timing import cpu_milliseconds, milliseconds

WIDTH, HEIGHT = 480, 270
INTRINSICS = np.array([[0.6 * WIDTH, 0.0, WIDTH / 2], [0.0, 0.6 * WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]])
SIGMA_PX = 2.155  # gives 3.6 tiles per Gaussian
REPEATS, IN_CLOUD = 15, 100_000
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
        seen = len(project_and_sort(street, INTRINSICS, camera, WIDTH, HEIGHT).index)
        if seen > most:
            best, most = camera, seen
    return street, best


def row(name: str, scene: Gaussians, camera: NDArray[np.float64], threads: int, repeats: int) -> None:
    """Prints the scene's two lines of the table, there and there and back."""
    view = (scene, INTRINSICS, camera, WIDTH, HEIGHT, BLACK, threads)
    record = forward(*view)
    upstream = np.random.default_rng(1).normal(size=record.view.rgb.shape).astype(np.float32)
    calls: list[tuple[str, Callable[[], object]]] = [
        ("forward", lambda: forward(*view)),
        ("and backward", lambda: backward(forward(*view), scene, upstream, threads=threads)),
    ]
    for what, call in calls:
        times = f"{milliseconds(call, repeats):.0f} | {cpu_milliseconds(call, repeats):.0f}"
        print(f"| {name} | {len(scene):,} | {len(record.splats.index):,} | {what} | {times} |", flush=True)


def main(scene: Path | None = None, threads: int = 2, in_cloud: int = IN_CLOUD, repeats: int = REPEATS) -> None:
    """Prints the table; the second row only where a scene file is given."""
    print(f"\nrasteriser, {WIDTH}x{HEIGHT}, {threads} threads, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("\n| scene | Gaussians | in view | what | ms | CPU ms |\n|---|---|---|---|---|---|")
    row("seeded", cloud(in_cloud), np.eye(4), threads, repeats)
    if scene is not None:
        row(scene.stem, *street_view(scene), threads, repeats)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, help="a scene file that a reconstruction wrote")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    main(given.scene, given.threads)
