"""A real street reconstructed: `python -m tests.bench.bench_kitti <kitti_raw> [out=DIR] [validate=1] [setting=value]`.

Drive 2011_09_26_0001. Held out: frames with index mod 8 = 4; trained on image_02 of the others. With `validate=1` those
frames are not read at all and index mod 8 = 0 is held out instead: what knobs are to be tuned on. image_03, half a
metre to the side, is never trained on; one affine colour and one rigid correction for the whole drive are fitted to its
photos of training frames. Settings are those of `FitSettings`, for instance iterations=2000; `first=28 last=60` takes
these frames of the drive only, and a few minutes. `by=gsplat` fits on a GPU, `by=tensors` by the same loop over tensors
through the CPU's kernels.
"""

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factory.stages.scene_file import write_scene
from tasks.render.fit.corrections import apply_exposure, corrected_pose
from tasks.render.fit.losses import photo_target, similarity
from tasks.render.fit.on_torch import TorchBackend
from tasks.render.fit.reconstruct import (
    draw_photo,
    finish_scene,
    fit_backend,
    interpolated_corrections,
    refined_pose,
    run_iterations,
)
from tasks.render.fit.start import FitProblem, prepare_fit
from tasks.render.fit.state import FitState
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.engine import render
from tasks.render.scene.sensed import Photo, shift_pose
from tasks.render.settings import Backend, FitSettings
from tasks.world.clip import Pinhole
from tests.bench.by_kernels import by_kernels
from tests.bench.kitti import read_drive, steadied
from tests.bench.stored_scene import Look, affine_between, kept, storage_table

F32, F64 = NDArray[np.float32], NDArray[np.float64]
FITTED_FRAMES = 12  # of image_03's training frames, for its affine colour and rigid correction
STEPS = np.array([0.02, 0.02, 0.02, 5e-4, 5e-4, 5e-4])  # [m], [rad] of the finite differences
SHIFTS_M = (-1.0, 0.0, 1.0)
SHOWN = (10, 34, 58, 82)  # frames trained on
SHOWN_AT = (1000, 2000, 4000)  # iterations
SETTINGS = replace(FitSettings(), start_gaussians=240_000, most_gaussians=280_000)


class Beside:
    """What a scene shows of image_03: posed by what was learned of image_02, plus a rigid correction."""

    def __init__(
        self, asset: RenderAsset, problem: FitProblem, state: FitState, left: dict[float, F64], threads: int
    ) -> None:
        self.asset, self.problem, self.state, self.left, self.threads = asset, problem, state, left, threads

    def picture(self, photo: Photo, row: F64) -> F32:
        """`photo` local; `row` (6,) the correction."""
        learned, _ = interpolated_corrections(self.problem, self.state, "image_02", photo.time_s)
        left = self.left[photo.time_s]
        moved = corrected_pose(left, learned) @ np.linalg.inv(left) @ photo.world_from_camera
        as_left = replace(photo, camera="image_02")
        return draw_photo(self.asset, self.problem, as_left, corrected_pose(moved, row), self.threads)

    def fitted(self, photos: list[Photo], rigid: bool) -> tuple[F64, F32]:
        """Correction and affine colour (12,) that fit `photos` best: Gauss-Newton on what the affine leaves over."""
        row = np.zeros(6)
        truth = np.concatenate([p.rgb.reshape(-1, 3) / 255.0 for p in photos])
        for _ in range(2 if rigid else 0):
            base = self._flat(photos, row)
            colour = affine_between(base, truth)
            slopes = np.stack([self._flat(photos, row + s) - self._flat(photos, row - s) for s in np.diag(STEPS)], -1)
            slopes = slopes.reshape(-1, 6) / (2.0 * STEPS)
            off = (truth - apply_exposure(base, colour)).ravel()
            calm = np.abs(off) < 0.1  # what moved, or is not there, says nothing of the camera
            row = row + np.linalg.lstsq(slopes[calm], off[calm], rcond=None)[0]
        return row, affine_between(self._flat(photos, row), truth)

    def _flat(self, photos: list[Photo], row: F64) -> F32:
        return np.concatenate([self.picture(p, row).reshape(-1, 3) for p in photos])


@dataclass(frozen=True)
class Trial:
    """A fit under way, and the photos that it is measured by; poses local."""

    problem: FitProblem
    state: FitState
    left: dict[float, F64]  # poses of image_02 by time
    test: list[Photo]  # image_03 of the frames held out
    chosen: list[Photo]  # image_03 of some frames trained on
    threads: int

    def row(self) -> str:
        """Held-out image_02; image_03 as it comes, with an affine colour, and with a rigid correction as well; by the
        scene as it is now."""
        asset = kept(finish_scene(self.problem, self.state, self.threads))
        beside = Beside(asset, self.problem, self.state, self.left, self.threads)
        photos = [shot.photo for shot in self.problem.held_out]
        own = [
            draw_photo(asset, self.problem, p, refined_pose(self.problem, self.state, p), self.threads) for p in photos
        ]
        raw = [beside.picture(p, np.zeros(6)) for p in self.test]
        _, plain = beside.fitted(self.chosen, rigid=False)
        rigid, colour = beside.fitted(self.chosen, rigid=True)
        affine = [apply_exposure(p, plain) for p in raw]
        turned = [apply_exposure(beside.picture(p, rigid), colour) for p in self.test]
        print("    extrinsic [cm]", np.round(100 * rigid[:3], 2), "[deg]", np.round(np.degrees(rigid[3:]), 3))
        columns = " | ".join(scores(pictures, self.test) for pictures in (raw, affine, turned))
        return f"{scores(own, photos)} | {columns}"


