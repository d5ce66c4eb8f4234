"""How like its photos a vehicle near the camera looks, judged by the photo that was taken from nearest to here.

A vehicle that passed the cameras in a few photos can be fitted to streaks: they look right from nowhere, also not from
where its photos were taken. So the scene is drawn as one photo shows it, from the place that is nearest to here as the
vehicle sees it, and both are compared inside the vehicle's outline. What is found there fades with the way from that
place to here: a side that no photo shows, or a look from much nearer, is a guess. How fast it fades is for the photos
to say that the scene was not made of: few photos a second are fitted each for itself, and from between them the
vehicle is torn.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import Backend, Vehicles, render, vehicles_at
from tasks.render.scene.movers import BEYOND_M, behind_boxes, boxes_at, world_from_boxes
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import directions
from tasks.render.scene.stereo import FAR_M
from tasks.render.splatting.raster import View
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import F32, Array, Bools, Ints
from tasks.world.camera import Camera, Pinhole, SensorFile

FADING = 0.2  # at least: likeness falls by exp(-0.2) where the eye moves by as much as it was away from the vehicle
LEAST_LIKE = 0.05  # below, a vehicle is not there at all, and its likeness says no more
LEAST_HELD_OUT = 10  # looks at vehicles in photos held out, fewer of which say nothing
LEAST_GAP = 0.1  # between such a photo and the nearest other, below which a look says more of noise than of the way
OTHERS_WAY = 0.2
MOST_HELD_OUT = 100  # that are compared
TELLING_M = 40.0  # a photo from farther tells nothing of how a vehicle looks from near
SHOWN = 0.3  # share of a vehicle's points that a photo must have in view
SIGMA_PX = 1.5  # of the window of SSIM (Wang et al. 2004), on pictures of half the size: blur alone is forgiven
C1, C2 = 0.01**2, 0.03**2
HIDDEN_M = 0.5  # what is drawn this much before a vehicle's nearest corner hides it
CORNERS = np.stack(np.meshgrid((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5), indexing="ij"), axis=-1).reshape(8, 3)
POINTS = 0.9 * np.stack(np.meshgrid(*3 * [(-0.5, 0.0, 0.5)], indexing="ij"), axis=-1).reshape(27, 3)


@dataclass(frozen=True)
class Sightings:
    """The photos that show one track, and from where."""

    photos: Ints  # (M,) rows of the block's photos
    eyes: Array  # (M, 3) of the cameras, in the track's box then: centre, x along the heading [m]

    def nearest(self, eye: Array) -> tuple[int, float]:
        """The photo taken from nearest to `eye` (3,) in box coordinates, and how far from it, as a share of the eye's
        distance from the centre."""
        away = np.linalg.norm(self.eyes - eye, axis=1)
        k = int(np.argmin(away))
        return int(self.photos[k]), float(away[k] / max(float(np.linalg.norm(eye)), 1e-6))


@dataclass(frozen=True)
class VehiclePhoto:
    """A photo of a vehicle, and who was where when it was taken."""

    photo: Photo
    box: Array  # (7,) the vehicle's
    others: Array  # (N, 7) the boxes that may hide it


@dataclass(frozen=True)
class Album:
    """A block's photos, for holding vehicles against them."""

    sightings: Mapping[str, Sightings]  # by track id
    likeness: Callable[[str, int], float]  # of a track as the scene draws it to a photo that shows it, 0 to 1
    fading: Callable[[], Mapping[str, float]] = dict  # of tracks; FADING of others
    taken: Callable[[str, int], VehiclePhoto] | None = None  # a track in a photo; None: there is none beside pictures


