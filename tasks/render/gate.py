"""The gate for rendered pictures: what no reward sees.

A sample is fit to learn from when its rig could have seen every instant from T to T+2H, in both stages, whichever of
the pictures are stored; vehicles that fill much of a stored picture must also look like their photos
(tasks/render/gate.py). Pictures are looked at in small and only as far as `reach_m`: what is farther looks from
here as it did from where the photos were taken, and is most of a block's Gaussians.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import uniform_filter

from tasks.kernels.compiled import kernel
from tasks.render.scene.asset import (
    Instant,
    OwnBody,
    RenderAsset,
    camera_psnr_db,
    compose_gaussians,
    mean_psnr_db,
    near_part,
)
from tasks.render.scene.engine import render, render_instants
from tasks.render.scene.movers import BEYOND_M, PlacedAgents, agents_at_time, behind_boxes, boxes_at, world_from_boxes
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import pixel_directions, rises
from tasks.render.scene.stereo import FAR_M
from tasks.render.seen import PhotoSights, guessed_pixels, street_views
from tasks.render.settings import Backend, GateSettings, RenderSettings
from tasks.render.splatting.gaussians import Gaussians, rotations_of
from tasks.render.splatting.raster import View
from tasks.render.views import instants_of_views
from tasks.stages import Rejected
from tasks.world.arrays import F32, Array, Bools, Bytes, Ints
from tasks.world.clip import AgentKind, AgentTracks, Camera, Pinhole, SensorFile, front_camera

# How like its photos a vehicle near the camera looks, judged by the photo that was taken from nearest to here.
#
# A vehicle that passed the cameras in a few photos can be fitted to streaks: they look right from nowhere, also not
# from where its photos were taken. So the scene is drawn as one photo shows it, from the place that is nearest to
# here as the vehicle sees it, and both are compared inside the vehicle's outline. What is found there fades with the
# way from that place to here: a side that no photo shows, or a look from much nearer, is a guess. How fast it fades
# is for the photos to say that the scene was not made of: few photos a second are fitted each for itself, and from
# between them the vehicle is torn.

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
class VehiclePhotos:
    """A block's photos, for holding vehicles against them."""

    sightings: Mapping[str, Sightings]  # by track id
    likeness: Callable[[str, int], float]  # of a track as the scene draws it to a photo that shows it, 0 to 1
    fading: Callable[[], Mapping[str, float]] = dict  # of tracks; FADING of others
    taken: Callable[[str, int], VehiclePhoto] | None = None  # a track in a photo; None: there is none beside pictures


def find_sightings(files: Sequence[SensorFile], cameras: Sequence[Camera], agents: AgentTracks) -> dict[str, Sightings]:
    """Which of a block's photos show which vehicle; `agents` are the block's, with the files' times."""
    rig = {camera.name: camera for camera in cameras}
    found: dict[str, list[tuple[int, Array]]] = {}
    for row, file in enumerate(files):
        if file.sensor not in rig:
            continue
        camera = rig[file.sensor]
        pose = file.world_from_ego @ camera.ego_from_camera
        boxes, valid = boxes_at(agents, file.time_s)
        near = valid & (np.linalg.norm(boxes[:, :3] - pose[:3, 3], axis=1) < TELLING_M)
        rows = [j for j in np.flatnonzero(near) if agents.kinds[j] == AgentKind.VEHICLE]
        u, v, depth = _projected(boxes[rows], POINTS, camera.intrinsics, pose)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        for j, share in zip(rows, inside.mean(axis=1), strict=True):
            if share >= SHOWN:
                found.setdefault(agents.track_ids[j], []).append((row, to_box_frame(pose[:3, 3], boxes[j])))
    return {
        track_id: Sightings(np.array([row for row, _ in seen]), np.stack([eye for _, eye in seen]))
        for track_id, seen in found.items()
    }


def to_box_frame(eye: Array, box: Array) -> Array:
    """A place (3,) in the coordinates of a box (7,): from its centre, x along its heading."""
    return np.asarray((eye - box[:3]) @ world_from_boxes(box[None])[0, :3, :3])


