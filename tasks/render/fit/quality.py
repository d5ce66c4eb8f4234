"""How well a scene shows photos that it was not made of: drawn as pictures at new poses are, and held against them.

The classes are told by geometry alone, so that they are the same pixels whatever a scene makes of them: vehicles are
what looks at a vehicle's box, road what meets the road's surface within ROAD_M, rest is all else.
"""

from collections.abc import Sequence

import numpy as np

from tasks.render.fit.losses import Target, ssim
from tasks.render.fit.road import Road, above_road
from tasks.render.fit.start import Problem, Shot
from tasks.render.scene.asset import ClassQuality, RenderAsset, ViewQuality, psnr
from tasks.render.scene.engine import Vehicles, render
from tasks.render.scene.movers import behind_boxes
from tasks.render.scene.sensed import Photo, shifted
from tasks.render.scene.sky import directions
from tasks.render.scene.stereo import FAR_M
from tasks.world.agents import AgentKind
from tasks.world.arrays import F32, Array, Bools
from tasks.world.camera import Pinhole

ROAD_M = 30.0  # from the camera; farther a pixel is too long a piece of road
ON_ROAD_M = 0.05  # above or below the surface
STEPS = 6  # of following a ray down to it
LEAST_PIXELS = 40  # of a class in a photo, that it is measured
SAME_WAY = 0.87  # cosine: photos that look within 30 degrees of each other


def measured(
    asset: RenderAsset, problem: Problem, shot: Shot, scene_from_camera: Array, threads: int = 1
) -> ViewQuality:
    """Of a photo that was held out, as `asset` shows it from a pose (4, 4) in the problem's frame.

    The camera has the colours that it has at any new pose, and tracks are where they were. Pixels without weight say
    nothing.
    """
    photo, target = shot.photo, shot.target
    height, width = target.weight.shape
    boxes, valid = problem.tracks.at(photo.time_s)
    rows = np.flatnonzero(valid)
    there = Vehicles(
        tuple(problem.tracks.ids[j] for j in rows),
        tuple(problem.tracks.kinds[j] for j in rows),
        boxes[rows] + np.concatenate([problem.origin, np.zeros(4)]),
    )
    eye = Pinhole(photo.intrinsics, shifted(scene_from_camera, problem.origin), width, height)
    affines = [asset.affine_of(photo.camera)]
    picture = render(asset, [eye], there, threads=threads, affines=affines)[0].rgb
    vehicles = boxes[[j for j in rows if problem.tracks.kinds[j] == AgentKind.VEHICLE]]
    classes = classes_of(photo, vehicles, problem.road)
    found = [_of_class(name, picture, target, inside) for name, inside in classes.items()]
    counted = target.weight > 0.0
    return ViewQuality(
        photo.camera,
        photo.time_s,
        psnr(picture[counted], target.rgb[counted]) if counted.any() else float("nan"),
        ssim(picture, target)[0],
        held_out=True,
        away_m=away(photo, [other.photo for other in problem.train]),
        classes=tuple(of for of in found if of is not None),
    )


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
    """Which rays (M, 3) from `eye` (3,) meet the known road within ROAD_M: Newton's method from a level road below."""
    steep = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        length = np.where(steep > 0.0, above_road(eye[None], road)[0] / steep, np.nan)
        for _ in range(STEPS):
            length = length + above_road(eye + length[:, None] * unit, road) / steep
        height = above_road(eye + length[:, None] * unit, road)
        return np.asarray((length > 0.0) & (length < ROAD_M) & (np.abs(height) < ON_ROAD_M))


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
