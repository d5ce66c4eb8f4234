"""The scene of a block: what a reconstruction gives and every rendering starts from."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tasks.render.scene.movers import NO_SHIFTS, BoxShifts, PlacedAgents, lift_tracks, world_from_boxes
from tasks.render.scene.sky import SkyMap
from tasks.render.scene.surfels import box_gaussians
from tasks.render.splatting.gaussians import Gaussians, concatenate, moved
from tasks.render.splatting.project import FITTED, ScreenFilter
from tasks.world.arrays import F32, Array, Bools, Bytes
from tasks.world.clip import AgentKind, AgentTracks, Camera, Pinhole, SensorFile


@dataclass(frozen=True)
class BlockRange:
    """The stretch of driving that a scene stands for."""

    dataset: str
    log_id: str
    start_s: float  # since the log's first instant
    end_s: float
    low: Array  # (2,) smallest x, y [m] the sensors were at, world
    high: Array  # (2,) greatest


@dataclass(frozen=True)
class ClassQuality:
    """How well the pixels of one class come out in a photo."""

    name: str  # road, vehicles or rest
    share: float  # of the photo's pixels
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class ViewQuality:
    """How well one photo comes out; NaN where something was not measured."""

    camera: str
    time_s: float  # since the block's first step
    psnr_db: float
    ssim: float
    held_out: bool  # the scene was built without this photo
    away_m: float = float("nan")  # from the nearest photo that the scene was built from and that looks the same way
    classes: tuple[ClassQuality, ...] = ()  # those that the photo shows


@dataclass(frozen=True)
class Exposure:
    """What one camera made of the scene's light at one time: photo = affine[:, :3] @ rgb + affine[:, 3]."""

    camera: str
    time_s: float  # since the block's first step
    affine: F32  # (3, 4)


@dataclass(frozen=True)
class OwnBody:
    """What one camera sees of the car that carries it, wherever that is."""

    camera: str
    rgba: Bytes  # (H, W, 4) its colours in photos, and 255 where it is

    def in_front(self, width: int, height: int) -> Bools:
        """(height, width) pixels of a picture that show mostly the body."""
        return np.asarray(cv2.resize(self.rgba[..., 3], (width, height), interpolation=cv2.INTER_AREA) >= 128)

    def draw_on(self, picture: Bytes) -> None:
        """A picture (h, w, 3) of the same camera gets the body in front, in place."""
        over = cv2.resize(self.rgba, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_AREA)
        shown = np.flatnonzero(over[..., 3].any(axis=1))  # most rows show nothing of it
        if len(shown):
            rows = slice(shown[0], shown[-1] + 1)
            share = over[rows, :, 3:] / np.float32(255.0)
            picture[rows] = np.rint(over[rows, :, :3] * share + picture[rows] * (1 - share)).astype(np.uint8)


@dataclass(frozen=True)
class Reach:
    """What is nearer than so many metres to a place, seen from above."""

    place: Array  # (3,) [m]; in the world, as the cameras of an Instant are
    metres: float


@dataclass(frozen=True)
class Instant:
    """What is to be drawn of a scene at one time."""

    cameras: Sequence[Pinhole]
    vehicles: PlacedAgents
    affines: Sequence[F32]  # (3, 4) a camera: what it makes of the scene's light
    reach: Reach | None = None  # of the background that is drawn; None: all of it


@dataclass(frozen=True)
class PhotoPose:
    """Where the ego was when a photo of the scene was taken, as the photos say."""

    camera: str
    time_s: float  # since the block's first step
    world_from_ego: Array  # (4, 4)
    rise_m: float = 0.0  # higher than the log has it


