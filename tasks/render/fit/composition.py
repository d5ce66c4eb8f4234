"""Which Gaussians a photo of the fit may show, and where their owners were at its time."""

from dataclasses import dataclass

import numpy as np

from tasks.render.fit.start import Problem
from tasks.render.scene.movers import world_from_boxes
from tasks.render.scene.sensed import Photo
from tasks.world.arrays import Array, Bools, Ints, ShortInts

VIEW_MARGIN_M = 0.5  # how far Gaussians of a track may reach beyond its box


@dataclass(frozen=True)
class OwnedGaussians:
    """Consecutive Gaussians of a composed scene that share an owner."""

    first: int
    rows: Ints  # (M,) in the state
    scene_from_owner: Array | None  # (4, 4); None: the background's, which is the scene's


def parts_of(problem: Problem, owner: ShortInts, photo: Photo) -> list[OwnedGaussians]:
    """The parts of the scene that a photo (pose local) may show, the background first; `owner` (N,) as of the state."""
    n = int(np.searchsorted(owner, 0))
    parts = [OwnedGaussians(0, np.arange(n), None)]
    boxes, valid = problem.tracks.at(photo.taken_s)
    frames = world_from_boxes(boxes)
    for j in np.flatnonzero(valid & _in_view(boxes, photo)):
        first, last = np.searchsorted(owner, [j, j + 1])
        if first < last:
            parts.append(OwnedGaussians(n, np.arange(first, last), frames[j]))
            n += int(last - first)
    return parts


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
