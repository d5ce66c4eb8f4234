"""What a block of eight cameras takes at three sizes: `python -m tests.bench.bench_sizes <openscene_0101> [n=v]`.

Each size is fitted for a few iterations in a process of its own: CPU seconds to prepare, an iteration and a picture,
and memory at most. Calibration is as given: how well it comes out is `bench_scenes`' question. `iterations=` are timed
after as many that are not; `threads=` share them, `sizes=` names others; other names are those of `FitSettings`.
"""

import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from factory.stages.sensors import load_photos
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.scene.asset import psnr
from tasks.render.scene.engine import encode_jpeg, render
from tasks.render.scene.movers import PlacedAgents
from tasks.render.settings import FitSettings
from tasks.world.clip import Pinhole
from tests.bench.sidecars import read_openscene

SIZES = "480x270,960x540,1920x1080"
SETTINGS = replace(FitSettings(), start_gaussians=300_000, most_gaussians=350_000)
HELD_OUT_S = (2.0, 5.5)
MODULE = "tests.bench.bench_sizes"
JPEG_QUALITY = 90  # the default of runs
MB = 2**10  # of ru_maxrss, which is in KB


def main() -> None:
    """Prints one row a size."""
    told = "size | photos | MB of photos | CPU s to prepare | an iteration | a picture | peak memory [MB] | a JPEG [kB]"
    print(f"| {told} |\n|---|---|---|---|---|---|---|---|", flush=True)
    root, *options = sys.argv[1:]
    sizes = next((option for option in options if option.startswith("sizes=")), f"sizes={SIZES}")
    rest = [root, *(option for option in options if option != sizes)]
    for size in sizes.removeprefix("sizes=").split(","):
        subprocess.run([sys.executable, "-m", MODULE, "--one", size, *rest], check=True)


def one(size: str, root: Path, options: dict[str, str]) -> None:
    """One row."""
    width, height = (int(part) for part in size.split("x"))
    n, threads = int(options.pop("iterations", "40")), int(options.pop("threads", "2"))
    kinds = {name: type(value) for name, value in vars(SETTINGS).items()}
    settings = replace(SETTINGS, iterations=2 * n, **{k: kinds[k](float(v)) for k, v in options.items()})
    drive = read_openscene(root)
    photos = load_photos(drive.block.images, drive.cameras, width, height)
    held_out = [row for row, photo in enumerate(photos) if photo.time_s in HELD_OUT_S]
    started = time.process_time()
    problem, state = prepare_fit(photos, [], None, settings, held_out, threads)
    prepared = time.process_time() - started
    run_iterations(problem, state, settings, n, threads=threads)
    started = time.process_time()
    run_iterations(problem, state, settings, 2 * n, threads=threads)
    each = (time.process_time() - started) / n
    asset, photo = finish_scene(replace(problem, held_out=()), state, threads), photos[0]
    eye = Pinhole(photo.intrinsics, photo.world_from_camera, width, height)
    nobody = PlacedAgents((), (), problem.tracks.at(0.0)[0])
    render(asset, [eye], nobody, threads=threads)
    started = time.process_time()
    picture = render(asset, [eye], nobody, threads=threads)[0].rgb
    drawn = time.process_time() - started
    assert psnr(picture, photo.rgb.astype("float32") / 255.0) > 10.0
    peak, held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MB, sum(p.rgb.nbytes for p in photos) / 2**20
    jpeg = np.mean([len(encode_jpeg(p.rgb, JPEG_QUALITY)) for p in photos[::5]]) / 1e3
    row = f"{size} | {len(photos)} | {held:.0f} | {prepared:.0f} | {each:.3f} | {drawn:.2f} | {peak:,.0f} | {jpeg:.0f}"
    print(f"| {row} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        one(sys.argv[2], Path(sys.argv[3]), dict(option.split("=", 1) for option in sys.argv[4:]))
    else:
        main()