@dataclass(frozen=True)
class RenderAsset:
    """A block's scene. World coordinates minus `origin` everywhere, so that float32 is exact to less than a mm."""

    origin: Array  # (3,) world [m]
    background: Gaussians
    nodes: Mapping[str, Gaussians]  # track id -> Gaussians in box coordinates (centre; x along the heading)
    sky: SkyMap
    psnr_db: float  # of the photos held out against their rendering; NaN when none was
    n_held_out: int = 0
    digest: str = ""  # of everything else; filled by whoever stores the scene
    views: tuple[ViewQuality, ...] = ()  # photo by photo, where that was measured
    exposures: tuple[Exposure, ...] = ()  # of the photos, where they were aligned
    block: BlockRange | None = None  # filled by whoever knows the log
    rig: tuple[Camera, ...] = ()  # cameras that its photos were corrected to; empty: they are as given
    taken: tuple[PhotoPose, ...] = ()  # its photos, where their poses were corrected
    bodies: tuple[OwnBody, ...] = ()  # of the cameras that were said to see one
    shifts: BoxShifts = NO_SHIFTS  # of its tracks, where photos were asked
    screen: ScreenFilter = FITTED  # what its Gaussians were made to be drawn through

    def as_corrected(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """The cameras to draw it with: of the scene's own rig those of the same names, where it has one."""
        mine = {camera.name: camera for camera in self.rig}
        return tuple(mine.get(camera.name, camera) for camera in cameras)

    def own_body(self, camera: str) -> OwnBody | None:
        """What a camera sees of the car that carries it."""
        return next((body for body in self.bodies if body.camera == camera), None)

    def photos_of(self, files: Sequence[SensorFile]) -> tuple[SensorFile, ...]:
        """The files that it was made of, at the poses it was made with; all as given, where none was corrected."""
        if not self.taken:
            return tuple(files)
        taken = {(photo.camera, photo.time_s): photo for photo in self.taken}
        pairs = [(file, taken.get((file.sensor, file.time_s))) for file in files]
        return tuple(replace(f, world_from_ego=t.world_from_ego) for f, t in pairs if t is not None)

    def on_road(self, logged: Array) -> Array:
        """Poses (S, 4, 4) of the ego that say how high the scene's road is and how it leans: the `logged` ones, or
        those of its photos where these were corrected."""
        return np.stack([photo.world_from_ego for photo in self.taken]) if self.taken else logged

    def lifted(self, agents: AgentTracks, first_s: float) -> AgentTracks:
        """Tracks whose first step is at `first_s` of the block, as high above the scene's road as they were logged."""
        times, rises = photo_rises(self.taken)
        return lift_tracks(agents, times - first_s, rises)

    def settled(self, agents: AgentTracks, first_s: float) -> AgentTracks:
        """The log's own tracks, whose first step is at `first_s` of the block, where its photos show them."""
        return self.shifts.settled(self.lifted(agents, first_s), first_s)

    def since(self, first_s: float) -> "RenderAsset":
        """The same scene, its times counted from `first_s` on, as a clip within the block counts them."""
        moved = (replace(exposure, time_s=exposure.time_s - first_s) for exposure in self.exposures)
        return replace(self, exposures=tuple(moved))

    def affine_of(self, camera: str, time_s: float) -> F32:
        """(3, 4) what a camera makes of the scene's light at a time, wherever it is: linear between its photos before
        and after, for it exposes anew from place to place; the identity for one whose photos were not aligned."""
        mine = sorted((e for e in self.exposures if e.camera == camera), key=lambda e: e.time_s)
        if not mine:
            return np.eye(3, 4, dtype=np.float32)
        after = bisect_left([e.time_s for e in mine], time_s)
        if after in (0, len(mine)):
            return mine[max(after - 1, 0)].affine
        first, last = mine[after - 1], mine[after]
        share = np.float32((time_s - first.time_s) / (last.time_s - first.time_s))
        return np.asarray(first.affine + share * (last.affine - first.affine), np.float32)


def near_part(background: Gaussians, reach: Reach | None) -> Gaussians:
    """What of it is in reach of a place in its own frame."""
    if reach is None:
        return background
    east, north = (background.means[:, k] - np.float32(reach.place[k]) for k in (0, 1))
    return background.take(np.flatnonzero(east * east + north * north < reach.metres * reach.metres))


def photo_rises(taken: Sequence[PhotoPose]) -> tuple[Array, Array]:
    """Times (T,) of photos, ascending, and how much higher (T,) [m] they were taken than the log has it."""
    rows = np.array(sorted((photo.time_s, photo.rise_m) for photo in taken)).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def camera_psnr_db(asset: RenderAsset) -> dict[str, float]:
    """Mean PSNR [dB] of each camera's photos that were held out, where photos were measured one by one."""
    held_out = [view for view in asset.views if view.held_out]
    cameras = dict.fromkeys(view.camera for view in held_out)
    found = {camera: mean_psnr_db([view for view in held_out if view.camera == camera]) for camera in cameras}
    return {camera: value for camera, value in found.items() if not np.isnan(value)}


def mean_psnr_db(views: Sequence[ViewQuality]) -> float:
    """Mean over the views that were measured; NaN without one."""
    known = [view.psnr_db for view in views if not np.isnan(view.psnr_db)]
    return float(np.mean(known)) if known else float("nan")


def psnr(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Peak signal-to-noise ratio [dB] of two images of the same type: uint8 (peak 255) or float (peak 1)."""
    peak = 255.0 if a.dtype == np.uint8 else 1.0
    apart = np.subtract(a, b, dtype=np.float64)
    return decibels(float(np.mean(np.square(apart, out=apart))) / peak**2)


def decibels(mean_square: float) -> float:
    """Peak signal-to-noise ratio [dB] of what is off by so much, for a peak of 1."""
    return float("inf") if mean_square == 0.0 else -10.0 * float(np.log10(mean_square))


def apply_affine(rgb: F32, affine: F32) -> F32:
    """A picture (H, W, 3) of the scene's light as a camera with `affine` (3, 4) shows it."""
    return np.asarray(rgb @ affine[:, :3].T + affine[:, 3], np.float32)


def compose_gaussians(
    asset: RenderAsset, track_ids: Sequence[str], kinds: Sequence[AgentKind], boxes: Array
) -> Gaussians:
    """Background and the named tracks at `boxes` (N, 7) x, y, z, heading, length, width, height in the world.

    A track without Gaussians of its own is a plain shaded box: nobody is invisible.
    """
    local = boxes - np.concatenate([asset.origin, np.zeros(4)])
    poses = world_from_boxes(local)
    if not len(track_ids):
        return asset.background
    parts = [asset.background]
    for j, track_id in enumerate(track_ids):
        node = asset.nodes.get(track_id)
        if node is None:
            node = box_gaussians(boxes[j, 4:7], kinds[j])
        parts.append(moved(node, poses[j]))
    return concatenate(parts)
