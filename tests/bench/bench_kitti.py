"""A real street reconstructed: `python -m tests.bench.bench_kitti <kitti_raw> [out=DIR] [validate=1] [setting=value]`.

Drive 2011_09_26_0001. Held out: frames with index mod 8 = 4; trained on image_02 of the others. With `validate=1` those
frames are not read at all and index mod 8 = 0 is held out instead: what knobs are to be tuned on. image_03, half a
metre to the side, is never trained on; one affine colour and one rigid correction for the whole drive are fitted to its
photos of training frames. Settings are those of `FitSettings`, for instance iterations=2000.
"""

import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factory.clips.kitti import read_drive, steadied
from tasks.render.asset import psnr
from tasks.render.engine import Pinhole, render
from tasks.render.fit.exposure import affine_between, exposed
from tasks.render.fit.losses import ssim, target_of
from tasks.render.fit.poses import corrected
from tasks.render.fit.reconstruct import advance, corrections_at, finish, picture_of
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem, prepare
from tasks.render.fit.state import FitState
from tasks.render.sensed import Photo, shifted

F32, F64 = NDArray[np.float32], NDArray[np.float64]
FITTED_FRAMES = 12  # of image_03's training frames, for its affine colour and rigid correction
STEPS = np.array([0.02, 0.02, 0.02, 5e-4, 5e-4, 5e-4])  # [m], [rad] of the finite differences
SHIFTS_M = (-1.0, 0.0, 1.0)
SHOWN = (12, 36, 60, 84)


class Beside:
    """What the fit shows of image_03: posed by what was learned of image_02, plus a rigid correction."""

    def __init__(self, problem: Problem, state: FitState, left: dict[float, F64], threads: int) -> None:
        self.problem, self.state, self.left, self.threads = problem, state, left, threads

    def picture(self, photo: Photo, row: F64) -> F32:
        """`photo` local; `row` (6,) the correction."""
        learned, colours = corrections_at(self.problem, self.state, "image_02", photo.time_s)
        left = self.left[photo.time_s]
        moved = corrected(left, learned) @ np.linalg.inv(left) @ photo.world_from_camera
        there = replace(photo, world_from_camera=corrected(moved, row))
        return np.clip(exposed(picture_of(self.problem, self.state, there, self.threads), colours), 0.0, 1.0)

    def fitted(self, photos: list[Photo], rigid: bool) -> tuple[F64, F32]:
        """Correction and affine colour (12,) that fit `photos` best: Gauss-Newton on what the affine leaves over."""
        row = np.zeros(6)
        truth = np.concatenate([p.rgb.reshape(-1, 3) / 255.0 for p in photos])
        for _ in range(3 if rigid else 0):
            base = self._flat(photos, row)
            colour = affine_between(base, truth)
            slopes = np.stack([self._flat(photos, row + s) - self._flat(photos, row - s) for s in np.diag(STEPS)], -1)
            slopes = slopes.reshape(-1, 6) / (2.0 * STEPS)
            off = (truth - exposed(base, colour)).ravel()
            calm = np.abs(off) < 0.1  # what moved, or is not there, says nothing of the camera
            row = row + np.linalg.lstsq(slopes[calm], off[calm], rcond=None)[0]
        return row, affine_between(self._flat(photos, row), truth)

    def _flat(self, photos: list[Photo], row: F64) -> F32:
        return np.concatenate([self.picture(p, row).reshape(-1, 3) for p in photos])


def scores(pictures: list[F32], photos: list[Photo]) -> str:
    """Mean PSNR and SSIM."""
    targets = [target_of(p.rgb) for p in photos]
    both = [(psnr(image, t.rgb), ssim(image, t)[0]) for image, t in zip(pictures, targets)]
    return "{:.2f} / {:.3f}".format(*np.mean(both, axis=0))


