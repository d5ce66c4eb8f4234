"""A real rig of eight cameras at 2 Hz: `python -m tests.bench.bench_rig <openscene_0101> [setting=value]`.

Instants 20 and 27 of all cameras are held out: they are matched for their poses, and nothing else is taken from them.
With `validate=1` those two are not read at all and instants 18 and 24 are held out instead: what knobs are to be tuned
on. `adjust=0` leaves the calibration as given. Two vehicles drive by; the folder has no boxes, so theirs are given
here: they move in the fit, and their pixels are not measured; `movers=0` knows of none. Settings are those of
`FitSettings`, for instance iterations=2000. At the end of a line stands what each camera would have if the held-out
photos told their own colours, one affine each: what the light between two photos half a second apart costs.
"""

import json
import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from factory.datasets.scenarionet.photos import read_photo_drive
from factory.stages.assets import rig_report_lines
from factory.stages.sensors import load_photos, opened_photos
from tasks.render.fit.corrections import apply_exposure
from tasks.render.fit.losses import ssim
from tasks.render.fit.reconstruct import draw_photo, finish_scene, pixel_classes, refined_pose, run_iterations
from tasks.render.fit.start import FitPhoto, FitProblem, prepare_fit
from tasks.render.rig.correct import RigCorrection, correct_rig, detect_corners, estimate_ground_height
from tasks.render.scene.asset import psnr
from tasks.render.scene.features import KnownPoints, driven_road
from tasks.render.settings import FitSettings
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, AgentKind, AgentTracks, Camera, SensorFile
from tests.bench.sidecars import OPENSCENE_INSTANT_S, openscene_sidecar
from tests.bench.stored_scene import affine_between, kept

SIZE = (480, 270)
HELD_OUT, VALIDATED = (20, 27), (18, 24)
FIRST = 16
# Of each vehicle length, width, height [m] and where its middle is at an instant in the ego's frame [m], ahead and to
# the left, read off the photos: it faces the other way. An instant between two is half way.
MOVERS = {
    "saloon": (
        (4.9, 1.86, 1.45),
        {16: (26.2, 3.6), 17: (18.8, 3.1), 18: (12.3, 3.1), 19: (6.4, 3.6), 20: (-0.4, 4.0), 21: (-6.3, 3.6)}
        | {22: (-10.4, 3.1), 23: (-15.6, 3.2), 24: (-19.4, 3.1), 25: (-26.0, 3.5), 27: (-32.5, 3.0), 30: (-48.8, 2.9)},
    ),
    "van": (
        (5.15, 2.0, 1.75),
        {17: (-1.2, 4.6), 18: (-4.8, 4.6), 19: (-7.5, 4.2), 20: (-11.2, 4.3), 21: (-14.8, 4.2), 22: (-23.0, 4.4)},
    ),
}
SETTINGS = replace(FitSettings(), iterations=6000, start_gaussians=300_000, most_gaussians=350_000)


def read_block(root: Path, left_out: tuple[int, ...]) -> tuple[list[Camera], list[SensorFile], list[int]]:
    """The rig, its photos and the instant of each."""
    with TemporaryDirectory() as folder:
        sidecar = Path(folder, "cameras.json")
        sidecar.write_text(json.dumps(openscene_sidecar(root, left_out)))
        drive = read_photo_drive(sidecar, root)
    instants = [int(Path(file.uri).parent.name.removeprefix("frame_")) for file in drive.block.images]
    return list(drive.cameras), list(drive.block.images), instants


def movers(files: list[SensorFile], instants: list[int], ground_m: float) -> AgentTracks:
    """MOVERS on the road `ground_m` above the ego's origin, by the poses as corrected; away before and after."""
    poses = {instant: file.world_from_ego for file, instant in zip(files, instants)}
    n_steps, n = round((max(instants) - FIRST) * OPENSCENE_INSTANT_S / STEP_S) + 1, len(MOVERS)
    boxes, centre_z, valid = np.zeros((n_steps, n, 5)), np.zeros((n_steps, n)), np.zeros((n_steps, n), bool)
    steps = FIRST + np.arange(n_steps) * STEP_S / OPENSCENE_INSTANT_S
    for j, (size, places) in enumerate(MOVERS.values()):
        known = [instant for instant in places if instant in poses]
        at = np.array([poses[i] @ [*places[i], ground_m + 0.5 * size[2], 1.0] for i in known])[:, :3]
        headings = [np.arctan2(poses[i][1, 0], poses[i][0, 0]) + np.pi for i in known]
        for k, row in enumerate((*at[:, :2].T, np.unwrap(headings))):
            boxes[:, j, k] = np.interp(steps, known, row)
        boxes[:, j, 3:], centre_z[:, j] = size[:2], np.interp(steps, known, at[:, 2])
        valid[:, j] = (steps >= known[0] - 1e-6) & (steps <= known[-1] + 1e-6)
    kinds, heights = (AgentKind.VEHICLE,) * n, np.array([size[2] for size, _ in MOVERS.values()])
    return AgentTracks(tuple(MOVERS), kinds, boxes, np.zeros((n_steps, n, 2)), valid, centre_z, heights)


