"""How well a scene shows photos that it was not made of: drawn as pictures at new poses are, and held against them.

The classes are told by geometry alone, so that they are the same pixels whatever a scene makes of them: vehicles are
what looks at a vehicle's box, road what meets the road's surface within ROAD_M, rest is all else.
"""

from collections.abc import Sequence

import numpy as np

from tasks.render.fit.losses import Target, ssim
from tasks.render.fit.lpips import Lpips
from tasks.render.fit.road import Road, above_road
from tasks.render.fit.start import Problem, Shot
from tasks.render.scene.asset import ClassQuality, RenderAsset, ViewQuality, psnr
from tasks.render.scene.engine import Vehicles, render
from tasks.render.scene.movers import behind_boxes, shifted_boxes
from tasks.render.scene.sensed import Photo, shifted
from tasks.render.scene.sky import directions
from tasks.render.scene.stereo import FAR_M
from tasks.world.agents import AgentKind
from tasks.world.arrays import F32, Array, Bools
from tasks.world.camera import Pinhole

ROAD_M = 30.0  # from the camera; farther a pixel is too long a piece of road
NEAREST_M, STEPS = 0.5, 60  # where a ray is followed from, and in how many steps
LEAST_PIXELS = 40  # of a class in a photo, that it is measured
SAME_WAY = 0.87  # cosine: photos that look within 30 degrees of each other


def measured(
    asset: RenderAsset,
    problem: Problem,
    shot: Shot,
    scene_from_camera: Array,
    threads: int = 1,
    lpips: Lpips | None = None,
) -> ViewQuality:
    """Of a photo that was held out, as `asset` shows it from a pose (4, 4) in the problem's frame.

    The camera has the colours that it has at any new pose then, and tracks are where photos say that they were. Pixels
    without weight say nothing; LPIPS, whose layers see far around, is of the whole picture.
    """
    photo, target = shot.photo, shot.compared.target
    picture = drawn(asset, problem, photo, scene_from_camera, threads)
    boxes, valid = boxes_in(asset, problem, photo)
    vehicles = boxes[[j for j in np.flatnonzero(valid) if problem.tracks.kinds[j] == AgentKind.VEHICLE]]
    classes = classes_of(photo, vehicles, problem.road)
    found = [_of_class(name, picture, target, inside) for name, inside in classes.items()]
    counted = target.weight > 0.0
    return ViewQuality(
        photo.camera,
        photo.time_s,
        psnr(picture[counted], target.rgb[counted]) if counted.any() else float("nan"),
        ssim(picture, target)[0],
        held_out=True,
        lpips=float("nan") if lpips is None else lpips(picture, target.rgb),
        away_m=away(photo, [other.photo for other in problem.train]),
        classes=tuple(of for of in found if of is not None),
    )


def drawn(asset: RenderAsset, problem: Problem, photo: Photo, scene_from_camera: Array, threads: int = 1) -> F32:
    """What `asset` shows (H, W, 3) in place of a photo from a pose (4, 4) in the problem's frame: as pictures of
    samples are drawn, in the colours of its camera then, its tracks where photos say that they were."""
    boxes, valid = boxes_in(asset, problem, photo)
    rows = np.flatnonzero(valid)
    there = Vehicles(
        tuple(problem.tracks.ids[j] for j in rows),
        tuple(problem.tracks.kinds[j] for j in rows),
        boxes[rows] + np.concatenate([problem.origin, np.zeros(4)]),
    )
    height, width = photo.rgb.shape[:2]
    eye = Pinhole(photo.intrinsics, shifted(scene_from_camera, problem.origin), width, height)
    affines = [asset.affine_of(photo.camera, photo.time_s)]
    return render(asset, [eye], there, threads=threads, affines=affines)[0].rgb


def boxes_in(asset: RenderAsset, problem: Problem, photo: Photo) -> tuple[Array, Bools]:
    """Boxes (N, 7) of the problem's tracks when a photo was taken, in its frame, and which of them are there (N,)."""
    boxes, valid = problem.tracks.at(photo.taken_s)
    return shifted_boxes(boxes, asset.shifts.at(photo.taken_s, problem.tracks.ids)), valid


def classes_of(photo: Photo, vehicles: Array, road: Road | None) -> dict[str, Bools]:
    """Pixels (H, W) of a photo by class; `vehicles` (N, 7) boxes in its frame."""
    height, width = photo.rgb.shape[:2]
    rays = directions(photo.intrinsics, photo.world_from_camera, width, height).reshape(-1, 3)
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])
    on_vehicle = np.asarray(behind_boxes(eye + FAR_M * rays, eye, np.ascontiguousarray(vehicles)), bool)
    on_road = np.zeros(len(rays), bool) if road is None else meets(road, eye, rays) & ~on_vehicle
    classes = {"road": on_road, "vehicles": on_vehicle, "rest": ~(on_road | on_vehicle)}
    return {name: inside.reshape(height, width) for name, inside in classes.items()}


def meets(road: Road, eye: Array, rays: Array) -> Bools:
    """Which rays (M, 3) from `eye` (3,) go below the known road within ROAD_M, not where it is unknown."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    over, found = np.zeros(len(rays), bool), np.zeros(len(rays), bool)
    for length in np.geomspace(NEAREST_M, ROAD_M, STEPS):
        height = above_road((eye + length * unit).astype(np.float32), road)
        found |= over & (height <= 0.0)
        over = ~found & (height > 0.0)
    return found


def away(photo: Photo, others: Sequence[Photo]) -> float:
    """How far [m] a photo was taken from the nearest of `others` that look the same way; inf where none does."""
    poses = np.stack([other.world_from_camera for other in others])
    same = poses[:, :3, 2] @ photo.world_from_camera[:3, 2] > SAME_WAY
    places = poses[same, :3, 3] - photo.world_from_camera[:3, 3]
    return float(np.linalg.norm(places, axis=1).min(initial=np.inf))


def _of_class(name: str, picture: F32, target: Target, inside: Bools) -> ClassQuality | None:
    counted = inside & (target.weight > 0.0)
    if counted.sum() < LEAST_PIXELS:
        return None
    of = Target(target.rgb, target.mean, target.variance, counted.astype(np.float32))
    return ClassQuality(name, float(counted.mean()), psnr(picture[counted], target.rgb[counted]), ssim(picture, of)[0])
