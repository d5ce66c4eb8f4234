"""The gate for rendered pictures: what no reward sees.

A sample is fit to learn from when its rig could have seen every instant from T to T+2H, in both stages, whichever of
the pictures are stored; vehicles that fill much of a stored picture must also look like their photos
(tasks/render/likeness.py). Pictures are looked at in small and only as far as `reach_m`: what is farther looks from
here as it did from where the photos were taken, and is most of a block's Gaussians.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from tasks.render.beside_photo import beside_photo
from tasks.render.likeness import Album, expected, eye_in_box, large_vehicles
from tasks.render.scene.asset import OwnBody, RenderAsset, scene_at
from tasks.render.scene.engine import Backend, Vehicles, render, vehicles_at
from tasks.render.scene.movers import world_from_boxes
from tasks.render.scene.sky import directions
from tasks.render.settings import GateSettings
from tasks.render.splatting.gaussians import Gaussians, rotations_of
from tasks.render.splatting.raster import View
from tasks.stages import Rejected
from tasks.world.agents import AgentTracks
from tasks.world.arrays import F32, Array, Bools
from tasks.world.camera import Camera, Pinhole
from tasks.world.clip import STEP_S

GREY = np.array([0.299, 0.587, 0.114], np.float32)  # luma of ITU-R BT.601
SOLID = 0.5  # alpha from which a pixel counts as covered
INSIDE_SIGMAS = 2.0  # a lens this close to a Gaussian's mean, in its standard deviations, is inside of it
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
class Measures:
    """What was found on one picture; see GateSettings."""

    holes: float
    lens: float
    contrast: float
    detail: float


def unfit(
    asset: RenderAsset,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[int],
    size: tuple[int, int],
    settings: GateSettings,
    backend: Backend = Backend.CPU,
    album: Album | None = None,
    stored: Collection[int] = (),
) -> Rejected | None:
    """The first picture of a drive that is not fit to be a sample's; None where all are.

    `world_from_ego` (F, 4, 4) in 3-D, `steps` (F,) rows of `agents` at these instants, whose first is the scene's time
    0, `size` width, height [px] of the pictures to be stored, whose shape the small ones have. Of the `stored` steps
    alone vehicles are held against the photos of an `album`: what is torn elsewhere nobody learns from.
    """
    width, height = looked_at_size(size, settings)
    rig = [camera.resized(width, height) for camera in cameras]
    for pose, step in zip(world_from_ego, steps, strict=True):
        there = vehicles_at(agents, step * STEP_S, pose[:2, 3], settings.reach_m)
        eyes = [Pinhole(c.intrinsics, pose @ c.ego_from_camera, c.width, c.height) for c in rig]
        scene = composed(asset, there, pose[:3, 3], settings.reach_m)
        affines = [asset.affine_of(camera.name, step * STEP_S) for camera in cameras]
        views = render(scene, eyes, backend=backend, affines=affines)
        own = [asset.own_body(camera.name) for camera in cameras]
        looked_at = measures(scene, eyes, views, pose, backend, own)
        for camera, eye, view, found in zip(rig, eyes, views, looked_at, strict=True):
            inside = _tracks_around(eye.world_from_camera[:3, 3], there)
            fault = ("lens_covered", f"inside track {inside[0]}") if inside else fault_of(found, settings)
            if fault is None and album is not None and step in stored:
                fault = unlike(album, there, eye, view, settings)
            if fault is not None:
                return Rejected("render", fault[0], f"{camera.name} at step {step}: {fault[1]}")
    return None


def looked_at_size(size: tuple[int, int], settings: GateSettings) -> tuple[int, int]:
    """Width and height [px] of the pictures that are looked at, for those of `size` to be stored."""
    width = min(settings.width, size[0])
    return width, max(1, round(width * size[1] / size[0]))


def unlike(album: Album, there: Vehicles, eye: Pinhole, view: View, settings: GateSettings) -> tuple[str, str] | None:
    """(reason, detail) of the nearest large vehicle that cannot be expected to look like its photos."""
    if settings.vehicle_min == 0.0:
        return None
    for j, share in large_vehicles(there, eye, view, settings.vehicle_share):
        track_id, box = there.track_ids[j], there.boxes[j]
        alike = expected(album, track_id, eye_in_box(eye.world_from_camera[:3, 3], box))
        if alike < settings.vehicle_min:
            return "unlike_photos", f"track {track_id} on {share:.0%} of the picture, expected likeness {alike:.2f}"
        alike = seen_beside(album, there, j, eye, view)
        if alike < settings.beside_min:
            return (
                "unlike_photos",
                f"track {track_id} on {share:.0%} of the picture, likeness {alike:.2f} beside a photo",
            )
    return None


def seen_beside(album: Album, there: Vehicles, j: int, eye: Pinhole, view: View) -> float:
    """How like the photo that was taken from nearest to here the j-th vehicle in a picture is, 0 to 1; 1 where no photo
    was taken near enough to say."""
    track_id, box = there.track_ids[j], there.boxes[j]
    seen = album.sightings.get(track_id)
    if seen is None or album.taken is None:
        return 1.0
    inside = eye_in_box(eye.world_from_camera[:3, 3], box)
    row, gap = seen.nearest(inside)
    if gap > BESIDE_GAP or gap * BEHIND_BOX_M > BESIDE_RAD * float(np.linalg.norm(inside)):
        return 1.0
    alike, share = beside_photo(view.rgb, eye, box, np.delete(there.boxes, j, axis=0), album.taken(track_id, row))
    return alike if share >= BESIDE_SHARE else 1.0


def fault_of(found: Measures, settings: GateSettings) -> tuple[str, str] | None:
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


def composed(asset: RenderAsset, there: Vehicles, place: Array, reach_m: float) -> RenderAsset:
    """The scene with who is there as its background, without what is farther than reach_m from a place (3,) in the
    world, seen from above."""
    east, north = (asset.background.means[:, k] - np.float32(place[k] - asset.origin[k]) for k in (0, 1))
    rows = np.flatnonzero(east * east + north * north < reach_m * reach_m)
    near = replace(asset, background=asset.background.take(rows))
    scene = scene_at(near, there.track_ids, there.kinds, there.boxes)
    return replace(asset, background=scene, nodes={})


def measures(
    scene: RenderAsset,
    eyes: Sequence[Pinhole],
    views: Sequence[View],
    world_from_ego: Array,
    backend: Backend = Backend.CPU,
    own: Sequence[OwnBody | None] | None = None,
) -> list[Measures]:
    """Of the view that each camera has of a composed scene; nothing is missed where its `own` body is in front."""
    out = []
    for eye, seen, body in zip(eyes, views, own or [None] * len(eyes), strict=True):
        rays = directions(eye.intrinsics, eye.world_from_camera, eye.width, eye.height)
        road = meets_road(rays, eye.world_from_camera[:3, 3], world_from_ego)
        if body is not None:
            road &= ~body.in_front(eye.width, eye.height)
        close = _on_the_lens(scene.background, eye.world_from_camera[:3, 3] - scene.origin)
        lens = render(replace(scene, background=close), [eye], backend=backend)[0].alpha if len(close) else None
        out.append(measured(seen, road, lens))
    return out


def measured(seen: View, road: Bools, lens: F32 | None = None) -> Measures:
    """Of one picture; `road` (H, W) pixels that are not to show sky, `lens` (H, W) alpha of what is on the lens."""
    grey = seen.rgb @ GREY
    contrast = float(grey.std())
    fine = grey - uniform_filter(grey, 3, mode="nearest")
    return Measures(
        holes=float((seen.alpha[road] < SOLID).mean()) if road.any() else 0.0,
        lens=0.0 if lens is None else float((lens > SOLID).mean()),
        contrast=contrast,
        detail=float(fine.std()) / max(contrast, NO_CONTRAST),
    )


def meets_road(rays: Array, eye: Array, world_from_ego: Array) -> Bools:
    """Which rays (H, W, 3) from `eye` (3,) meet the plane of the ego frame's x and y nearer than ROAD_M.

    Where that frame lies at the axle the plane is a wheel's radius above the road: a few rays less are asked for.
    """
    up = world_from_ego[:3, 2]
    rise = rays @ up
    height = float((eye - world_from_ego[:3, 3]) @ up)
    length = np.sqrt((rays * rays).sum(axis=-1))
    return np.asarray((rise < 0.0) & (height * length < -rise * ROAD_M))


def _on_the_lens(scene: Gaussians, eye: Array) -> Gaussians:
    """What is nearer to `eye` than LENS_M or has it inside, magnified around it.

    That gives the same picture but moves nothing in front of the near plane: a wall nearer than that is not drawn, and
    the picture would show what is behind it.
    """
    x, y, z = (scene.means[:, k] - np.float32(eye[k]) for k in range(3))
    widest = np.exp(np.maximum(np.maximum(*scene.log_scales.T[:2]), scene.log_scales[:, 2]))
    distance = np.sqrt(x * x + y * y + z * z)
    chosen = np.flatnonzero(distance < LENS_M + INSIDE_SIGMAS * widest)
    near = scene.take(chosen)
    along = np.einsum("nij,ni->nj", rotations_of(near.quats), near.means - eye) / np.exp(near.log_scales)
    close = near.take((distance[chosen] < LENS_M) | ((along * along).sum(axis=1) < INSIDE_SIGMAS**2))
    means = (eye + MAGNIFIED * (close.means - eye)).astype(np.float32)
    return replace(close, means=means, log_scales=close.log_scales + np.float32(math.log(MAGNIFIED)))


def _tracks_around(eye: Array, there: Vehicles) -> list[str]:
    """Tracks whose box has the eye (3,) inside."""
    local = np.einsum("nij,ni->nj", world_from_boxes(there.boxes)[:, :3, :3], eye - there.boxes[:, :3])
    inside = (np.abs(local) < there.boxes[:, 4:7] / 2.0).all(axis=1)
    return [there.track_ids[j] for j in np.flatnonzero(inside)]
