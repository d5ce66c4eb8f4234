"""Scenes of four data sets as the product makes and measures them, in one table: `python -m tests.bench.bench_scenes
out=<folder> openscene=<openscene_0101> front=<nuscenes_front> kitti=<kitti_raw>`

openscene_0101 (nuPlan's eight cameras at 2 Hz, no lidar) and KITTI's drive 0001 (one camera at 10 Hz, lidar) are given
as sidecars, as `factory scene build` takes them, nuScenes' front camera (2 Hz, no lidar) and the synthetic town (three
cameras, lidar) as logs. Every eighth photo of a camera is held out: matched for its pose where a rig is corrected, and
nothing else is taken from it. openscene_0101 comes twice, without boxes and with those of its two movers made by hand.
Sky: how far the mean colour of held-out photos' sky is from what is drawn there, of 255. What is left out of the
command is left out of the table; `iterations=` takes fewer for a quick look. A scene that lies in `out` is measured,
not built.
"""

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from factory.config.compose import compose, fill
from factory.config.run import load_config
from factory.datasets.scenarionet.photos import read_photo_drive
from factory.readers.base import read_clip
from factory.setup.settings import assemble
from factory.stages.assets import load_or_build_scene
from factory.stages.sensors import block_of, choose_cameras, load_photos
from tasks.render.scene.asset import RenderAsset, camera_psnr_db
from tasks.render.scene.engine import render
from tasks.render.scene.movers import agents_at_time
from tasks.render.settings import RenderSettings
from tasks.world.clip import Camera, Clip, PhotoDrive, Pinhole, front_camera
from tests.bench.bench_guess import FRONT, TOWN
from tests.bench.kitti import read_drive
from tests.bench.sidecars import read_openscene, write_kitti_sidecar

OPENSCENE = "width=480 height=270 fit.iterations=6000 fit.start_gaussians=300000 fit.most_gaussians=350000"
OPENSCENE += " fit.stereo_photos=6 fit.start_opacity=0.3 fit.stretch=4"
KITTI = "width=397 height=120 fit.iterations=8000 fit.start_gaussians=360000 fit.most_gaussians=400000"
KITTI += " fit.exposure_rate=0"
NO_SCENE = 0.05  # alpha below which a pixel is sky alone
HEAD = "data | photos | size, iterations | PSNR [dB] / SSIM | camera ahead | worst camera | sky | own body | CPU s"


def settings_of(words: str, iterations: str | None) -> RenderSettings:
    """A run's, of words without `render.`."""
    given = [f"render.{word}" for word in words.split()]
    given += [] if iterations is None else [f"render.fit.iterations={iterations}"]
    return fill(RenderSettings, compose("run", given)["render"], "render")


def of_logs(overrides: list[str], out: Path) -> Iterator[tuple[Clip, RenderSettings]]:
    """The first clip of each log of a run."""
    work, seen = assemble(load_config([*overrides, f"out={out}"])).work, set[str]()
    for ref in work.reader.index().refs:
        if ref.log_id not in seen:
            seen.add(ref.log_id)
            yield read_clip(work.reader, ref), work.render


def drives(options: dict[str, str], out: Path) -> Iterator[tuple[str, Clip | PhotoDrive, RenderSettings]]:
    """What is asked for, with its settings."""
    fewer = options.get("iterations")
    if "openscene" in options:
        root = Path(options["openscene"])
        for name, movers in (("openscene_0101", False), ("openscene_0101, movers in boxes", True)):
            yield name, read_openscene(root, movers), settings_of(OPENSCENE, fewer)
    if "front" in options:
        root = Path(options["front"])
        given = [f"clips.root={next(root.glob('*.pkl'))}", f"clips.cameras={root}"]
        given += [] if fewer is None else [f"render.fit.iterations={fewer}"]
        for clip, settings in of_logs([*FRONT, *given], out):
            yield "nuscenes_front", clip, settings
    if "kitti" in options:
        drive, folder = read_drive(Path(options["kitti"])), out / "kitti_0001"
        if not folder.exists():
            write_kitti_sidecar(drive, folder)
        yield "KITTI 0001", read_photo_drive(folder / "cameras.json", folder), settings_of(KITTI, fewer)
    if options.get("town", "1") != "0":
        for clip, settings in of_logs(TOWN, out):
            yield f"town, {clip.log_id}", clip, settings


def sky_off(asset: RenderAsset, drive: Clip | PhotoDrive, cameras: tuple[Camera, ...], size: tuple[int, int]) -> float:
    """Of held-out photos with sky, mean over them of how far the mean colour of it is from what is drawn, of 255."""
    held_out = {(view.camera, round(view.time_s, 3)) for view in asset.views if view.held_out}
    files = [f for f in asset.photos_of(block_of(drive).images) if (f.sensor, round(f.time_s, 3)) in held_out]
    agents, off = asset.settled(block_of(drive).agents, 0.0), []
    for file, photo in zip(files, load_photos(files, asset.as_corrected(cameras), *size)):
        eye = Pinhole(photo.intrinsics, photo.world_from_camera, *size)
        there = agents_at_time(agents, file.time_s, file.world_from_ego[:2, 3], 100.0)
        affine = asset.affine_of(photo.camera, photo.time_s)
        view = render(asset, [eye], there, affines=[affine], threads=2)[0]
        sky = view.alpha < NO_SCENE
        if sky.mean() > 0.01:
            off.append(np.abs((255.0 * view.rgb[sky] - photo.rgb[sky]).mean(axis=0)).mean())
    return float(np.mean(off)) if off else float("nan")


def main() -> None:
    """Builds and prints a row for each scene."""
    options = dict(option.split("=", 1) for option in sys.argv[1:])
    out = Path(options.get("out", "out/bench_scenes"))
    print(f"| {HEAD} |\n|---|---|---|---|---|---|---|---|---|", flush=True)
    for name, drive, settings in drives(options, out):
        started = time.process_time()
        asset = load_or_build_scene(drive, settings, out / "cache", os.cpu_count() or 1)
        assert asset is not None
        took = time.process_time() - started
        cameras = choose_cameras(drive.cameras, settings.cameras)
        names = [camera.name for camera in cameras]
        ahead = front_camera(names, np.array([camera.ego_from_camera[:2, 2] for camera in cameras]))
        each = camera_psnr_db(asset)
        worst = min(each, key=lambda camera: each[camera])
        views = [view for view in asset.views if view.held_out]
        ssim = np.mean([view.ssim for view in views])
        body = f"{len(asset.bodies)} of {len(cameras)}"
        sky = sky_off(asset, drive, cameras, (settings.width, settings.height))
        print(
            f"| {name} | {len(asset.photos_of(block_of(drive).images))}, {len(views)} held out | "
            f"{settings.width}x{settings.height}, {settings.fit.iterations:,} | {asset.psnr_db:.2f} / {ssim:.3f} | "
            f"{each[ahead or worst]:.2f} | {worst} {each[worst]:.2f} | {sky:.1f} | {body} | {took:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
