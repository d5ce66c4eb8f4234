"""What the sensors recorded of a block: photos, sweeps, tracks; and the sweeps as one cloud, what moves apart."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tasks.render.scene.asset import OwnBody, apply_affine
from tasks.render.scene.movers import GROUND_CLEARANCE_M, KNOT_S, box_of_points, boxes_at, ever_moves, world_from_boxes
from tasks.world.arrays import F32, Array, Bools, Bytes, Indices
from tasks.world.clip import MOVING_KINDS, STEP_S, AgentTracks
from tasks.world.frames import PACIFICA

EGO_MARGIN_M = 0.3
FUSED_VOXEL_M = 0.07
MEDIAN_PHOTOS = 25  # of a camera, at most, that say what the own body looks like


@dataclass(frozen=True)
class Photo:
    """An image without distortion and where it was taken."""

    camera: str
    time_s: float  # since the clip's first step
    rgb: Bytes  # (H, W, 3)
    intrinsics: Array  # (3, 3) pixels, the centre of pixel (0, 0) at (0.5, 0.5)
    world_from_camera: Array  # (4, 4)
    own_body: Bools | None = None  # (H, W) shows the car that carries the camera
    to_common: F32 | None = None  # (3, 4) affine colour that takes it into an exposure common to several cameras

    @property
    def light(self) -> F32:
        """(H, W, 3) its colours in the common exposure, else as they are: from 0 on, and above 1 where a dark photo
        shows what is brighter than white is there."""
        rgb = self.rgb.astype(np.float32) / np.float32(255.0)
        return rgb if self.to_common is None else np.maximum(apply_affine(rgb, self.to_common), np.float32(0.0))


def resize_photo(photo: Photo, width: int) -> Photo:
    """The photo, `width` pixels across at most."""
    rows, columns = photo.rgb.shape[:2]
    if columns <= width:
        return photo
    size = (width, round(rows * width / columns))
    scale = np.diag([size[0] / columns, size[1] / rows, 1.0])
    rgb = np.asarray(cv2.resize(photo.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    body = photo.own_body
    if body is not None:
        body = np.asarray(cv2.resize(body.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), bool)
    return replace(photo, rgb=rgb, intrinsics=scale @ photo.intrinsics, own_body=body)


def median_own_bodies(photos: Sequence[Photo]) -> tuple[OwnBody, ...]:
    """What each camera sees of the car that carries it: the colours that its pixels mostly have."""
    masks = {photo.camera: photo.own_body for photo in photos if photo.own_body is not None}
    found = []
    for camera, mask in masks.items():
        mine = [photo.rgb for photo in photos if photo.camera == camera]
        rgb = np.median(np.stack(mine[:: -(-len(mine) // MEDIAN_PHOTOS)]), axis=0)
        found.append(OwnBody(camera, np.rint(np.dstack([rgb, 255.0 * mask])).astype(np.uint8)))
    return tuple(found)


@dataclass(frozen=True)
class Sweep:
    """One turn of the lidar."""

    time_s: float
    points: F32  # (M, 3) ego frame [m]
    world_from_ego: Array  # (4, 4)


def shift_pose(pose: Array, by: Array) -> Array:
    """A pose (4, 4) moved by (3,)."""
    out = pose.copy()
    out[:3, 3] += by
    return out


class Tracks:
    """The movable tracks of a block, in its local frame."""

    def __init__(self, agents: AgentTracks | None, origin: Array) -> None:
        self._agents, self._origin = agents, origin
        self.ids = agents.track_ids if agents is not None else ()
        self.kinds = agents.kinds if agents is not None else ()
        self.driving = ever_moves(agents) if agents is not None else np.zeros(0, bool)
        self._movable = np.array([kind in MOVING_KINDS for kind in self.kinds], bool)
        self._known: dict[float, tuple[Array, Bools]] = {}  # by time: each photo's is asked for again and again

    @property
    def n_knots(self) -> int:
        """Instants that each box may be off at by numbers of their own, see BoxShifts."""
        length_s = 0.0 if self._agents is None else (self._agents.n_steps - 1) * STEP_S
        return int(np.ceil(length_s / KNOT_S - 1e-6)) + 1

    def at(self, time_s: float) -> tuple[Array, Bools]:
        """Boxes (N, 7) local, and which of them are there and movable (N,)."""
        if self._agents is None:
            return np.zeros((0, 7)), np.zeros(0, bool)
        if time_s not in self._known:
            boxes, valid = boxes_at(self._agents, time_s)
            boxes[:, :3] -= self._origin
            self._known[time_s] = boxes, valid & self._movable
        boxes, there = self._known[time_s]
        return boxes.copy(), there.copy()


VIEW_MARGIN_M = 0.5  # how far Gaussians of a track may reach beyond its box


def boxes_in_view(boxes: Array, photo: Photo) -> Bools:
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


def fuse_sweeps(sweeps: Sequence[Sweep], tracks: Tracks) -> tuple[Array, dict[int, Array]]:
    """Lidar points that stay (M, 3) local, and those of each track in its box's frame; both thinned by voxels."""
    static, moving = [np.zeros((0, 3))], dict[int, list[Array]]()
    for sweep in sweeps:
        outside = sweep.points[~is_on_ego(sweep.points)]
        points = outside.astype(np.float64) @ sweep.world_from_ego[:3, :3].T + sweep.world_from_ego[:3, 3]
        boxes, valid = tracks.at(sweep.time_s)
        owner = box_of_points(points, boxes, valid)
        static.append(_voxels(points[owner < 0]))
        poses = world_from_boxes(boxes)
        for j in np.unique(owner[owner >= 0]):
            mine = points[owner == j]
            moving.setdefault(int(j), []).append((mine - poses[j, :3, 3]) @ poses[j, :3, :3])
    return _voxels(np.concatenate(static)), {j: _voxels(np.concatenate(parts)) for j, parts in sorted(moving.items())}


def is_on_ego(points: F32) -> Bools:
    """Returns from the ego's own body (M,): left in, they would hang over the road as a trail."""
    x, y = points[:, 0], points[:, 1]
    along = (x > -PACIFICA.rear_length - EGO_MARGIN_M) & (x < PACIFICA.front_length + EGO_MARGIN_M)
    return np.asarray(along & (np.abs(y) < PACIFICA.half_width + EGO_MARGIN_M) & (points[:, 2] > GROUND_CLEARANCE_M))


def voxel_rows(points: Array) -> Indices:
    """Rows of the first point (M, 3) of every voxel, ascending."""
    cells = np.floor((points - points.min(axis=0, initial=np.inf)) / FUSED_VOXEL_M).astype(np.int64)
    _, first = np.unique((cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2], return_index=True)
    return np.sort(first)


def _voxels(points: Array) -> Array:
    return points[voxel_rows(points)]