def sightings(files: Sequence[SensorFile], cameras: Sequence[Camera], agents: AgentTracks) -> dict[str, Sightings]:
    """Which of a block's photos show which vehicle; `agents` are the block's, with the files' times."""
    rig = {camera.name: camera for camera in cameras}
    found: dict[str, list[tuple[int, Array]]] = {}
    for row, file in enumerate(files):
        if file.sensor not in rig:
            continue
        camera = rig[file.sensor]
        pose = file.world_from_ego @ camera.ego_from_camera
        boxes, valid = boxes_at(agents, file.taken_s)
        near = valid & (np.linalg.norm(boxes[:, :3] - pose[:3, 3], axis=1) < TELLING_M)
        rows = [j for j in np.flatnonzero(near) if agents.kinds[j] == AgentKind.VEHICLE]
        u, v, depth = _projected(boxes[rows], POINTS, camera.intrinsics, pose)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        for j, share in zip(rows, inside.mean(axis=1), strict=True):
            if share >= SHOWN:
                found.setdefault(agents.track_ids[j], []).append((row, eye_in_box(pose[:3, 3], boxes[j])))
    return {
        track_id: Sightings(np.array([row for row, _ in seen]), np.stack([eye for _, eye in seen]))
        for track_id, seen in found.items()
    }


def eye_in_box(eye: Array, box: Array) -> Array:
    """A place (3,) in the coordinates of a box (7,): from its centre, x along its heading."""
    return np.asarray((eye - box[:3]) @ world_from_boxes(box[None])[0, :3, :3])


def expected(album: Album, track_id: str, eye: Array) -> float:
    """The likeness, 0 to 1, that a track can be expected to have from `eye` (3,) in its box; 0 where no photo shows
    it."""
    seen = album.sightings.get(track_id)
    if seen is None:
        return 0.0
    photo, gap = seen.nearest(eye)
    return album.likeness(track_id, photo) * math.exp(-album.fading().get(track_id, FADING) * gap)


def fading_of(
    seen: Mapping[str, Sightings], likeness: Callable[[str, int], float], held_out: Collection[int]
) -> Mapping[str, float]:
    """How fast the likeness of each track fades away from the photos that a scene was made of.

    Each look at a vehicle in one of the photos (rows) `held_out` is held against what the nearest other photo of it
    says: it loses so much by so much of a way. What all lose together counts for each track as if it were OTHERS_WAY of
    its own, which it has little of. No less than FADING, which is what too few looks say.
    """
    looks = [(name, k) for name, mine in seen.items() for k in range(len(mine.photos)) if mine.photos[k] in held_out]
    lost: dict[str, list[tuple[float, float]]] = {}
    for name, k in looks[:: max(1, math.ceil(len(looks) / MOST_HELD_OUT))]:
        mine = seen[name]
        used = ~np.isin(mine.photos, list(held_out))
        if not used.any():
            continue
        photo, gap = Sightings(mine.photos[used], mine.eyes[used]).nearest(mine.eyes[k])
        if gap >= LEAST_GAP:
            there, here = (max(likeness(name, row), LEAST_LIKE) for row in (photo, int(mine.photos[k])))
            lost.setdefault(name, []).append((math.log(there / here), gap))
    every = np.array([row for mine in lost.values() for row in mine]).reshape(-1, 2)
    if len(every) < LEAST_HELD_OUT:
        return {}
    usual = max(FADING, every[:, 0].sum() / every[:, 1].sum())
    sums = {name: np.sum(lost.get(name, [(0.0, 0.0)]), axis=0) for name in seen}
    return {n: max(FADING, float((loss + usual * OTHERS_WAY) / (way + OTHERS_WAY))) for n, (loss, way) in sums.items()}


def large_vehicles(there: Vehicles, eye: Pinhole, view: View, share: float) -> Iterator[tuple[int, float]]:
    """Rows of the vehicles that cover at least a share of a picture, each with its share, the nearest first.

    `view` of the scene with them: what is behind a nearer vehicle or behind what the scene has there is not covered.
    """
    vehicles = np.array([kind == AgentKind.VEHICLE for kind in there.kinds], bool)
    grown = there.boxes + np.array([0.0, 0.0, 0.0, 0.0, *3 * [2.0 * BEYOND_M]])
    u, v, depth = _projected(grown, CORNERS, eye.intrinsics, eye.world_from_camera)
    nearest = depth.min(axis=1, initial=np.inf)
    with np.errstate(invalid="ignore"):
        wide = np.clip(u, 0.0, eye.width), np.clip(v, 0.0, eye.height)
        area = np.ptp(wide[0], axis=1) * np.ptp(wide[1], axis=1) if len(grown) else np.zeros(0)
    possible = vehicles & (depth.max(axis=1, initial=-np.inf) > 0.0)
    possible &= (nearest <= 0.0) | (area >= share * eye.width * eye.height)
    rays = None
    free = np.ones((eye.height, eye.width), bool)
    for j in sorted(np.flatnonzero(possible), key=lambda j: nearest[j]):
        if rays is None:
            rays = directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
        outline = outline_of(there.boxes[j], eye, rays)
        hidden = (view.depth < nearest[j] - HIDDEN_M) & (view.alpha > 0.5)
        covered = float((outline & free & ~hidden).mean())
        free &= ~outline
        if covered >= share:
            yield int(j), covered


