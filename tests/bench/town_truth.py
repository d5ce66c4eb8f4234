"""What a scene shows from poses where no photo was taken, beside what the painter of the town shows from there."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tasks.render.fit.losses import photo_target, similarity
from tasks.render.fit.reconstruct import pixel_classes
from tasks.render.fit.state import Road
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.engine import render
from tasks.render.scene.movers import PlacedAgents, agents_at_time, behind_boxes
from tasks.render.scene.sensed import Photo, shift_pose
from tasks.render.scene.sky import pixel_directions
from tasks.render.scene.stereo import FAR_M
from tasks.world.arrays import F32, Array
from tasks.world.clip import AgentKind, AgentTracks, Pinhole

Painter = Callable[[float, Photo], NDArray[np.uint8]]  # time, photo (its camera and pose): the truth there
MOVED_M = (3.0, 0.8)  # ahead and to the left, of every vehicle
NEAR_M = 40.0  # vehicles looked at
LEAST_PIXELS = 40  # inside their boxes, that a view counts
IN_THE_WAY_M = 0.6  # no camera is put this near to a box


@dataclass(frozen=True)
class Compared:
    """One view."""

    truth: F32  # (H, W, 3) in [0, 1]
    picture: F32
    inside: NDArray[np.bool_] | None = None  # (H, W) what counts; None: all
    classes: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)  # (H, W) road, vehicles, rest

    @property
    def psnr_db(self) -> float:
        return self.psnr_db_in(self.inside)

    def psnr_db_in(self, inside: NDArray[np.bool_] | None) -> float:
        """Of these pixels (H, W); None: all."""
        return psnr(self.picture, self.truth) if inside is None else psnr(self.picture[inside], self.truth[inside])

    @property
    def ssim(self) -> float:
        target = photo_target(
            np.rint(255.0 * self.truth).astype(np.uint8), None if self.inside is None else ~self.inside
        )
        return float(similarity(self.picture, target)[target.counted].mean())


def beside(photo: Photo, left_m: float = 0.0, left_rad: float = 0.0) -> Photo:
    """The photo's camera moved along the street's left of its own direction and turned about the vertical, level.

    Its pixels stay: they are not what is seen from there.
    """
    pose = photo.world_from_camera.copy()
    pose[:3, 3] -= left_m * pose[:3, 0]
    c, s = np.cos(left_rad), np.sin(left_rad)
    pose[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ pose[:3, :3]
    return replace(photo, world_from_camera=pose)


def sideways(photo: Photo, ego: Photo, left_m: float) -> Photo:
    """The photo's camera where it is when the car, which looks as camera `ego` does, drives further to the left."""
    pose = photo.world_from_camera.copy()
    pose[:3, 3] -= left_m * ego.world_from_camera[:3, 0]
    return replace(photo, world_from_camera=pose)


def moved_on(boxes: Array, kinds: Sequence[AgentKind]) -> Array:
    """Boxes (N, 7) of vehicles put MOVED_M from where they are; the others' as they are."""
    out = boxes.copy()
    rows = np.array([kind == AgentKind.VEHICLE for kind in kinds], bool)
    c, s = np.cos(boxes[rows, 3]), np.sin(boxes[rows, 3])
    out[rows, 0] += MOVED_M[0] * c - MOVED_M[1] * s
    out[rows, 1] += MOVED_M[0] * s + MOVED_M[1] * c
    return out


class Truth:
    """A scene held against the painter."""

    def __init__(
        self,
        asset: RenderAsset,
        agents: AgentTracks,
        painter: Painter,
        painter_moved: Painter,
        road: Road | None = None,
    ) -> None:
        """`painter_moved` paints the street with its vehicles where `moved_on` puts them. `road` as in the asset."""
        self.asset, self.agents, self.road = asset, agents, road
        self.painter, self.painter_moved = painter, painter_moved

    def compared(self, photos: Sequence[Photo]) -> list[Compared]:
        """Of cameras where and when `photos` say (world); those inside somebody are left out."""
        out = []
        for photo in photos:
            there = agents_at_time(self.agents, photo.time_s)
            if not _in_the_way(photo, there.boxes):
                truth = _unit(self.painter(photo.time_s, photo))
                out.append(Compared(truth, self._seen(photo, there), classes=self._classes(photo, there)))
        return out

    def _classes(self, photo: Photo, there: PlacedAgents) -> Mapping[str, NDArray[np.bool_]]:
        local = replace(photo, world_from_camera=shift_pose(photo.world_from_camera, -self.asset.origin))
        rows = [kind == AgentKind.VEHICLE for kind in there.kinds]
        boxes = there.boxes[np.array(rows, bool)] - np.concatenate([self.asset.origin, np.zeros(4)])
        return pixel_classes(local, boxes, self.road)

    def compared_moved(self, photos: Sequence[Photo]) -> list[Compared]:
        """The same with moved vehicles, inside the boxes of those near; views that show little of them are left out."""
        out = []
        for photo in photos:
            there = agents_at_time(self.agents, photo.time_s)
            boxes = moved_on(there.boxes, there.kinds)
            eye = photo.world_from_camera[:3, 3]
            vehicle = np.array([kind == AgentKind.VEHICLE for kind in there.kinds], bool)
            near = vehicle & (np.linalg.norm(boxes[:, :3] - eye, axis=1) < NEAR_M)
            if _in_the_way(photo, boxes) or not near.any():
                continue
            height, width = photo.rgb.shape[:2]
            rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height).reshape(-1, 3)
            inside = behind_boxes(rays * FAR_M + eye, eye, boxes[near]).reshape(height, width)
            if inside.sum() >= LEAST_PIXELS:
                truth = _unit(self.painter_moved(photo.time_s, photo))
                out.append(Compared(truth, self._seen(photo, replace(there, boxes=boxes)), inside))
        return out

    def _seen(self, photo: Photo, there: PlacedAgents) -> F32:
        height, width = photo.rgb.shape[:2]
        eye = Pinhole(photo.intrinsics, photo.world_from_camera, width, height)
        affine = self.asset.affine_of(photo.camera, photo.time_s)
        return render(self.asset, [eye], there, affines=[affine])[0].rgb


def _in_the_way(photo: Photo, boxes: Array) -> bool:
    off = photo.world_from_camera[:3, 3] - boxes[:, :3]
    along = np.cos(boxes[:, 3]) * off[:, 0] + np.sin(boxes[:, 3]) * off[:, 1]
    across = np.cos(boxes[:, 3]) * off[:, 1] - np.sin(boxes[:, 3]) * off[:, 0]
    out = np.maximum(np.abs(along) - boxes[:, 4] / 2, np.abs(across) - boxes[:, 5] / 2)
    return bool((out < IN_THE_WAY_M).any())


def _unit(rgb: NDArray[np.uint8]) -> F32:
    return rgb.astype(np.float32) / np.float32(255.0)
