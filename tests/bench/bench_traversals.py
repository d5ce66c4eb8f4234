"""Another drive through the same place: what it brings a block's scene: `python -m tests.bench.bench_traversals`.

Two logs of the synthetic town whose drives share a street. The first's block is fitted to its own photos and sweeps
and, with as many iterations, to those of both (`clips.traversals=1`); the same photos of the first are held out, and
each scene is held against the painter from where they were taken, from 2 m to either side and turned by 20 degrees. The
second's photos are drawn from the first's scene alone: a drive that the scene never saw. Parked cars stay where they
are between two drives of the town, and so does the sun: of real logs expect less. Options: log=2 other=16 hz=2
width=240 height=136 out=out/bench_traversals threads=2 and the settings of `FitSettings`.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.draw import TownRenderer
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import log_name, plan_log, write_log
from factory.stages.assets import without_other_logs
from factory.stages.sensors import block_cameras, block_of, load_sensors
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.scene.build import held_out_rows
from tasks.render.scene.sensed import Photo
from tasks.render.settings import FitSettings
from tests.bench.bench_town import CENTRE, SETTINGS, by_class, painter
from tests.bench.stored_scene import kept
from tests.bench.town_truth import Painter, Truth, beside, sideways

STEPS_PER_S = 10
SIDES = {"left": 1.0, "right": -1.0}


def _renderer(index: int) -> TownRenderer:
    town, drive = plan_log(0, index)
    return TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)


def _row(name: str, truth: Truth, photos: Sequence[Photo]) -> str:
    views = truth.compared(photos)
    scores = np.array([(view.psnr_db, view.ssim) for view in views])
    classes = (by_class(views, of) for of in ("road", "vehicles", "rest"))
    told = [f"{scores[:, 0].mean():.2f}", f"{scores[:, 1].mean():.3f}", *classes, str(len(views))]
    return f"| {name} | " + " | ".join(told) + " |"


def main() -> None:
    """Writes both logs, trains twice, prints a table each."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    log, other, hz, threads = (
        int(options.pop(name, usual)) for name, usual in (("log", "2"), ("other", "16"), ("hz", "2"), ("threads", "2"))
    )
    width, height = int(options.pop("width", "240")), int(options.pop("height", "136"))
    out = Path(options.pop("out", "out/bench_traversals"))
    kinds = {field.name: type(getattr(SETTINGS, field.name)) for field in fields(FitSettings)}
    usual = replace(SETTINGS, iterations=800, start_node_gaussians=3000, opaque_weight=0.0)
    settings = replace(usual, **{k: kinds[k](float(v)) for k, v in options.items()})
    root = out / f"logs{log}-{other}-{width}x{height}-{hz}hz"
    sensors = TownSettings(width=width, height=height, steps_per_photo=STEPS_PER_S // hz)
    for index in (log, other):
        if not (root / log_name(0, index)).exists():
            write_log(root / log_name(0, index), *plan_log(0, index), sensors, index)

    painted: Painter = painter(_renderer(log))
    for traversals in (0, 1):
        reader = AV2Reader(root, name="synthetic", traversals=traversals)
        refs = reader.index().refs
        clip = reader.read(next(ref for ref in refs if ref.log_id == log_name(0, log)))
        block, began = block_of(clip), time.process_time()
        data = load_sensors(block, block_cameras(block, clip.cameras), width, height)
        held_out = held_out_rows(data.photos, settings.hold_out_every)
        problem, state = prepare_fit(data.photos, data.sweeps, block.agents, settings, held_out, threads)
        run_iterations(problem, state, settings, settings.iterations, threads=threads)
        asset = kept(without_other_logs(finish_scene(problem, state, threads)))
        took = time.process_time() - began
        photos = [data.photos[i] for i in sorted(held_out)]
        ahead = {photo.time_s: photo for photo in photos if photo.camera == CENTRE}
        truth = Truth(asset, block.agents, painted, painted, problem.road)
        drives = f"{traversals + 1} drive{'s' * traversals}, {len(data.photos)} photos, {len(state)} Gaussians"
        print(f"\n| {drives}, {took:.0f} CPU s | PSNR [dB] | SSIM | road | vehicles | rest | views |")
        print("|---|---|---|---|---|---|---|")
        turned = {side: [beside(p, left_rad=sign * np.deg2rad(20.0)) for p in photos] for side, sign in SIDES.items()}
        shifted = {side: [sideways(p, ahead[p.time_s], sign * 2.0) for p in photos] for side, sign in SIDES.items()}
        print(_row("held out", truth, photos))
        for side in SIDES:
            print(_row(f"2 m to the {side}", truth, shifted[side]))
            print(_row(f"turned 20 degrees {side}", truth, turned[side]), flush=True)
        if not traversals:
            theirs = next(ref for ref in refs if ref.log_id == log_name(0, other))
            seen = block_of(reader.read(theirs))
            drive = load_sensors(replace(seen, sweeps=()), clip.cameras, width, height).photos
            along = [photo for photo in drive if _near(photo, data.photos)]
            others = Truth(replace(asset, nodes={}), seen.agents, painter(_renderer(other)), painted, problem.road)
            print(_row("a drive that was not seen", others, along[:: max(1, len(along) // 24)]), flush=True)


def _near(photo: Photo, photos: Sequence[Photo]) -> bool:
    places = np.stack([other.world_from_camera[:3, 3] for other in photos])
    return bool((np.linalg.norm(places - photo.world_from_camera[:3, 3], axis=1) < 4.0).any())


if __name__ == "__main__":
    main()
