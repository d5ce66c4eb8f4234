"""Colours of a rig's cameras: `python -m tests.bench.bench_colours <openscene_0101> [hold_out=19,24] [setting=value]`.

A surround rig of eight cameras at 2 Hz. Photos are drawn from where their cameras were, as pictures of simulated drives
are drawn, and held against themselves: those that the fit saw and those held out, camera by camera. Instants 20 and 27
are kept for tests and are never read. Options: width=240 height=135 threads=2 hold_out=<instants, which only measure>
calibration=<file> and the settings of `FitSettings`.
"""

import json
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from factory.stages.sensors import load_photos
from tasks.render.fit.quality import drawn
from tasks.render.fit.reconstruct import advance, finish, pose_of
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import prepare
from tasks.render.scene.asset import psnr
from tasks.render.scene.sensed import Photo, shifted
from tasks.world.camera import Camera, Pinhole, SensorFile
from tests.bench.stored_scene import Look, kept, storage_table

TESTED = (20, 27)  # instants
SETTINGS = replace(FitSettings(), iterations=600, start_gaussians=60_000, most_gaussians=80_000, hold_out_every=0)


def surround_photos(
    folder: Path, width: int, height: int, calibration: Path | None = None
) -> tuple[list[Photo], list[int]]:
    """The photos without lens distortion, and the instant of each; instants kept for tests are not among them.

    `calibration`: a file with other `cameras` and `frames`.
    """
    told = json.loads((folder / "cameras.json").read_text())
    if calibration is not None:
        told |= json.loads(calibration.read_text())
    cameras, files, numbers = [], [], []
    for name, row in told["cameras"].items():
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = row["cam_to_ego"]["R"], row["cam_to_ego"]["t"]
        lens = np.array(row["dist_k1k2p1p2k3"])
        cameras.append(Camera(name, told["width"], told["height"], np.array(row["K"], np.float64), lens, mount))
    for at, frame in enumerate(told["frames"]):
        if frame["frame"] not in TESTED:
            pose, photos = np.array(frame["ego_to_world"]), folder / f"frame_{frame['frame']}"
            files += [SensorFile(c.name, str(photos / f"{c.name}.jpg"), at / told["rate_hz"], pose) for c in cameras]
            numbers += [frame["frame"]] * len(cameras)
    return list(load_photos(files, cameras, width, height)), numbers


def main() -> None:
    """Fits, and prints a line for each camera."""
    folder, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    width, height = int(options.pop("width", "240")), int(options.pop("height", "135"))
    threads = int(options.pop("threads", "2"))
    out = {int(number) for number in options.pop("hold_out", "19,24").split(",") if number}
    given = options.pop("calibration", "")
    kinds = {field.name: type(getattr(SETTINGS, field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})
    photos, numbers = surround_photos(folder, width, height, Path(given) if given else None)
    held_out = [i for i, number in enumerate(numbers) if number in out]

    cpu = time.process_time()
    problem, state = prepare(photos, [], None, settings, held_out, threads)
    advance(problem, state, settings, settings.iterations, threads=threads)
    asset = finish(problem, state, threads)
    print(f"{len(state)} Gaussians, {time.process_time() - cpu:.0f} CPU s")
    print("| camera | training | held out |")
    scene, rows, looks = kept(asset), [], []
    for name in dict.fromkeys(photo.camera for photo in photos):
        row = []
        for shots in (problem.train, problem.held_out):
            found = []
            for shot in (shot for shot in shots if shot.photo.camera == name):
                photo, pose = shot.photo, pose_of(problem, state, shot.photo)
                if shots is problem.held_out:
                    eye = Pinhole(photo.intrinsics, shifted(pose, problem.origin), width, height)
                    looks.append(Look(name, photo.time_s, eye, photo.rgb))
                found.append(psnr(drawn(scene, problem, photo, pose, threads), shot.compared.target.rgb))
            row.append(float(np.mean(found)) if found else np.nan)
        rows.append(row)
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in row) + " |")
    print("| mean | " + " | ".join(f"{value:.2f}" for value in np.mean(rows, axis=0)) + " |")
    similar = np.mean([view.ssim for view in asset.views]) if asset.views else np.nan
    print(f"held out: {asset.psnr_db:.2f} dB, SSIM {similar:.3f}")
    gains = [float(np.trace(exposure.affine[:, :3]) / 3.0) for exposure in asset.exposures]
    of = np.array([exposure.camera for exposure in asset.exposures])
    own = [float(np.mean(np.array(gains)[of == camera])) for camera in of]
    rest = np.sqrt(np.mean((np.array(gains) / np.array(own) - 1.0) ** 2))
    print(storage_table(asset, looks, threads))
    print(f"gains from scene to photo: {min(gains):.2f} to {max(gains):.2f}; photo against camera {rest:.3f} (RMS)")


if __name__ == "__main__":
    main()
