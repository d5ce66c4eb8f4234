"""PDM's fifteen proposals: IDM at five target speeds along three parallel paths (METRIC.md section 4).

All proposals advance together. What does not depend on them (who stands in a path's corridor when, and how far along
the path) is found once for all 25 forecast samples; each step is then one distance call over (proposal, object) pairs.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.experts.pdm_forecast import SAMPLE_STEPS, STEP_S, Forecast, ego_boxes
from tasks.experts.pdm_path import DrivePath, drive_path, parallel
from tasks.world.frames import box_corners
from tasks.world.vehicle import PACIFICA, VX, Vehicle, X, Y

Array = NDArray[np.float64]
SCORED_STEPS = 40
PROPOSAL_STEPS = 50  # the chosen one is driven on to 5 s


@dataclass(frozen=True)
class PdmSettings:
    """Constants of PDM-Closed as published with NAVSIM (METRIC.md section 4)."""

    speed_fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the lane's speed limit
    lateral_offsets_m: tuple[float, ...] = (0.0, -1.0, 1.0)  # + is to the left
    fallback_speed_mps: float = 15.0  # where the lane has no speed limit
    min_gap_m: float = 1.0
    headway_s: float = 1.5
    accel_max_mps2: float = 1.5
    decel_max_mps2: float = 3.0
    exponent: int = 10
    shared_lead_memory: bool = True  # quirk: within one path, a speed inherits lead fields its own search did not write


DEFAULTS = PdmSettings()


@dataclass(frozen=True)
class Proposals:
    """P = lateral x speed proposals, index = speeds * lateral + speed."""

    poses: Array  # (P, 51, 3) rear axle on the path, world frame
    progress_velocity: Array  # (P, 51, 2) arc length [m], speed [m/s]
    leads: Array  # (P, 51, 3) lead's arc length [m], velocity [m/s], own half length on a free road [m]


@dataclass(frozen=True)
class _Traffic:
    """Objects in the corridor of each path, L paths, S samples, M objects with red lights last."""

    polygons: NDArray[np.object_]  # (S, M)
    in_corridor: NDArray[np.bool_]  # (L, S, M)
    progress: Array  # (L, S, M) arc length of the centroid [m]
    speed: Array  # (M,) [m/s], 0 for standing things
    heading: Array  # (M,)
    is_light: NDArray[np.bool_]  # (M,)


def proposals(
    ego_state: Array,
    centerline: Array,
    seen: Forecast,
    speed_limit_mps: float | None,
    settings: PdmSettings = DEFAULTS,
    vehicle: Vehicle = PACIFICA,
) -> Proposals:
    """The proposals from `ego_state` (11,) along `centerline` (N, 3) through the forecast traffic.

    Each starts at the projection of the rear axle on its path with the ego's longitudinal speed.
    Raises ValueError where the centerline has no length or the speed limit is not positive.
    """
    if speed_limit_mps is not None and not speed_limit_mps > 0.0:
        raise ValueError(f"a speed limit of {speed_limit_mps} m/s cannot be driven; None means unknown")
    paths = [drive_path(parallel(centerline, offset)) for offset in settings.lateral_offsets_m]
    limit = settings.fallback_speed_mps if speed_limit_mps is None else speed_limit_mps
    targets = np.tile(np.array(settings.speed_fractions) * limit, len(paths))
    lateral = np.repeat(np.arange(len(paths)), len(settings.speed_fractions))
    start = np.array([float(path.project(ego_state[[X, Y]])) for path in paths])
    reach_m = abs(targets).max() * PROPOSAL_STEPS * STEP_S
    traffic = _traffic(paths, start, reach_m, seen, vehicle)

    count = len(targets)
    motion = np.zeros((count, PROPOSAL_STEPS + 1, 2))
    leads = np.zeros((count, PROPOSAL_STEPS + 1, 3))
    poses = np.zeros((count, PROPOSAL_STEPS + 1, 3))
    motion[:, 0, 0], motion[:, 0, 1] = start[lateral], ego_state[VX]
    poses[:, 0] = _on_paths(paths, lateral, motion[:, 0, 0])
    for step in range(1, PROPOSAL_STEPS + 1):
        if step % SAMPLE_STEPS == 0:
            memory = settings.shared_lead_memory and step <= SCORED_STEPS  # beyond, the chosen one is driven alone
            before = motion[:, step - 1], poses[:, step - 1]
            found = _leads(paths, lateral, traffic, step // SAMPLE_STEPS, *before, vehicle)
            leads[:, step] = _remembered(found, len(settings.speed_fractions)) if memory else np.nan_to_num(found)
        else:
            leads[:, step] = leads[:, step - 1]  # at step 1 all zeros: every proposal first brakes at its hardest
        motion[:, step] = idm_step(motion[:, step - 1], leads[:, step], targets, settings)
        poses[:, step] = _on_paths(paths, lateral, motion[:, step, 0])
    return Proposals(poses, motion, leads)


def idm_step(motion: Array, leads: Array, target_mps: Array, settings: PdmSettings) -> Array:
    """One Euler step of 0.1 s of the intelligent driver model (Treiber et al. 2000), rows (P, 2) progress, speed.

    s* = gap + v T + v (v - v_lead) / (2 sqrt(a b));  dv/dt = a (1 - (v / v0)^n - (s* / s)^2), clipped to [-b, a].
    The speed is not clipped at 0, as published.
    """
    progress, speed = motion[:, 0], motion[:, 1]
    closing = speed * (speed - leads[:, 1]) / (2.0 * np.sqrt(settings.accel_max_mps2 * settings.decel_max_mps2))
    wanted = settings.min_gap_m + speed * settings.headway_s + closing
    gap = np.maximum(leads[:, 0] - progress - leads[:, 2], settings.min_gap_m)
    accel = settings.accel_max_mps2 * (1.0 - (speed / target_mps) ** settings.exponent - (wanted / gap) ** 2)
    accel = np.clip(accel, -settings.decel_max_mps2, settings.accel_max_mps2)
    return np.stack([progress + STEP_S * speed, speed + STEP_S * accel], axis=-1)


def _on_paths(paths: list[DrivePath], lateral: NDArray[np.intp], progress: Array) -> Array:
    poses = np.empty((len(lateral), 3))
    for index, path in enumerate(paths):
        here = lateral == index
        poses[here] = path.at(progress[here])
    return poses


def _traffic(paths: list[DrivePath], start: Array, reach_m: float, seen: Forecast, vehicle: Vehicle) -> _Traffic:
    samples = PROPOSAL_STEPS // SAMPLE_STEPS + 1
    lights = np.empty((samples, len(seen.red_lights)), dtype=object)
    lights[:] = seen.red_lights
    polygons = np.concatenate([seen.polygons(samples), lights], axis=1)
    ignored = np.concatenate([seen.touches_ego, np.array(seen.red_light_holds_ego, dtype=bool)])
    in_corridor = np.zeros((len(paths), *polygons.shape), dtype=bool)
    progress = np.zeros((len(paths), *polygons.shape))
    centroids = shapely.centroid(polygons)
    for index, path in enumerate(paths):
        corridor = shapely.buffer(
            path.ahead(start[index], start[index] + reach_m), vehicle.half_width, cap_style="square"
        )
        shapely.prepare(corridor)
        in_corridor[index] = shapely.intersects(corridor, polygons) & ~ignored
        inside = in_corridor[index]
        progress[index][inside] = shapely.line_locate_point(path.line, centroids[inside])
    n_lights = len(seen.red_lights)
    return _Traffic(
        polygons=polygons,
        in_corridor=in_corridor,
        progress=progress,
        speed=np.concatenate([seen.speed * seen.is_agent, np.zeros(n_lights)]),
        heading=np.concatenate([seen.boxes[:, 2], np.zeros(n_lights)]),
        is_light=np.concatenate([np.zeros(len(seen.boxes), dtype=bool), np.ones(n_lights, dtype=bool)]),
    )


def _leads(
    paths: list[DrivePath],
    lateral: NDArray[np.intp],
    traffic: _Traffic,
    sample: int,
    motion: Array,
    poses: Array,
    vehicle: Vehicle,
) -> Array:
    """(P, 3) lead of each proposal; NaN marks a field that the search does not write."""
    ahead = traffic.in_corridor[lateral, sample] & (traffic.progress[lateral, sample] > motion[:, :1])
    proposal, thing = np.nonzero(ahead)
    distance = np.full(ahead.shape, np.inf)
    footprints = shapely.polygons(box_corners(ego_boxes(poses, vehicle)))
    distance[proposal, thing] = shapely.distance(footprints[proposal], traffic.polygons[sample, thing])

    found = np.full((len(lateral), 3), np.nan)
    free = ~ahead.any(axis=1)
    found[free, 0] = np.array([path.line.length for path in paths])[lateral[free]]
    found[free, 2] = vehicle.half_length
    if not free.all():
        led = ~free
        nearest = distance[led].argmin(axis=1)
        found[led, 0] = motion[led, 0] + distance[led].min(axis=1)
        relative = traffic.heading[nearest] - poses[led, 2]
        # a red light is a lead whose velocity is never written: 0, or what the slower proposal left there
        found[led, 1] = np.where(traffic.is_light[nearest], np.nan, traffic.speed[nearest] * np.cos(relative))
    return found


def _remembered(found: Array, speeds: int) -> Array:
    """Fills unwritten fields with the last value written by a slower proposal of the same path, else 0."""
    out = found.reshape(-1, speeds, 3).copy()
    last = np.zeros((len(out), 3))
    for index in range(speeds):
        last = np.where(np.isnan(out[:, index]), last, out[:, index])
        out[:, index] = last
    return out.reshape(found.shape)
