"""Which Gaussians a photo of the fit may show, and where their owners were at its time."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tasks.render.fit.start import Problem
from tasks.render.scene.movers import SHIFT_SIZE, at_knots, shifted_boxes, world_from_boxes
from tasks.render.scene.sensed import Photo
from tasks.world.arrays import F32, Array, Bools, Ints, ShortInts

VIEW_MARGIN_M = 0.5  # how far Gaussians of a track may reach beyond its box


@dataclass(frozen=True)
class OwnedGaussians:
    """Consecutive Gaussians of a composed scene that share an owner."""

    first: int
    rows: Ints  # (M,) in the state
    scene_from_owner: Array | None  # (4, 4); None: the background's, which is the scene's
    track: int | None = None  # its row; None: the background's
    shift: F32 | None = None  # (SHIFT_SIZE,) by which its box is off then


def parts_of(problem: Problem, owner: ShortInts, off: F32, photo: Photo) -> list[OwnedGaussians]:
    """The parts of the scene that a photo (pose local) may show, the background first; `owner` (N,) and `off`, what
    boxes are off by, (tracks * knots, SHIFT_SIZE), as of the state."""
    n = int(np.searchsorted(owner, 0))
    parts = [OwnedGaussians(0, np.arange(n), None)]
    boxes, valid = problem.tracks.at(photo.taken_s)
    shifts = at_knots(off.reshape(len(boxes), problem.tracks.n_knots, SHIFT_SIZE), photo.taken_s)
    boxes = shifted_boxes(boxes, shifts)
    frames = world_from_boxes(boxes)
    for j in np.flatnonzero(valid & _in_view(boxes, photo)):
        first, last = np.searchsorted(owner, [j, j + 1])
        if first < last:
            parts.append(OwnedGaussians(n, np.arange(first, last), frames[j], int(j), shifts[j]))
            n += int(last - first)
    return parts


def by_box(part: OwnedGaussians, means: Any, quats: Any, d_means: Any, d_quats: Any) -> tuple[Any, Any]:
    """Derivatives by what a part's box is off by: (3,) by the shift, and by the turn.

    Of those of the part's Gaussians that are in view: `means` (M, 3) and `quats` (M, 4) in their owner's frame, and the
    derivatives by them; arrays, or tensors. What the turn does to light that depends on the side is left out.
    """
    assert part.shift is not None
    x, y = means[:, 0] + float(part.shift[0]), means[:, 1] + float(part.shift[1])
    turn = (d_means[:, 1] * x - d_means[:, 0] * y).sum()
    w, i, j, k = (quats[:, n] for n in range(4))  # turned by a little: half of (0, 0, 0, 1) times it more
    turn = turn + 0.5 * (d_quats[:, 3] * w + d_quats[:, 2] * i - d_quats[:, 1] * j - d_quats[:, 0] * k).sum()
    return d_means.sum(0), turn


def _in_view(boxes: Array, photo: Photo) -> Bools:
    """Whether a ball around each box (N, 7) reaches into the photo's pyramid: (N,)."""
    radius = 0.5 * np.linalg.norm(boxes[:, 4:], axis=1) + VIEW_MARGIN_M
    height, width = photo.rgb.shape[:2]
    camera_from_scene = np.linalg.inv(photo.world_from_camera)
    at = boxes[:, :3] @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]
    seen = at[:, 2] > -radius
    for axis, size in enumerate((width, height)):
        focal, middle = photo.intrinsics[axis, axis], photo.intrinsics[axis, 2]
        slope = max(middle, size - middle) / focal
        seen &= np.abs(at[:, axis]) < slope * at[:, 2] + radius * np.hypot(1.0, slope)
    return np.asarray(seen)
