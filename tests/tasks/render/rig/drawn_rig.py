"""A rig whose corners are known in closed form: points of a street, each with a descriptor of its own.

Four cameras with a lens, 12 instants at 2 Hz along a bend driven faster and faster, poses and calibration as given.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tasks.render.rig.adjust import Rig, initial_rig, motions_of_twists, reprojection_residuals
from tasks.render.rig.correct import UNIT, PhotoCorners
from tasks.world.clip import Camera, SensorFile

Array = NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 960, 540, 700.0
YAWS_DEG = {"front": 0.0, "left": 60.0, "back": 180.0, "right": -60.0}
LENS = np.array([-0.2, 0.08, 0.001, -0.0005, -0.01])
INSTANTS, NOISE_PX, POINTS = 12, 0.3, 2000


def mount(yaw_deg: float) -> Array:
    """ego_from_camera (4, 4)."""
    yaw = np.radians(yaw_deg)
    forward, down = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([0.0, 0.0, -1.0])
    out = np.eye(4)
    out[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    out[:3, 3] = [1.0 + 0.7 * np.cos(yaw), 0.7 * np.sin(yaw), 1.5]
    return out


def cameras() -> list[Camera]:
    """As they are."""
    k = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return [Camera(name, WIDTH, HEIGHT, k, LENS, mount(yaw)) for name, yaw in YAWS_DEG.items()]


def ego_pose(time_s: float) -> Array:
    """(4, 4) on the bend; the ego accelerates from 4 m/s by 1 m/s2 and turns the more, the longer it drives."""
    times = np.linspace(0.0, time_s, 200)
    heading = 0.02 * times**2
    speed = 4.0 + times
    step = np.diff(times, prepend=0.0)
    along, across = np.sum(speed * np.cos(heading) * step), np.sum(speed * np.sin(heading) * step)
    return np.asarray(motions_of_twists(np.array([[along, across, 0, 0, 0, heading[-1]]]))[0])


def straight_on(time_s: float, speed_mps: float = 8.0) -> Array:
    """(4, 4) along the street at one speed, where a delay is no other than a shifted mount."""
    return np.asarray(motions_of_twists(np.array([[speed_mps * time_s, 0.0, 0.0, 0.0, 0.0, 0.0]]))[0])


def files(names: list[str], drive: Callable[[float], Array] = ego_pose, apart_s: float = 0.5) -> list[SensorFile]:
    """A photo of each camera at each instant."""
    times = [apart_s * k for k in range(INSTANTS)]
    return [SensorFile(name, f"{name}/{k}.jpg", t, drive(t)) for k, t in enumerate(times) for name in names]


def street_points(rng: np.random.Generator) -> Array:
    """(POINTS, 3) on both sides of the street."""
    along, side = rng.uniform(-30.0, 70.0, POINTS), rng.choice([-1.0, 1.0], POINTS) * rng.uniform(4.0, 16.0, POINTS)
    return np.column_stack([along, side + 0.004 * along**2, rng.uniform(-0.2, 7.0, POINTS)])


def corners_seen(
    rig: list[Camera],
    taken: list[SensorFile],
    seed: int = 0,
    drive: Callable[[float], Array] = ego_pose,
) -> list[PhotoCorners]:
    """Of each file what its camera saw: points on both sides of the street, with noise.

    A camera that reads row by row sees each point from where it was as it read the point's row.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed, 7]))
    points = street_points(rng)
    looks = rng.normal(size=(POINTS, 128)) ** 2
    looks = np.rint(UNIT * np.sqrt(looks / looks.sum(axis=1, keepdims=True))).astype(np.float32)
    row = {camera.name: k for k, camera in enumerate(rig)}
    late = [replace(file, world_from_ego=drive(file.time_s)) for file in taken]
    known, shots = initial_rig(rig, late)
    out = []
    for i, file in enumerate(taken):
        at = _off(known, points, row[file.sensor], shots.world_from_ego[i])
        if readout_s := rig[row[file.sensor]].readout_s:
            look = partial(_seen_at, known, points, row[file.sensor], drive, file.time_s)
            at = by_rows(look, readout_s)
        pose = shots.world_from_ego[i] @ rig[row[file.sensor]].ego_from_camera
        ahead = (points - pose[:3, 3]) @ pose[:3, 2]
        seen = (ahead > 2.0) & (ahead < 40.0) & (at > 0.0).all(axis=1) & (at < [WIDTH, HEIGHT]).all(axis=1)
        x, y = (((points - pose[:3, 3]) @ pose[:3, k])[seen] / ahead[seen] for k in range(2))
        rows = np.flatnonzero(seen)[np.hypot(x, y) < 1.0]  # beyond, the lens folds
        noise = rng.normal(size=(len(rows), 2)) * NOISE_PX
        out.append(PhotoCorners(at[rows] + noise, looks[rows], 1.0))
    return out


def by_rows(look: Callable[[float], Array], readout_s: float) -> Array:
    """(M, 2) pixels of points, each as it is seen while its row is read; look(t): (M, 2) as all are t after the middle.

    Between 33 instants pixels are linear in time.
    """
    times = np.linspace(-abs(readout_s), abs(readout_s), 33)
    seen = np.nan_to_num(np.stack([look(time_s) for time_s in times]), posinf=1e6)
    each, at = np.arange(seen.shape[1]), seen[16]
    for _ in range(8):  # the row says when, and when says the row
        now = np.interp(readout_s * (at[:, 1] / HEIGHT - 0.5), times, np.arange(len(times)))
        k = np.minimum(now.astype(int), len(times) - 2)
        share = (now - k)[:, None]
        at = (1.0 - share) * seen[k, each] + share * seen[k + 1, each]
    return at


def _seen_at(
    rig: Rig, points: Array, camera: int, drive: Callable[[float], Array], middle_s: float, after_s: float
) -> Array:
    return _off(rig, points, camera, drive(middle_s + after_s))


def _off(rig: Rig, points: Array, camera: int, world_from_ego: Array) -> Array:
    """(M, 2) pixels of the points."""
    n = len(points)
    views, at = np.zeros(n, np.int64), np.zeros((n, 2))
    poses = np.linalg.inv(world_from_ego)[None], np.linalg.inv(rig.ego_from_camera)
    return np.asarray(reprojection_residuals(points, np.arange(n), views, at, np.array([camera]), *poses, rig.lenses))