def scores(pictures: list[F32], photos: list[Photo]) -> str:
    """Mean PSNR and SSIM."""
    targets = [photo_target(p.rgb) for p in photos]
    clipped = [np.clip(image, 0.0, 1.0) for image in pictures]
    both = [(psnr(image, t.rgb), float(similarity(image, t).mean())) for image, t in zip(clipped, targets)]
    return "{:.2f} / {:.3f}".format(*np.mean(both, axis=0))


def local(photos: list[Photo], origin: F64) -> list[Photo]:
    """With poses minus `origin` (3,)."""
    return [replace(p, world_from_camera=shift_pose(p.world_from_camera, -origin)) for p in photos]


def main() -> None:
    """Trains, prints a table, writes pictures, the state and the scene."""
    root, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    out = Path(options.pop("out", "out/bench_kitti"))
    by = options.pop("by", "cpu")
    validate, threads = options.pop("validate", "0") == "1", int(options.pop("threads", "2"))
    kinds = {field.name: type(getattr(FitSettings(), field.name)) for field in fields(FitSettings)}
    out.mkdir(parents=True, exist_ok=True)

    drawing = nullcontext(TorchBackend(by_kernels, "cpu")) if by == "tensors" else fit_backend(Backend(by), threads)

    drive = steadied(read_drive(root))
    span = int(options.pop("first", "0")), int(options.pop("last", len(drive.times_s) - 1)) + 1
    settings = replace(SETTINGS, **{k: kinds[k](float(v)) for k, v in options.items()})
    frames = [f for f in range(*span) if not (validate and f % 8 == 4)]
    held_out = [i for i, f in enumerate(frames) if f % 8 == (0 if validate else 4)]
    photos, started = drive.photos("image_02", frames), time.perf_counter()
    problem, state = prepare_fit(photos, drive.fused(), None, settings, held_out, threads)
    left, right = (local(p, problem.origin) for p in (photos, drive.photos("image_03", frames)))
    trained = [p for i, p in enumerate(right) if i not in held_out]
    chosen = [trained[i] for i in np.linspace(0, len(trained) - 1, FITTED_FRAMES).astype(int)]
    poses = {p.time_s: p.world_from_camera for p in left}
    trial = Trial(problem, state, poses, [right[i] for i in held_out], chosen, threads)

    print(f"{time.perf_counter() - started:.0f} s to prepare {len(state)} Gaussians, {state.road.sum()} of them road")
    print("| iterations | s | Gaussians | training | image_02 | image_03 raw | affine | affine + extrinsic |")
    seconds = 0.0
    told: list[float] = []
    with drawing as backend:
        for until in [at for at in SHOWN_AT if at < settings.iterations] + [settings.iterations]:
            started = time.perf_counter()
            run_iterations(
                problem, state, settings, until, lambda at, loss, score: told.append(score), threads, backend=backend
            )
            seconds += time.perf_counter() - started
            np.savez(out / "state.npz", **state.arrays())
            mean = np.mean(told[-5:]) if told else np.nan  # of the last 500 iterations
            print(f"| {until} | {seconds:.0f} | {len(state)} | {mean:.2f} | {trial.row()} |", flush=True)

    asset = write_scene(out / "kitti.safetensors", finish_scene(problem, state, threads))
    looks = []
    for photo in (shot.photo for shot in problem.held_out):
        pose = refined_pose(problem, state, photo)
        eye = Pinhole(photo.intrinsics, shift_pose(pose, problem.origin), *photo.rgb.shape[1::-1])
        looks.append(Look(photo.camera, photo.time_s, eye, photo.rgb))
    print(storage_table(asset, looks, threads))
    for frame in [f for f in SHOWN if f in frames]:
        photo = left[frames.index(frame)]
        pose = refined_pose(problem, state, photo)
        height, width = photo.rgb.shape[:2]
        strip = []
        for shift in SHIFTS_M:
            there = pose.copy()
            there[:3, 3] += problem.origin + shift * pose[:3, 0]
            eye = Pinhole(photo.intrinsics, there, width, height)
            affines = [asset.affine_of(photo.camera, photo.time_s)]
            strip.append(render(asset, [eye], threads=threads, affines=affines)[0].rgb)
        picture = np.rint(255 * np.vstack(strip)).astype(np.uint8)[..., ::-1]
        cv2.imwrite(str(out / f"shifted_{frame:03d}.png"), picture)


if __name__ == "__main__":
    main()
