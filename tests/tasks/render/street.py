"""A street whose true pictures are known in closed form: textured ground, a facade on each side, a car that drives."""

import numpy as np
from numpy.typing import NDArray

from tasks.render.fit.backend import compose_scene, draw_with_sky
from tasks.render.fit.corrections import apply_exposure, corrected_pose
from tasks.render.fit.reconstruct import interpolated_corrections, learned_box_shifts
from tasks.render.fit.start import FitProblem
from tasks.render.fit.state import FitState
from tasks.render.scene.sensed import Photo, Sweep
from tasks.world.arrays import F32
from tasks.world.clip import AgentKind, AgentTracks

WIDTH, HEIGHT = 128, 72
INTRINSICS = np.array([[100.0, 0.0, 64.0], [0.0, 100.0, 36.0], [0.0, 0.0, 1.0]])
WALL_Y, WALL_TOP = 7.0, 9.0
CAR = np.array([4.4, 1.9, 1.6])  # length, width, height
EGO_FROM_CAMERA = np.array([[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
SKY = np.array([0.55, 0.7, 0.95])
Array = NDArray[np.float64]


def ego_pose(x: float, y: float = 0.0) -> Array:
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def car_box(time_s: float) -> Array:
    """(7,) x, y, z, heading, length, width, height."""
    return np.array([9.0 + 8.0 * time_s, 2.5, CAR[2] / 2, 0.0, *CAR])


def tracks() -> AgentTracks:
    boxes = np.stack([[car_box(0.1 * k)[[0, 1, 3, 4, 5]]] for k in range(96)])
    return AgentTracks(
        ("car",),
        (AgentKind.VEHICLE,),
        boxes,
        np.tile([[8.0, 0.0]], (96, 1, 1)),
        np.ones((96, 1), bool),
        np.full((96, 1), CAR[2] / 2),
        CAR[2:],
    )


def hit(origins: Array, rays: Array, car: Array | None) -> tuple[Array, Array, Array]:
    """Nearest surface along rays (M, 3): distance in units of the ray (inf: sky), point and colour."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.full(len(rays), np.inf)
        colour = np.tile(SKY, (len(rays), 1))
        ground = np.where(rays[:, 2] < 0, -origins[2] / rays[:, 2], np.inf)
        point = origins + np.where(np.isfinite(ground), ground, 0.0)[:, None] * rays
        stripe = 0.35 + 0.1 * np.sin(1.3 * point[:, 0]) + 0.45 * (np.abs(np.abs(point[:, 1]) - 3.0) < 0.25)
        colour = np.where((ground < best)[:, None], stripe[:, None] * np.array([1.0, 0.98, 0.95]), colour)
        best = np.minimum(best, ground)
        for side in (-1.0, 1.0):
            t = side * WALL_Y / rays[:, 1] - origins[1] / rays[:, 1]
            point = origins + np.where(np.isfinite(t), t, 0.0)[:, None] * rays
            on = (t > 0) & (t < best) & (point[:, 2] > 0) & (point[:, 2] < WALL_TOP)
            shade = 0.4 + 0.2 * np.sin(1.1 * point[:, 0] + side) * np.sin(1.4 * point[:, 2])
            colour = np.where(on[:, None], shade[:, None] * np.array([1.2, 0.8, 0.6]), colour)
            best = np.where(on, t, best)
        if car is not None:
            low, high = car[:3] - CAR / 2, car[:3] + CAR / 2
            t1, t2 = (low - origins) / rays, (high - origins) / rays
            enter, leave = np.minimum(t1, t2).max(axis=1), np.maximum(t1, t2).min(axis=1)
            on = (enter > 0) & (enter < leave) & (enter < best)
            colour = np.where(on[:, None], np.array([0.8, 0.1, 0.15]), colour)
            best = np.where(on, enter, best)
    return best, origins + np.where(np.isfinite(best), best, 0.0)[:, None] * rays, colour


def photo(x: float, y: float, time_s: float, with_car: bool = True) -> Photo:
    pose = ego_pose(x, y) @ EGO_FROM_CAMERA
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - 64.0) / 100.0, (v - 36.0) / 100.0, np.ones_like(u)], -1).reshape(-1, 3) @ pose[:3, :3].T
    _, _, colour = hit(pose[:3, 3], rays, car_box(time_s) if with_car else None)
    rgb = np.rint(255 * colour.reshape(HEIGHT, WIDTH, 3)).astype(np.uint8)
    return Photo("front", time_s, rgb, INTRINSICS, pose)


def sweep(x: float, time_s: float, with_car: bool = True) -> Sweep:
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180, 0.5)), np.radians(np.linspace(-25, 12, 40)))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    origin = np.array([x, 0.0, 1.8])
    distance, point, _ = hit(origin, rays, car_box(time_s) if with_car else None)
    points = (point - [x, 0.0, 0.0])[np.isfinite(distance) & (distance < 60.0)]
    return Sweep(time_s, points.astype(np.float32), ego_pose(x))


def drive(n: int = 8, with_car: bool = True) -> tuple[list[Photo], list[Sweep]]:
    """One photo every 0.25 s and two sweeps for each, at 4 m/s."""
    photos = [photo(1.0 * k, 0.0, 0.25 * k, with_car) for k in range(n)]
    sweeps = [sweep(0.5 * k, 0.125 * k, with_car) for k in range(2 * n)]
    return photos, sweeps


def picture_of(problem: FitProblem, state: FitState, photo: Photo) -> F32:
    """What the fit itself makes of a photo of the block (pose local), by the corrections of its camera's neighbours."""
    row_pose, row_colour = interpolated_corrections(problem, state, photo.camera, photo.time_s)
    scene, _ = compose_scene(problem, state, learned_box_shifts(problem, state), photo)
    seen, _ = draw_with_sky(state, scene, photo, corrected_pose(photo.world_from_camera, row_pose), 1)
    return np.clip(apply_exposure(seen.view.rgb, row_colour), 0.0, 1.0)