def correct(cameras: list[Camera], files: list[SensorFile]) -> RigCorrection:
    """As a run does it, and what it says of each camera."""
    opened = {}
    for row, image in opened_photos(files, cameras):
        opened[row] = detect_corners(image)
    found = correct_rig(cameras, files, [opened[row] for row in range(len(files))])
    assert found is not None, "too few corners were matched"
    print("\n".join(rig_report_lines(found)), f"{len(found.points)} points", sep="\n", flush=True)
    return found


def _counted(problem: FitProblem, shot: FitPhoto) -> Array:
    """Pixels (H, W) of a photo that show no vehicle which drives by."""
    boxes, valid = problem.tracks.at(shot.photo.time_s)
    return ~pixel_classes(shot.photo, boxes[valid], None)["vehicles"] & (shot.compared.target.weight > 0.0)


def main() -> None:
    """Corrects the rig, trains and prints what comes out camera by camera."""
    root, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    validate, threads = options.pop("validate", "0") == "1", int(options.pop("threads", "2"))
    adjust, ground = options.pop("adjust", "1") == "1", options.pop("ground", "")
    masked = options.pop("movers", "1") == "1"
    kinds = {field.name: type(getattr(FitSettings(), field.name)) for field in fields(FitSettings)}
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})

    cameras, files, instants = read_block(root, HELD_OUT if validate else ())
    known, started = KnownPoints(), time.process_time()
    if adjust:
        found = correct(cameras, files)
        cameras, files, known = list(found.cameras), list(found.files), KnownPoints(corners=found.points)
    if ground:
        poses = np.stack([file.world_from_ego for file in files])
        known = replace(known, road=driven_road(poses, float(ground)))
    photos = load_photos(files, cameras, *SIZE)
    height = float(ground) if ground else None
    if adjust and not ground:
        poses = np.stack([file.world_from_ego for file in files])
        height = estimate_ground_height(photos, poses)
        print(f"the road lies {height} m above the ego's origin")
        known = replace(known, road=None if height is None else driven_road(poses, height))
    print(f"{time.process_time() - started:.0f} CPU s for the rig", flush=True)
    started = time.process_time()
    out = VALIDATED if validate else HELD_OUT
    held_out = [i for i, instant in enumerate(instants) if instant in out]
    agents = movers(files, instants, height) if masked and height is not None else None
    problem, state = prepare_fit(photos, [], agents, settings, held_out, threads, known)
    print(
        f"{time.process_time() - started:.0f} CPU s to prepare {len(state)} Gaussians, {state.road.sum()} of them road"
    )
    told: list[float] = []
    for until in [at for at in (2000, 4000) if at < settings.iterations] + [settings.iterations]:
        started = time.process_time()
        run_iterations(problem, state, settings, until, lambda at, loss, score: told.append(score), threads)
        asset, rows = kept(finish_scene(problem, state, threads)), {}
        coloured: dict[str, list[float]] = {}
        for shot in problem.held_out:
            picture = draw_photo(asset, problem, shot.photo, refined_pose(problem, state, shot.photo), threads)
            counted, photo = _counted(problem, shot), shot.compared.target.rgb
            score = psnr(picture[counted], photo[counted]), ssim(picture, shot.compared.target)[0]
            own = apply_exposure(picture, affine_between(picture[counted], photo[counted]))
            coloured.setdefault(shot.photo.camera, []).append(psnr(own[counted], photo[counted]))
            rows.setdefault(shot.photo.camera, []).append(score)
            rows.setdefault(f"at {shot.photo.time_s:g} s", []).append(score)
        mean = np.mean([score for name in (c.name for c in cameras) for score in rows[name]], axis=0)
        each = ", ".join(f"{name.removeprefix('CAM_')} {np.mean(row, axis=0)[0]:.1f}" for name, row in rows.items())
        cpu = time.process_time() - started
        print(
            f"{until} iterations, {cpu:.0f} CPU s, {len(state)}: training {np.mean(told[-5:]):.2f}, "
            f"held out {mean[0]:.2f} / {mean[1]:.3f}: {each}; by their own colours "
            + ", ".join(f"{name.removeprefix('CAM_')} {np.mean(row):.1f}" for name, row in coloured.items()),
            flush=True,
        )


if __name__ == "__main__":
    main()