def outline_of(box: Array, eye: Pinhole, rays: Array | None = None) -> Bools:
    """(H, W) the pixels that look at a box (7,) in the world; `rays` (H * W, 3) where they are known."""
    if rays is None:
        rays = directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
    place = np.ascontiguousarray(eye.world_from_camera[:3, 3])
    met = behind_boxes(place + FAR_M * rays, place, np.ascontiguousarray(box[None]))
    return np.asarray(met).reshape(eye.height, eye.width)


def likeness_to_photo(
    asset: RenderAsset, photo: Photo, agents: AgentTracks, track_ids: Sequence[str], backend: Backend = Backend.CPU
) -> dict[str, float]:
    """How like the photo the scene draws each track, inside its outline; tracks without any pixel have 0.

    `agents` are the block's, with the photo's time. The scene gets the exposure that its camera had then.
    """
    height, width = photo.rgb.shape[:2]
    eye = Pinhole(photo.intrinsics, photo.world_from_camera, width, height)
    there = vehicles_at(agents, photo.taken_s)
    seen = render(asset, [eye], there, backend, affines=[asset.affine_of(photo.camera, photo.time_s)])[0].rgb
    similar = similarity(seen, photo.rgb.astype(np.float32) / np.float32(255.0))
    out = {}
    for track_id in track_ids:
        inside = outline_of(there.boxes[there.track_ids.index(track_id)], eye)
        out[track_id] = inside_mean(similar, inside)
    return out


def inside_mean(similar: F32, inside: Bools) -> float:
    """Mean of a similarity map over the pixels inside, from 0 to 1; 0 where there are none."""
    return max(0.0, float(similar[inside].mean())) if inside.any() else 0.0


def similarity(a: F32, b: F32) -> F32:
    """(H, W) SSIM of two pictures (H, W, 3) in [0, 1], mean over the channels, at half their size."""
    height, width = a.shape[:2]
    half = (max(1, width // 2), max(1, height // 2))
    x, y = (np.asarray(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), np.float32) for picture in (a, b))
    mean_x, mean_y = _blurred(x), _blurred(y)
    spread_x, spread_y = _blurred(x * x) - mean_x * mean_x, _blurred(y * y) - mean_y * mean_y
    common = _blurred(x * y) - mean_x * mean_y
    alike = (2.0 * mean_x * mean_y + C1) * (2.0 * common + C2)
    alike /= (mean_x * mean_x + mean_y * mean_y + C1) * (spread_x + spread_y + C2)
    small = alike.mean(axis=-1).astype(np.float32)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def _blurred(picture: F32) -> F32:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), SIGMA_PX, borderType=cv2.BORDER_REFLECT), np.float32)


def _projected(boxes: Array, points: Array, intrinsics: Array, world_from_camera: Array) -> tuple[Array, Array, Array]:
    """Pixels u, v and depths (N, P) of points (P, 3) of boxes (N, 7), in shares of their sizes; u, v mean nothing where
    the depth is not positive."""
    local = points * boxes[:, None, 4:7]
    world = np.einsum("nij,npj->npi", world_from_boxes(boxes)[:, :3, :3], local) + boxes[:, None, :3]
    camera = (world - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    depth = camera[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = intrinsics[0, 0] * camera[..., 0] / depth + intrinsics[0, 2]
        v = intrinsics[1, 1] * camera[..., 1] / depth + intrinsics[1, 2]
    return u, v, depth
