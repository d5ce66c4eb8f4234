"""A block of the synthetic town, reconstructed and looked at where no photo was: `python -m tests.bench.bench_town`.

The painter of the town knows what is to be seen from everywhere: from held-out photos' poses, from 1 and 2 m to either
side, turned by 20 degrees (road, vehicles and the rest apart), and with every vehicle put 3 m ahead and 0.8 m to the
left. Only photos, lidar, poses and boxes go into the scene. Options: log=0 width=320 height=180 steps=1 (of 0.1 s
between photos) out=out/bench_town threads=2 and the settings of `FitSettings`.
A camera that would be within 0.6 m of somebody's box is left out. With moved vehicles all pixels count whose sight line
meets the box of one of them within 40 m, whatever else is in front.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.draw import TownRenderer, paint
from factory.datasets.town.drive import TownDrive
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import log_name, plan_log, write_log
from factory.stages.sensors import block_of, load_sensors
from factory.views.scene_files import camera_rows
from tasks.render.fit.reconstruct import LEAST_PIXELS as LEAST_OF_CLASS
from tasks.render.fit.reconstruct import finish_scene, run_iterations
from tasks.render.fit.start import prepare_fit
from tasks.render.scene.build import held_out_rows
from tasks.render.scene.movers import agents_at_time
from tasks.render.scene.sensed import Photo
from tasks.render.settings import FitSettings
from tasks.world.clip import Camera, Pinhole
from tests.bench.stored_scene import Look, kept, storage_table
from tests.bench.town_truth import MOVED_M, Compared, Painter, Truth, beside, sideways

SETTINGS = FitSettings(
    iterations=4000,
    start_gaussians=100_000,
    most_gaussians=150_000,
    start_node_gaussians=2_000,
    start_every=4,
    stereo_photos=0,  # lidar reaches as high as the cameras
    road_share=1.0,
    ssim_weight=0.2,
    mean_rate=3.2e-3,
    mean_rate_end=0.15,
    quat_rate=8e-3,
    opacity_rate=0.16,
    colour_rate=2.4e-2,
    sky_rate=1e-2,
    opaque_weight=0.1,  # a road with holes is no road
    exposure_rate=0.0,  # the town's cameras agree, and know where they are
    pose_from=1_000_000,
)
CENTRE = "ring_front_center"
CLASSES = ("road", "vehicles", "rest")


def painter(renderer: TownRenderer) -> Painter:
    """Paints what a photo's camera would see at a time since the log's start."""

    def painted(time_s: float, photo: Photo) -> NDArray[np.uint8]:
        height, width = photo.rgb.shape[:2]
        camera = Camera(photo.camera, width, height, photo.intrinsics, np.zeros(5), np.eye(4))
        return paint(renderer.scene_at(round(10.0 * time_s)), camera, photo.world_from_camera)

    return painted


def with_moved_vehicles(drive: TownDrive) -> TownDrive:
    """The drive with its vehicles put MOVED_M from where they are."""
    tracks = []
    for track in drive.tracks:
        if track.category not in ("PEDESTRIAN", "BICYCLIST"):
            c, s = np.cos(track.poses[:, 2]), np.sin(track.poses[:, 2])
            off = np.stack([MOVED_M[0] * c - MOVED_M[1] * s, MOVED_M[0] * s + MOVED_M[1] * c, 0.0 * c], axis=1)
            track = replace(track, poses=track.poses + off)
        tracks.append(track)
    return replace(drive, tracks=tuple(tracks))


def row(name: str, views: Sequence[Compared]) -> str:
    """A line of the table: means over the views, the worst PSNR, mean PSNR by class."""
    scores = np.array([(view.psnr_db, view.ssim) for view in views])
    told = [f"{scores[:, 0].mean():.2f}", f"{scores[:, 1].mean():.3f}"]
    told += [f"{scores[:, 0].min():.1f}", *(by_class(views, of) for of in CLASSES), str(len(views))]
    return f"| {name} | " + " | ".join(told) + " |"


def by_class(views: Sequence[Compared], name: str) -> str:
    """Mean PSNR inside a class, of the views that show it."""
    shown = [view for view in views if name in view.classes and view.classes[name].sum() >= LEAST_OF_CLASS]
    return f"{np.mean([view.psnr_db_in(view.classes[name]) for view in shown]):.2f}" if shown else ""


def main() -> None:
    """Writes the log, trains, prints a table."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    log, threads = int(options.pop("log", "0")), int(options.pop("threads", "2"))
    width, height = int(options.pop("width", "320")), int(options.pop("height", "180"))
    steps, out = int(options.pop("steps", "1")), Path(options.pop("out", "out/bench_town"))
    kinds = {field.name: type(getattr(SETTINGS, field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})

    town, drive = plan_log(0, log)
    root = out / f"log{log}-{width}x{height}-{steps}"
    if not root.exists():
        began = time.perf_counter()
        sensors = TownSettings(width=width, height=height, steps_per_photo=steps)
        write_log(root / log_name(0, log), town, drive, sensors, log)
        print(f"writing the log {time.perf_counter() - began:.0f} s", flush=True)
    reader = AV2Reader(root, name="synthetic")
    clip = reader.read(reader.index().refs[0])
    block = block_of(clip)
    data = load_sensors(block, clip.cameras, width, height)
    began, cpu = time.perf_counter(), time.process_time()
    problem, state = prepare_fit(data.photos, data.sweeps, block.agents, settings, threads=threads)
    prepared = time.perf_counter()
    print(f"{len(data.photos)} photos, {len(data.sweeps)} sweeps, prepared {prepared - began:.0f} s", flush=True)

    def told(iteration: int, loss: float, score: float) -> None:
        if iteration % 500 == 0:
            seconds = time.perf_counter() - prepared
            print(f"{iteration}: loss {loss:.4f}, training photos {score:.2f} dB, {seconds:.0f} s", flush=True)

    run_iterations(problem, state, settings, settings.iterations, told, threads)
    asset = finish_scene(problem, state, threads)
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - cpu

    photos = [data.photos[i] for i in sorted(held_out_rows(data.photos, settings.hold_out_every))]
    ahead = {photo.time_s: photo for photo in photos if photo.camera == CENTRE}
    views = Truth(
        kept(asset),
        block.agents,
        painter(TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)),
        painter(
            TownRenderer(town.scenery, with_moved_vehicles(drive), town.sun_azimuth, town.sun_elevation, town.sky_seed)
        ),
        problem.road,
    )
    kinds_of_view = {
        "held out": views.compared(photos),
        "1 m to the left": views.compared([sideways(p, ahead[p.time_s], 1.0) for p in photos]),
        "1 m to the right": views.compared([sideways(p, ahead[p.time_s], -1.0) for p in photos]),
        "2 m to the left": views.compared([sideways(p, ahead[p.time_s], 2.0) for p in photos]),
        "2 m to the right": views.compared([sideways(p, ahead[p.time_s], -2.0) for p in photos]),
        "turned 20 degrees left": views.compared([beside(p, left_rad=np.deg2rad(20.0)) for p in photos]),
        "turned 20 degrees right": views.compared([beside(p, left_rad=-np.deg2rad(20.0)) for p in photos]),
        "moved vehicles, inside their boxes": views.compared_moved(photos),
    }
    print(f"\n| log {log} at {width}x{height} | PSNR [dB] | SSIM | worst [dB] | road | vehicles | rest | views |")
    print("|---|---|---|---|---|---|---|---|")
    for name, compared in kinds_of_view.items():
        print(row(name, compared))
    print()
    for told in camera_rows(asset.views):
        print(f"{told.camera}, against the JPEG photos: {told.text}")
    looks = [
        Look(p.camera, p.time_s, Pinhole(p.intrinsics, p.world_from_camera, width, height), p.rgb, there)
        for p in photos
        for there in [agents_at_time(block.agents, p.time_s)]
    ]
    print(f"\n{storage_table(asset, looks, threads)}")
    took = f"{seconds:.0f} s on {threads} threads, CPU {cpu_s:.0f} s"
    print(f"\n{settings.iterations} iterations, {len(state)} Gaussians, {took}")


if __name__ == "__main__":
    main()
