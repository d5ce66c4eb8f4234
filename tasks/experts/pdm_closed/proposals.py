"""PDM's fifteen proposals: IDM at five target speeds along three parallel paths (docs/reward.md 4). Compiled.

What does not depend on them (who stands in a path's corridor when, and how far along the path) is found once for all
forecast samples; then each proposal is driven in steps of 0.1 s, a path's speeds side by side from slow to fast.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tasks.experts.pdm_closed.corridor import corridors, lead_progress
from tasks.experts.pdm_closed.forecast import SAMPLE_STEPS, STEP_S, Forecast, Things
from tasks.experts.pdm_closed.path import DrivePaths, drive_paths, pose_at, project
from tasks.experts.pdm_closed.settings import DEFAULTS, PdmSettings
from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array
from tasks.world.geometry import rings_distance
from tasks.world.vehicle import PACIFICA, VX, X, Y

SCORED_STEPS = 40
PROPOSAL_STEPS = 50  # the chosen one is driven on to 5 s
SAMPLES = PROPOSAL_STEPS // SAMPLE_STEPS + 1
REAR_AXLE_TO_CENTER, HALF_LENGTH, HALF_WIDTH = PACIFICA.rear_axle_to_center, PACIFICA.half_length, PACIFICA.half_width


@dataclass(frozen=True)
class Proposals:
    """P = lateral x speed proposals, index = speeds * lateral + speed."""

    poses: Array  # (P, 51, 3) rear axle on the path, world frame
    progress_velocity: Array  # (P, 51, 2) arc length [m], speed [m/s]
    leads: Array  # (P, 51, 3) lead's arc length [m], velocity [m/s], own half length on a free road [m]


class PdmDriver(NamedTuple):
    """The intelligent driver model's constants, and the faults it keeps (tasks.experts.pdm_closed.settings)."""

    min_gap_m: float
    headway_s: float
    accel_max_mps2: float
    decel_max_mps2: float
    exponent: float
    shared_lead_memory: bool
    brakes_at_first_step: bool
    speed_below_zero: bool


def proposals(
    ego_state: Array, centerline: Array, seen: Forecast, speed_limit_mps: float | None, settings: PdmSettings = DEFAULTS
) -> Proposals:
    """The proposals from `ego_state` (11,) along `centerline` (N, 3) through the forecast traffic.

    Each starts at the projection of the rear axle on its path with the ego's longitudinal speed.
    Raises ValueError where the centerline is misshapen, not finite or without length, or the speed limit not positive.
    """
    if speed_limit_mps is not None and not 0.0 < speed_limit_mps < math.inf:
        raise ValueError(
            f"speed_limit_mps: {speed_limit_mps} m/s cannot be driven; it must be positive and finite, None is unknown"
        )
    paths = drive_paths(centerline, settings.lateral_offsets_m)
    limit = settings.fallback_speed_mps if speed_limit_mps is None else speed_limit_mps
    targets = np.array(settings.speed_fractions) * limit
    start = np.array([project(paths, i, ego_state[X], ego_state[Y]) for i in range(len(settings.lateral_offsets_m))])
    things = seen.things(SAMPLES)
    swept = corridors(paths, start, targets.max() * PROPOSAL_STEPS * STEP_S, HALF_WIDTH)
    progress = lead_progress(paths, swept, things)
    return Proposals(*_drive(paths, things, progress, start, ego_state[VX], targets, driver(settings)))


def driver(settings: PdmSettings) -> PdmDriver:
    """The settings that each step needs."""
    each = {name: getattr(settings, name) for name in PdmDriver._fields}
    return PdmDriver(**(each | {"exponent": float(settings.exponent)}))


@kernel
def idm_step(progress: float, speed: float, lead: Array, target_mps: float, idm: PdmDriver) -> tuple[float, float]:
    """One Euler step of 0.1 s of the intelligent driver model (Treiber et al. 2000): progress [m], speed [m/s].

    s* = gap + v T + v (v - v_lead) / (2 sqrt(a b));  dv/dt = a (1 - (v / v0)^n - (s* / s)^2), clipped to [-b, a].
    lead: (3,) its arc length [m], velocity [m/s], and what is kept off the gap to it [m].
    """
    closing = speed * (speed - lead[1]) / (2.0 * math.sqrt(idm.accel_max_mps2 * idm.decel_max_mps2))
    wanted = idm.min_gap_m + speed * idm.headway_s + closing
    gap = max(lead[0] - progress - lead[2], idm.min_gap_m)
    accel = idm.accel_max_mps2 * (1.0 - (speed / target_mps) ** idm.exponent - (wanted / gap) ** 2)
    after = speed + STEP_S * min(max(accel, -idm.decel_max_mps2), idm.accel_max_mps2)
    return progress + STEP_S * speed, after if idm.speed_below_zero else max(after, 0.0)