def expected_likeness(album: VehiclePhotos, track_id: str, eye: Array) -> float:
    """The likeness, 0 to 1, that a track can be expected to have from `eye` (3,) in its box; 0 where no photo shows
    it."""
    seen = album.sightings.get(track_id)
    if seen is None:
        return 0.0
    photo, gap = seen.nearest(eye)
    return album.likeness(track_id, photo) * math.exp(-album.fading().get(track_id, FADING) * gap)


def estimate_fading(
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


def large_vehicles(there: PlacedAgents, eye: Pinhole, view: View, share: float) -> Iterator[tuple[int, float]]:
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
            rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
        outline = box_mask(there.boxes[j], eye, rays)
        hidden = (view.depth < nearest[j] - HIDDEN_M) & (view.alpha > 0.5)
        covered = float((outline & free & ~hidden).mean())
        free &= ~outline
        if covered >= share:
            yield int(j), covered


def box_mask(box: Array, eye: Pinhole, rays: Array | None = None) -> Bools:
    """(H, W) the pixels that look at a box (7,) in the world; `rays` (H * W, 3) where they are known."""
    if rays is None:
        rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
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
    there = agents_at_time(agents, photo.time_s)
    seen = render(asset, [eye], there, backend, affines=[asset.affine_of(photo.camera, photo.time_s)])[0].rgb
    similar = ssim_map(seen, photo.rgb.astype(np.float32) / np.float32(255.0))
    out = {}
    for track_id in track_ids:
        inside = box_mask(there.boxes[there.track_ids.index(track_id)], eye)
        out[track_id] = masked_mean(similar, inside)
    return out


def masked_mean(similar: F32, inside: Bools) -> float:
    """Mean of a similarity map over the pixels inside, from 0 to 1; 0 where there are none."""
    return max(0.0, float(similar[inside].mean())) if inside.any() else 0.0


def ssim_map(a: F32, b: F32) -> F32:
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


# A vehicle in a picture beside a photo of it that was taken from near: what is torn from here is not like it.
#
# A box is shape enough for a small step aside: each pixel of the vehicle's outline looks at a place of its box's
# surface and is held against the photo's pixel that looks at the same place. What lies a metre behind the box, as a
# bonnet does, is off by 0.01 rad after a step of 1 m at 10 m: a pixel of a picture of 160. Nothing of the scene's own
# shape goes in: by its own depths a torn vehicle would look like every photo that it was fitted to.

REACH_PX = 2 * (math.ceil(4.0 * SIGMA_PX) + 2)  # of the similarity's window, at half size
SHIFTS_PX = (-2, -1, 0, 1, 2)  # by which the photo is moved either way to fit: a box is no car, nor where it is exactly


def likeness_beside_photo(
    rgb: F32, eye: Pinhole, box: Array, others: Array, taken: VehiclePhoto
) -> tuple[float, float]:
    """How like a photo a picture (H, W, 3) of a vehicle is, 0 to 1, and the share of its outline that both show.

    `box` (7,) is the vehicle's and `others` (N, 7) those that may hide it, as `eye` sees them. Likeness is the SSIM at
    half size over the places that both show, the best under small shifts of the photo. 0 and 0 where there is none.
    """
    rays = pixel_directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height).reshape(-1, 3)
    place, photo = eye.world_from_camera[:3, 3], taken.photo
    points, axis, side, along = intersect_box(box, place, rays)
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
    return _best_shifted_likeness(rgb, photo.rgb, columns, rows, clear.reshape(shape)), float(
        clear.sum() / outline.sum()
    )


def intersect_box(box: Array, eye: Array, rays: Array) -> tuple[Array, Ints, Array, Array]:
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