def main() -> None:
    """Trains, prints a table, writes pictures, the state and the Gaussians."""
    root, options = Path(sys.argv[1]), dict(option.split("=", 1) for option in sys.argv[2:])
    out = Path(options.pop("out", "out/bench_kitti"))
    validate = options.pop("validate", "0") == "1"
    threads = int(options.pop("threads", "2"))
    kinds = {field.name: type(getattr(FitSettings(), field.name)) for field in fields(FitSettings)}
    settings = replace(FitSettings(), **{k: kinds[k](float(v)) for k, v in options.items()})
    out.mkdir(parents=True, exist_ok=True)

    drive = steadied(read_drive(root))
    frames = [f for f in range(len(drive.times_s)) if not (validate and f % 8 == 4)]
    held_out = [i for i, f in enumerate(frames) if f % 8 == (0 if validate else 4)]
    started = time.perf_counter()
    problem, state = prepare(drive.photos("image_02", frames), drive.fused(), None, settings, held_out, threads)
    prepared = time.perf_counter()

    def told(iteration: int, loss: float, score: float) -> None:
        if iteration % 500 == 0:
            now = [picture_of(problem, state, s.photo, threads) for s in problem.held_out]
            seconds = time.perf_counter() - prepared
            held = scores(now, [s.photo for s in problem.held_out])
            print(
                f"{iteration}: loss {loss:.4f}, training photos {score:.2f} dB, held out {held}, {seconds:.0f} s",
                flush=True,
            )

    advance(problem, state, settings, settings.iterations, told, threads)
    fitted = time.perf_counter()
    np.savez(out / "state.npz", **state.arrays())
    asset = finish(problem, state, threads)

    local = [
        replace(p, world_from_camera=shifted(p.world_from_camera, -problem.origin))
        for p in drive.photos("image_02", frames)
    ]
    right = [
        replace(p, world_from_camera=shifted(p.world_from_camera, -problem.origin))
        for p in drive.photos("image_03", frames)
    ]
    beside = Beside(problem, state, {p.time_s: p.world_from_camera for p in local}, threads)
    test = [right[i] for i in held_out]
    train = [p for i, p in enumerate(right) if i not in held_out]
    chosen = [train[i] for i in np.linspace(0, len(train) - 1, FITTED_FRAMES).astype(int)]
    raw = [beside.picture(p, np.zeros(6)) for p in test]
    _, plain = beside.fitted(chosen, rigid=False)
    row, colour = beside.fitted(chosen, rigid=True)
    turned = [exposed(beside.picture(p, row), colour) for p in test]

    print(f"| {settings.iterations} iterations | held-out PSNR [dB] / SSIM |\n|---|---|")
    own = [picture_of(problem, state, s.photo, threads) for s in problem.held_out]
    print(f"| image_02 | {scores(own, [s.photo for s in problem.held_out])} |")
    print(f"| image_03 raw | {scores(raw, test)} |")
    print(f"| image_03 affine | {scores([np.clip(exposed(p, plain), 0, 1) for p in raw], test)} |")
    print(f"| image_03 affine + extrinsic | {scores([np.clip(p, 0, 1) for p in turned], test)} |")
    print(f"{len(state)} Gaussians, {state.road.sum()} of them road")
    print(f"preparing {prepared - started:.0f} s, fitting {fitted - prepared:.0f} s")
    print("extrinsic [cm]", np.round(100 * row[:3], 2), "[deg]", np.round(np.degrees(row[3:]), 3))

    np.savez(out / "gaussians.npz", **{f.name: getattr(asset.background, f.name) for f in fields(asset.background)})
    for frame in SHOWN:
        photo = local[frames.index(frame)]
        pose = corrected(photo.world_from_camera, corrections_at(problem, state, photo.camera, photo.time_s)[0])
        strip = [photo.rgb]
        for shift in SHIFTS_M:
            there = pose @ np.block(
                [[np.eye(3), np.array([[shift], [0.0], [0.0]])], [np.zeros((1, 3)), np.ones((1, 1))]]
            )
            height, width = photo.rgb.shape[:2]
            eye = Pinhole(photo.intrinsics, shifted(there, problem.origin), width, height)
            strip.append(np.rint(255 * render(asset, [eye])[0].rgb).astype(np.uint8))
        cv2.imwrite(str(out / f"shifted_{frame:03d}.png"), np.vstack(strip)[..., ::-1])


if __name__ == "__main__":
    main()
