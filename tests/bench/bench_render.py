"""CPU milliseconds of the rasteriser on one core: `python -m tests.bench.bench_render`."""

import time

import numpy as np

from tasks.render.gaussians import Gaussians
from tasks.render.raster import gather, shade, splat


def cloud(n: int) -> Gaussians:
    """Discs a few pixels wide, all over the view, 3 m to 60 m away."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(3.0, 60.0, n)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        np.stack([rng.uniform(-0.7, 0.7, n) * depth, rng.uniform(-0.4, 0.4, n) * depth, depth], 1).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        (np.log(0.004 * depth)[:, None] + rng.normal(0.0, 0.4, (n, 3))).astype(np.float32),
        rng.uniform(0.5, 0.95, n).astype(np.float32),
        rng.uniform(0.0, 1.0, (n, 3)).astype(np.float32),
    )


def main() -> None:
    """Prints a table: Gaussians, size, and the median of nine runs of each step."""
    print("| Gaussians | pixels | project and sort, ms | blend, ms | carry back, ms |")
    print("|---|---|---|---|---|")
    for n, width, height in ((100_000, 320, 180), (100_000, 480, 270), (400_000, 320, 180)):
        scene = cloud(n)
        intrinsics = np.array([[0.81 * width, 0, width / 2], [0, 0.81 * width, height / 2], [0, 0, 1]])
        times = []
        for _ in range(10):
            start = time.process_time()
            splats = splat(scene, intrinsics, np.eye(4), width, height)
            sorted_at = time.process_time()
            view = shade(splats, scene.colours[splats.index], np.zeros(3, np.float32))
            blended_at = time.process_time()
            gather(splats, view.rgb)
            times.append([sorted_at - start, blended_at - sorted_at, time.process_time() - blended_at])
        project_ms, blend_ms, gather_ms = 1000 * np.median(times[1:], axis=0)
        print(f"| {n:,} | {width}x{height} | {project_ms:.0f} | {blend_ms:.0f} | {gather_ms:.0f} |")


if __name__ == "__main__":
    main()
