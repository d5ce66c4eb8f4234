"""A vehicle in a picture beside a photo of it that was taken from near: what is torn from here is not like it.

A box is shape enough for a small step aside: each pixel of the vehicle's outline looks at a place of its box's
surface and is held against the photo's pixel that looks at the same place. What lies a metre behind the box, as a
bonnet does, is off by 0.01 rad after a step of 1 m at 10 m: a pixel of a picture of 160. Nothing of the scene's own
shape goes in: by its own depths a torn vehicle would look like every photo that it was fitted to.
"""

import cv2
import numpy as np

from tasks.render.likeness import VehiclePhoto, inside_mean, similarity
from tasks.render.scene.movers import behind_boxes, world_from_boxes
from tasks.render.scene.sky import directions
from tasks.world.arrays import F32, Array, Bools, Bytes, Ints
from tasks.world.camera import Pinhole

SHIFTS_PX = (-2, -1, 0, 1, 2)  # by which the photo is moved either way to fit: a box is no car, nor where it is exactly


def beside_photo(rgb: F32, eye: Pinhole, box: Array, others: Array, taken: VehiclePhoto) -> tuple[float, float]:
    """How like a photo a picture (H, W, 3) of a vehicle is, 0 to 1, and the share of its outline that both show.

    `box` (7,) is the vehicle's and `others` (N, 7) those that may hide it, as `eye` sees them. Likeness is the SSIM at
    half size over the places that both show, the best under small shifts of the photo. 0 and 0 where there is none.
    """
    rays = directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
    place, photo = eye.world_from_camera[:3, 3], taken.photo
    points, axis, side, along = on_box(box, place, rays)
    outline = along < np.inf
    if not outline.any():
        return 0.0, 0.0
    clear = outline.copy()
    if len(others):
        clear[outline] &= ~behind_boxes(
            place + along[outline, None] * rays[outline], np.ascontiguousarray(place), others
        )
    their_eye = photo.world_from_camera[:3, 3]
    inner = (their_eye - taken.box[:3]) @ world_from_boxes(taken.box[None])[0, :3, :3]
    clear &= side * inner[axis] > box[4:7][axis] / 2.0  # the photo looks at that face
    there = points @ world_from_boxes(taken.box[None])[0, :3, :3].T + taken.box[:3]
    local = (there - their_eye) @ photo.world_from_camera[:3, :3]
    height, width = photo.rgb.shape[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = photo.intrinsics[0, 0] * local[:, 0] / local[:, 2] + photo.intrinsics[0, 2]
        v = photo.intrinsics[1, 1] * local[:, 1] / local[:, 2] + photo.intrinsics[1, 2]
        clear &= (local[:, 2] > 0.0) & (u > 0.0) & (u < width) & (v > 0.0) & (v < height)
    if len(taken.others):
        clear[clear] &= ~behind_boxes(there[clear], np.ascontiguousarray(their_eye), taken.others)
    if not clear.any():
        return 0.0, 0.0
    shape = (eye.height, eye.width)
    columns, rows = ((np.where(clear, at, 0.0) - 0.5).astype(np.float32).reshape(shape) for at in (u, v))
    return _best(rgb, photo.rgb, columns, rows, clear.reshape(shape)), float(clear.sum() / outline.sum())


def on_box(box: Array, eye: Array, rays: Array) -> tuple[Array, Ints, Array, Array]:
    """Where rays (N, 3) from `eye` (3,) first meet a box (7,) that the eye is outside of.

    Returns the places (N, 3) in box coordinates, the axis (N,) and the side (N,), 1 or -1, of the face, and how many
    lengths of a ray they are away (N,); inf, and no meaning of the rest, where a ray misses the box.
    """
    turn = world_from_boxes(box[None])[0, :3, :3]
    start, steps, half = (eye - box[:3]) @ turn, rays @ turn, box[4:7] / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - start) / steps, (half - start) / steps
    enter, leave = np.fmin(first, second), np.fmax(first, second)
    axis = enter.argmax(axis=1)
    along = enter.max(axis=1)
    met = (along <= leave.min(axis=1)) & (along > 0.0)
    along = np.where(met, along, np.inf)
    side = -np.sign(np.take_along_axis(steps, axis[:, None], axis=1)[:, 0])
    return start + np.where(met, along, 0.0)[:, None] * steps, axis, side, along


def _best(rgb: F32, photo: Bytes, columns: F32, rows: F32, clear: Bools) -> float:
    """Likeness of the `clear` pixels to the photo's at columns and rows (H, W) under the best of the shifts."""
    theirs = photo.astype(np.float32) / np.float32(255.0)
    best = 0.0
    for down in SHIFTS_PX:
        for right in SHIFTS_PX:
            at = columns + np.float32(right), rows + np.float32(down)
            moved = cv2.remap(theirs, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            mixed = np.where(clear[..., None], moved, rgb).astype(np.float32)
            best = max(best, inside_mean(similarity(rgb, mixed), clear))
    return best
