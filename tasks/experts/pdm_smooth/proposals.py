"""Jerk-limited IDM along each path at each target speed, from the ego's speed and acceleration. Compiled."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tasks.experts.pdm_closed.corridor import corridors, lead_progress
from tasks.experts.pdm_closed.forecast import SAMPLE_STEPS, STEP_S, Forecast, Things
from tasks.experts.pdm_closed.path import DrivePaths, pose_at
from tasks.experts.pdm_closed.proposals import HALF_WIDTH, nearest_ahead, set_footprint, write_lead
from tasks.experts.pdm_smooth.paths import Line, bend_speeds, merging_paths
from tasks.experts.pdm_smooth.settings import SmoothSettings
from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS
from tasks.world.vehicle import AX, VX

SAMPLES = HORIZON_STEPS // SAMPLE_STEPS + 1


@dataclass(frozen=True)
class SmoothProposals:
    """P = paths x speeds, index = speeds * path + speed."""

    poses: Array  # (P, 41, 3) rear axle, world frame; the first is the ego's own
    motion: Array  # (P, 41, 3) arc length [m], speed [m/s], acceleration [m/s2]


class SmoothDriver(NamedTuple):
    """What each step needs of the settings."""

    min_gap_m: float
    headway_s: float
    accel_max_mps2: float
    decel_comfort_mps2: float
    decel_max_mps2: float
    exponent: float
    response_s: float
    jerk_max_mps3: float


def smooth_proposals(
    ego_state: Array, line: Line, seen: Forecast, limit_mps: float, settings: SmoothSettings
) -> SmoothProposals:
    """The proposals from `ego_state` (11,) along the route through the forecast traffic."""
    paths = merging_paths(line, ego_state, settings.lateral_offsets_m, settings.merge_s, settings.merge_least_m)
    bends = bend_speeds(paths, settings.lateral_accel_max_mps2, settings.bend_decel_mps2)
    targets = np.array(settings.speed_fractions) * limit_mps
    things = seen.things(SAMPLES)
    reach_m = max(float(targets.max()), float(ego_state[VX])) * HORIZON_STEPS * STEP_S
    swept = corridors(paths, np.zeros(len(paths.x)), reach_m, HALF_WIDTH)
    driver = SmoothDriver(*(getattr(settings, name) for name in SmoothDriver._fields))
    start = np.array([max(ego_state[VX], 0.0), ego_state[AX]])
    return SmoothProposals(*_drive(paths, bends, things, lead_progress(paths, swept, things), start, targets, driver))


@kernel
def wanted_accel(speed: float, gap_m: float, lead_mps: float, target_mps: float, idm: SmoothDriver) -> float:
    """Acceleration [m/s2] of the intelligent driver model, with its improved free-road term (Treiber, Kesting 2013).

    free = a (1 - (v / v0)^n) up to v0, -b (1 - (v0 / v)^(a n / b)) above it; s* = gap + v T + v dv / (2 sqrt(a b));
    wanted = free - a (s* / s)^2, within -decel_max .. a.
    """
    a, b = idm.accel_max_mps2, idm.decel_comfort_mps2
    if speed <= target_mps:
        free = a * (1.0 - (speed / target_mps) ** idm.exponent)
    else:
        free = -b * (1.0 - (target_mps / speed) ** (a * idm.exponent / b))
    closing = speed * (speed - lead_mps) / (2.0 * math.sqrt(a * idm.decel_max_mps2))
    wanted_gap = max(idm.min_gap_m + speed * idm.headway_s + closing, 0.0)
    wanted = free - a * (wanted_gap / max(gap_m, idm.min_gap_m)) ** 2
    return min(max(wanted, -idm.decel_max_mps2), a)


@kernel
def smooth_step(speed: float, accel: float, wanted: float, idm: SmoothDriver) -> tuple[float, float, float]:
    """Way [m], speed [m/s] and acceleration [m/s2] after 0.1 s: a' = (wanted - a) / response, its size bounded.

    Where it would roll back it stands.
    """
    jerk = min(max((wanted - accel) / idm.response_s, -idm.jerk_max_mps3), idm.jerk_max_mps3)
    after = accel + STEP_S * jerk
    faster = speed + STEP_S * 0.5 * (accel + after)
    if faster <= 0.0:
        return STEP_S * 0.5 * speed, 0.0, max(after, 0.0)
    return STEP_S * 0.5 * (speed + faster), faster, after


@kernel
def _drive(
    paths: DrivePaths,
    bends_mps: Array,  # (L, P)
    things: Things,
    lead_progress_m: Array,  # (L, S, M)
    start: Array,  # (2,) speed, acceleration
    targets_mps: Array,
    idm: SmoothDriver,
) -> tuple[Array, Array]:
    """poses (P, 41, 3) and motion (P, 41, 3) of SmoothProposals."""
    n_paths, n_speeds = paths.x.shape[0], targets_mps.shape[0]
    poses = np.empty((n_paths * n_speeds, HORIZON_STEPS + 1, 3))
    motion = np.empty((n_paths * n_speeds, HORIZON_STEPS + 1, 3))
    footprint, lead = np.empty((2, 4)), np.empty(3)
    for p in range(n_paths * n_speeds):
        path, target = p // n_speeds, targets_mps[p % n_speeds]
        way, speed, accel = 0.0, start[0], start[1]
        _write(paths, path, way, speed, accel, poses[p, 0], motion[p, 0])
        for step in range(1, HORIZON_STEPS + 1):
            sample = step // SAMPLE_STEPS
            set_footprint(poses[p, step - 1], footprint)
            nearest = nearest_ahead(things, lead_progress_m[path, sample], sample, way, footprint)
            lead[:] = 0.0
            write_lead(paths, path, things, nearest, way, poses[p, step - 1, 2], lead)
            seen_m = way + speed * idm.response_s  # where acceleration will have followed
            k = min(np.searchsorted(paths.progress[path], seen_m), bends_mps.shape[1] - 1)
            aimed = min(target, bends_mps[path, k])
            wanted = wanted_accel(speed, lead[0] - way - lead[2], lead[1], aimed, idm)
            moved, speed, accel = smooth_step(speed, accel, wanted, idm)
            way += moved
            _write(paths, path, way, speed, accel, poses[p, step], motion[p, step])
    return poses, motion


@kernel
def _write(paths: DrivePaths, path: int, way: float, speed: float, accel: float, pose: Array, motion: Array) -> None:
    pose[0], pose[1], pose[2] = pose_at(paths, path, way)
    motion[0], motion[1], motion[2] = way, speed, accel