@kernel
def _drive(
    paths: DrivePaths,
    things: Things,
    lead_progress_m: Array,
    start_m: Array,
    speed0_mps: float,
    targets_mps: Array,
    idm: PdmDriver,
) -> tuple[Array, Array, Array]:
    """poses (P, 51, 3), motion (P, 51, 2) and leads (P, 51, 3) of Proposals. lead_progress_m: (L, S, M)."""
    n_paths, n_speeds = start_m.shape[0], targets_mps.shape[0]
    poses = np.empty((n_paths * n_speeds, PROPOSAL_STEPS + 1, 3))
    motion = np.empty((n_paths * n_speeds, PROPOSAL_STEPS + 1, 2))
    leads = np.zeros((n_paths * n_speeds, PROPOSAL_STEPS + 1, 3))
    footprint = np.empty((2, 4))
    for path in range(n_paths):
        first = path * n_speeds
        for p in range(first, first + n_speeds):
            motion[p, 0, 0], motion[p, 0, 1] = start_m[path], speed0_mps
            poses[p, 0, 0], poses[p, 0, 1], poses[p, 0, 2] = pose_at(paths, path, start_m[path])
        for step in range(1, PROPOSAL_STEPS + 1):
            looks = step % SAMPLE_STEPS == 0 or (step == 1 and not idm.brakes_at_first_step)
            shared = idm.shared_lead_memory and step <= SCORED_STEPS  # beyond, the chosen one is driven alone
            written = np.zeros(3)
            for p in range(first, first + n_speeds):
                progress, speed = motion[p, step - 1, 0], motion[p, step - 1, 1]
                if looks:
                    if not shared:
                        written[:] = 0.0
                    set_footprint(poses[p, step - 1], footprint)
                    sample = step // SAMPLE_STEPS
                    nearest = nearest_ahead(things, lead_progress_m[path, sample], sample, progress, footprint)
                    write_lead(paths, path, things, nearest, progress, poses[p, step - 1, 2], written)
                for k in range(3):  # before the first search all zeros: no gap, so it brakes hard
                    leads[p, step, k] = written[k] if looks else leads[p, step - 1, k]
                after = idm_step(progress, speed, leads[p, step], targets_mps[p - first], idm)
                motion[p, step, 0], motion[p, step, 1] = after
                poses[p, step, 0], poses[p, step, 1], poses[p, step, 2] = pose_at(paths, path, after[0])
    return poses, motion, leads


@kernel
def write_lead(
    paths: DrivePaths,
    path: int,
    things: Things,
    nearest: tuple[float, int],
    progress: float,
    heading: float,
    lead: Array,
) -> None:
    """Write into `lead` (3,) what a search found: arc length, velocity, own half length on a free road.

    A free road leaves the velocity as it was, a thing the half length, a red light both: what was there is the memory.
    """
    distance, thing = nearest
    if thing < 0:
        lead[0], lead[2] = paths.progress[path, -1], HALF_LENGTH
        return
    lead[0] = progress + distance
    if not things.is_light[thing]:
        lead[1] = things.speed[thing] * math.cos(things.heading[thing] - heading)


@kernel
def nearest_ahead(things: Things, ahead_m: Array, sample: int, progress: float, footprint: Array) -> tuple[float, int]:
    """Distance [m] from the footprint (2, 4) to the nearest thing farther along than `progress`, and which; -1: none.

    ahead_m: (M,) arc length of each thing in the corridor, NaN for those that are not in it.
    """
    nearest, found = np.inf, -1
    x, y = 0.5 * (footprint[0, 0] + footprint[0, 2]), 0.5 * (footprint[1, 0] + footprint[1, 2])
    own_radius = math.hypot(footprint[0, 0] - x, footprint[1, 0] - y)
    for m in range(ahead_m.shape[0]):
        if ahead_m[m] > progress:
            between = math.hypot(things.center_x[sample, m] - x, things.center_y[sample, m] - y)
            if between - things.radius[m] - own_radius <= nearest:
                of_ring = slice(things.first[m], things.first[m + 1])
                ring_x, ring_y = things.x[sample, of_ring], things.y[sample, of_ring]
                distance = rings_distance(footprint[0], footprint[1], ring_x, ring_y)
                if distance < nearest:
                    nearest, found = distance, m
    return nearest, found


@kernel
def set_footprint(pose: Array, out: Array) -> None:
    """Corners (2, 4) x, y of the ego's body, its rear axle at `pose` (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + REAR_AXLE_TO_CENTER * c, pose[1] + REAR_AXLE_TO_CENTER * s
    for i in range(4):
        along = HALF_LENGTH if i == 0 or i == 3 else -HALF_LENGTH
        across = HALF_WIDTH if i < 2 else -HALF_WIDTH
        out[0, i] = x + c * along - s * across
        out[1, i] = y + s * along + c * across