def _best_shifted_likeness(rgb: F32, photo: Bytes, columns: F32, rows: F32, clear: Bools) -> float:
    """Likeness of the `clear` pixels to the photo's at columns and rows (H, W) under the best of the shifts."""
    around = _window_around(clear)
    rgb, columns, rows, clear = rgb[around], columns[around], rows[around], clear[around]
    theirs = photo.astype(np.float32) / np.float32(255.0)
    best = 0.0
    for down in SHIFTS_PX:
        for right in SHIFTS_PX:
            at = columns + np.float32(right), rows + np.float32(down)
            moved = cv2.remap(theirs, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            mixed = np.where(clear[..., None], moved, rgb).astype(np.float32)
            best = max(best, masked_mean(ssim_map(rgb, mixed), clear))
    return best


def _window_around(clear: Bools) -> tuple[slice, slice]:
    """The rows and columns of a picture that the similarity of its `clear` pixels (H, W) comes from.

    All, where half the picture's size is none of whole pixels.
    """
    spans = []
    for axis, size in enumerate(clear.shape):
        there: list[int] = np.flatnonzero(clear.any(axis=1 - axis)).tolist()
        first, last = max(0, there[0] - REACH_PX) // 2 * 2, min(size, (there[-1] + 1 + REACH_PX) // 2 * 2)
        spans.append(slice(first, last) if size % 2 == 0 else slice(0, size))
    rows, columns = spans
    return rows, columns


GREY = np.array([0.299, 0.587, 0.114], np.float32)  # luma of ITU-R BT.601
SOLID = 0.5  # alpha from which a pixel counts as covered
INSIDE_SIGMAS = 2.0  # a lens this close to a Gaussian's mean, in its standard deviations, is inside of it
ROUNDING_M = 0.01  # more than distances in float32 are off by
MAGNIFIED = 30.0  # takes what is 1 cm from the lens out to the rasteriser's near plane at 0.3 m
NO_CONTRAST = 1.0e-6
# These limits and `contrast_min` lie between what was measured on the synthetic town (2 blocks, 3 cameras): 135
# pictures of accepted drives had at most 6 % holes and 11 % on the lens, contrast 0.15 and detail 0.11 at least; 20 m
# aside, inside the houses or behind them, most had 60 % to 100 % holes. Photos (KITTI, nuScenes, the town) have detail
# 0.17 to 0.33; blurred by 1.5 pixels of the small picture, 0.06 at most.
ROAD_M = 20.0  # a ray that meets the road's plane nearer than this is not one at the sky
HOLE_MAX = 0.2  # share of those rays that meet nothing
LENS_M = 0.8  # what is nearer than this is on the lens
LENS_MAX = 0.2  # share of the picture that may be covered by it
BEHIND_BOX_M = 0.7  # so far windows, bonnets and wheels lie behind their vehicle's box, seen from a slant
BESIDE_RAD = 0.06  # by so much may such a place be off, from two places, for a picture to be held beside a photo
BESIDE_GAP = 0.5  # and so far may these be apart, as a share of the distance
BESIDE_SHARE = 0.3  # of a vehicle's outline, that both must show
DETAIL_MIN = 0.06  # standard deviation of the grey picture less its 3 x 3 mean, as a share of the contrast


@dataclass(frozen=True)
class PictureMeasures:
    """What was found on one picture; see GateSettings."""

    holes: float
    lens: float
    contrast: float
    detail: float


def check_drive_pictures(
    asset: RenderAsset,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[int],
    size: tuple[int, int],
    settings: GateSettings,
    backend: Backend = Backend.CPU,
    album: VehiclePhotos | None = None,
    stored: Collection[int] = (),
    sights: PhotoSights | None = None,
) -> Rejected | None:
    """The first picture of a drive that is not fit to be a sample's; None where all are.

    `world_from_ego` (F, 4, 4) in 3-D, `steps` (F,) rows of `agents` at these instants, whose first is the scene's time
    0, `size` width, height [px] of the pictures to be stored, whose shape the small ones have. Of the `stored` steps
    alone vehicles are held against the photos of an `album`, and the street against what photos have in their `sights`:
    what is torn elsewhere nobody learns from.
    """
    width, height = gate_picture_size(size, settings)
    rig = [camera.resized(width, height) for camera in cameras]
    asked, own = instants_of_views(asset, cameras, world_from_ego, agents, steps, width, height, settings.reach_m)
    seen = render_instants(asset, asked, backend)
    shots = [(camera, pose) for pose, step in zip(world_from_ego, steps) if step in stored for camera in rig]
    streets = street_views(asset, shots if sights is not None else (), backend)
    for instant, views, pose, step in zip(asked, seen, world_from_ego, steps, strict=True):
        there, looked_at = instant.vehicles, measure_rendered_views(asset, instant, views, pose, backend, own)
        for camera, eye, view, found, body in zip(rig, instant.cameras, views, looked_at, own, strict=True):
            away = eye.world_from_camera[:3, 3] - there.boxes[:, :3]
            local = np.einsum("nij,ni->nj", world_from_boxes(there.boxes)[:, :3, :3], away)
            within = (np.abs(local) < there.boxes[:, 4:7] / 2.0).all(axis=1)
            inside = [there.track_ids[j] for j in np.flatnonzero(within)]
            fault = ("lens_covered", f"inside track {inside[0]}") if inside else picture_fault(found, settings)
            if fault is None and sights is not None and step in stored:
                fault = guess_fault(sights, *next(streets), there, body, settings)
            if fault is None and album is not None and step in stored:
                fault = vehicle_fault(album, there, eye, view, settings)
            if fault is not None:
                return Rejected("render", fault[0], f"{camera.name} at step {step}: {fault[1]}")
    return None


def gate_picture_size(size: tuple[int, int], settings: GateSettings) -> tuple[int, int]:
    """Width and height [px] of the pictures that are looked at, for those of `size` to be stored."""
    width = min(settings.width, size[0])
    return width, max(1, round(width * size[1] / size[0]))


def vehicle_fault(
    album: VehiclePhotos, there: PlacedAgents, eye: Pinhole, view: View, settings: GateSettings
) -> tuple[str, str] | None:
    """(reason, detail) of the nearest large vehicle that cannot be expected to look like its photos."""
    if settings.vehicle_min == 0.0:
        return None
    for j, share in large_vehicles(there, eye, view, settings.vehicle_share):
        track_id, box = there.track_ids[j], there.boxes[j]
        alike = expected_likeness(album, track_id, to_box_frame(eye.world_from_camera[:3, 3], box))
        if alike < settings.vehicle_min:
            return "unlike_photos", f"track {track_id} on {share:.0%} of the picture, expected likeness {alike:.2f}"
        alike = likeness_to_nearest_photo(album, there, j, eye, view)
        if alike < settings.beside_min:
            return (
                "unlike_photos",
                f"track {track_id} on {share:.0%} of the picture, likeness {alike:.2f} beside a photo",
            )
    return None


def guess_fault(
    sights: PhotoSights, eye: Pinhole, view: View, there: PlacedAgents, body: OwnBody | None, settings: GateSettings
) -> tuple[str, str] | None:
    """(reason, detail) of a picture whose street view in its worst quarter is a guess, however far away."""
    guessed = guessed_pixels(sights, eye, view, there.boxes)
    if body is not None:
        guessed &= ~body.in_front(*guessed.shape[::-1])
    share = worst_quarter(guessed)
    if share <= settings.guessed_max:
        return None
    return "guessed", f"{share:.0%} of a quarter of the picture is a guess: photos do not show it, or not like that"


def worst_quarter(found: Bools) -> float:
    """Share of the pixels found (H, W) in whichever window of half the width and height has most of them."""
    height, width = (size // 2 for size in found.shape)
    sums = np.pad(found.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return float(inside.max() / (height * width))


def likeness_to_nearest_photo(album: VehiclePhotos, there: PlacedAgents, j: int, eye: Pinhole, view: View) -> float:
    """How like the photo that was taken from nearest to here the j-th vehicle in a picture is, 0 to 1; 1 where no photo
    was taken near enough to say."""
    track_id, box = there.track_ids[j], there.boxes[j]
    seen = album.sightings.get(track_id)
    if seen is None or album.taken is None:
        return 1.0
    inside = to_box_frame(eye.world_from_camera[:3, 3], box)
    row, gap = seen.nearest(inside)
    if gap > BESIDE_GAP or gap * BEHIND_BOX_M > BESIDE_RAD * float(np.linalg.norm(inside)):
        return 1.0
    alike, share = likeness_beside_photo(
        view.rgb, eye, box, np.delete(there.boxes, j, axis=0), album.taken(track_id, row)
    )
    return alike if share >= BESIDE_SHARE else 1.0


def picture_fault(found: PictureMeasures, settings: GateSettings) -> tuple[str, str] | None:
    """(reason, detail) of the first measure that does not come up to the settings."""
    if found.lens > LENS_MAX:
        return "lens_covered", f"{found.lens:.0%} of the picture by what is nearer than {LENS_M:g} m"
    if found.holes > HOLE_MAX:
        return "holes", f"{found.holes:.0%} of the road within {ROAD_M:g} m is not there"
    if found.contrast < settings.contrast_min:
        return "blank", f"contrast {found.contrast:.3f}"
    if found.detail < DETAIL_MIN:
        return "blurred", f"detail {found.detail:.3f}"
    return None


def measure_rendered_views(
    asset: RenderAsset,
    instant: Instant,
    views: Sequence[View],
    world_from_ego: Array,
    backend: Backend = Backend.CPU,
    own: Sequence[OwnBody | None] | None = None,
) -> list[PictureMeasures]:
    """Of the view that each camera has at an instant; nothing is missed where its `own` body is in front."""
    if not views:
        return []
    out, around = [], _around_lenses(asset, instant)
    for eye, seen, body in zip(instant.cameras, views, own or [None] * len(views), strict=True):
        road = meets_road(eye, world_from_ego)
        if body is not None:
            road &= ~body.in_front(eye.width, eye.height)
        close = _on_the_lens(around, eye.world_from_camera[:3, 3] - asset.origin)
        lens = render(replace(asset, background=close), [eye], backend=backend)[0].alpha if len(close) else None
        out.append(measure_rendered_view(seen, road, lens))
    return out


def measure_rendered_view(seen: View, road: Bools, lens: F32 | None = None) -> PictureMeasures:
    """Of one picture; `road` (H, W) pixels that are not to show sky, `lens` (H, W) alpha of what is on the lens."""
    grey = seen.rgb @ GREY
    contrast = float(grey.std())
    fine = grey - uniform_filter(grey, 3, mode="nearest")
    return PictureMeasures(
        holes=float((seen.alpha[road] < SOLID).mean()) if road.any() else 0.0,
        lens=0.0 if lens is None else float((lens > SOLID).mean()),
        contrast=contrast,
        detail=float(fine.std()) / max(contrast, NO_CONTRAST),
    )


def meets_road(eye: Pinhole, world_from_ego: Array) -> Bools:
    """Which pixels (H, W) look at the plane of the ego frame's x and y nearer than ROAD_M.

    Where that frame lies at the axle the plane is a wheel's radius above the road: a few rays less are asked for.
    """
    up, place = world_from_ego[:3, 2], eye.world_from_camera[:3, 3]
    rise, length = rises(eye.intrinsics, up @ eye.world_from_camera[:3, :3], eye.width, eye.height)
    height = float((place - world_from_ego[:3, 3]) @ up)
    return np.asarray((rise < 0.0) & (height * length < -rise * ROAD_M))


def _around_lenses(asset: RenderAsset, instant: Instant) -> Gaussians:
    """What may be on one of an instant's lenses, and few more, of the scene as it is drawn."""
    eyes = np.stack([eye.world_from_camera[:3, 3] for eye in instant.cameras]) - asset.origin
    middle, there = eyes.mean(axis=0), instant.vehicles
    apart_m = float(np.linalg.norm(eyes - middle, axis=1).max())
    reach = instant.reach and replace(instant.reach, place=instant.reach.place - asset.origin)

    def about(part: Gaussians) -> Gaussians:
        return part.take(rows_nearer(part, middle, LENS_M + apart_m + ROUNDING_M))

    near = replace(asset, background=near_part(about(asset.background), reach))
    return about(compose_gaussians(near, there.track_ids, there.kinds, there.boxes))


def rows_nearer(scene: Gaussians, place: Array, metres: float) -> Ints:
    """Rows of what comes nearer to a place (3,) than so many metres, INSIDE_SIGMAS of it counted in."""
    return np.asarray(_near_rows(scene.means, scene.log_scales, place.astype(np.float32), np.float32(metres)))


@kernel
def _near_rows(means: Any, log_scales: Any, place: Any, metres: Any) -> Any:
    rows, count, sigmas = np.empty(means.shape[0], np.int64), 0, np.float32(INSIDE_SIGMAS)
    for i in range(means.shape[0]):
        x, y, z = means[i, 0] - place[0], means[i, 1] - place[1], means[i, 2] - place[2]
        beyond = np.sqrt(x * x + y * y + z * z) - metres
        widest = max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        if beyond < 0.0 or ((widest > 0.0 or beyond < sigmas) and beyond < sigmas * np.exp(widest)):
            rows[count] = i
            count += 1
    return rows[:count]


def _on_the_lens(scene: Gaussians, eye: Array) -> Gaussians:
    """What is nearer to `eye` than LENS_M or has it inside, magnified around it.

    That gives the same picture but moves nothing in front of the near plane: a wall nearer than that is not drawn, and
    the picture would show what is behind it.
    """
    near = scene.take(rows_nearer(scene, eye, LENS_M))
    x, y, z = (near.means[:, k] - np.float32(eye[k]) for k in range(3))
    along = np.einsum("nij,ni->nj", rotations_of(near.quats), near.means - eye) / np.exp(near.log_scales)
    touched = np.sqrt(x * x + y * y + z * z) < LENS_M
    close = near.take(touched | ((along * along).sum(axis=1) < INSIDE_SIGMAS**2))
    means = (eye + MAGNIFIED * (close.means - eye)).astype(np.float32)
    return replace(close, means=means, log_scales=close.log_scales + np.float32(math.log(MAGNIFIED)))


# The gate for blocks: what a block's held-out photos must come out with, at the size that pictures are stored in.
#
# PSNR depends on that size: fine texture, which no scene has in full, is averaged away in small pictures.


@dataclass(frozen=True)
class BlockVerdict:
    """What a block is good for."""

    left_out: Mapping[str, str]  # cameras that come out too poor to be drawn, and how poor
    psnr_db: float  # of the held-out photos of the others; NaN where none was held out
    fault: str | None  # why nothing is drawn from it


def judge_block(asset: RenderAsset, rig: Sequence[Camera], settings: RenderSettings) -> BlockVerdict:
    """A camera below `camera_psnr_min` is left out. Nothing is drawn where that is the one that looks ahead or one that
    was asked for by name, or where the others come out below `psnr_min`.

    rig: the cameras that are to be drawn. Where nothing was held out nothing is known, and where `psnr_min` is 0 any
    block will do.
    """
    if settings.psnr_min == 0.0:
        return BlockVerdict({}, asset.psnr_db, None)
    known = camera_psnr_db(asset)
    poor = {c.name: known[c.name] for c in rig if known.get(c.name, np.inf) < settings.camera_psnr_min}
    bound, size = f"below {settings.camera_psnr_min:g}", f"{settings.width}x{settings.height}"
    left_out = {name: f"{value:.2f} dB, {bound}" for name, value in poor.items()}
    held_out = [view for view in asset.views if view.held_out and view.camera not in poor]
    psnr_db = mean_psnr_db(held_out) if poor else asset.psnr_db
    axes = np.array([camera.ego_from_camera[:2, 2] for camera in rig]).reshape(-1, 2)
    front = front_camera([camera.name for camera in rig], axes)
    needed = [name for name in poor if name == front or name in settings.cameras]
    fault = None
    if needed or (poor and len(poor) == len(rig)):
        name = min(needed or poor, key=lambda name: poor[name])
        others = f" like {len(poor)} of {len(rig)} cameras" if len(rig) > 1 else ""
        fault = f"{name} at {left_out[name]}{others}; {asset.n_held_out} held-out photos at {size}"
    elif psnr_db < settings.psnr_min:
        without = f" of {len(rig) - len(poor)} of {len(rig)} cameras" if poor else ""
        fault = f"block at {psnr_db:.2f} dB over {len(held_out) or asset.n_held_out} held-out photos{without} at {size}"
        fault += f", below {settings.psnr_min:g}"
    return BlockVerdict(left_out, psnr_db, fault)
