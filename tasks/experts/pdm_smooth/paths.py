"""Paths that begin with the ego's own pose and curvature and fade into parallels of the route.

In the frame of the centre line, with arc length s, offset d (+ is left) and angle theta between ego and line, of
curvature kappa_line (Werling et al. 2010, with a line of constant curvature at the start):

    d'  = (1 - kappa_line d) tan(theta)
    d'' = -kappa_line d' tan(theta)
          + (1 - kappa_line d) / cos(theta)^2 (kappa (1 - kappa_line d) / cos(theta) - kappa_line)

and d(s) is the polynomial of fifth degree from (d, d', d'') at the ego to (offset, 0, 0) a merge length ahead.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.experts.pdm_closed.path import DrivePaths
from tasks.world.arrays import Array
from tasks.world.frames import wrap_angle
from tasks.world.vehicle import HEADING, PACIFICA, STEERING, VX, X, Y

SPACING_M = 0.5
LEAST_LINE_M = 2.0  # of route ahead, for a path to have a direction
MOST_TURNED_RAD = 1.2  # from the line, where the ego is turned farther: its tangent would run away
LEAST_STRETCH = 0.2  # of 1 - kappa d: inside a bend's centre the line's frame ends
SIGMAS = 3.0  # of the Gaussian that are summed


@dataclass(frozen=True)
class Line:
    """The centre line ahead of the ego, N points every 0.5 m from the one nearest to it."""

    xy: Array  # (N, 2) [m]
    heading: Array  # (N,) [rad], unwrapped
    curvature: Array  # (N,) [1/m]
    way: Array  # (N,) [m] from the first


def line_ahead(centerline: Array, ego_state: Array, smoothing_m: float) -> Line | None:
    """`centerline` (P, 3) resampled and averaged along itself, from beside the ego on; None: too little is left."""
    xy = centerline[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    moved = np.concatenate([[True], np.diff(way) > 0.0])  # lanes share the point at which they join
    xy, way = xy[moved], way[moved]
    if len(xy) < 2 or way[-1] <= LEAST_LINE_M:
        return None
    at = np.arange(0.0, way[-1], SPACING_M)
    smooth = _averaged(np.stack([np.interp(at, way, column) for column in xy.T], axis=1), smoothing_m / SPACING_M)
    tangent = np.gradient(smooth, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))])
    curvature = np.gradient(heading, along)
    nearest = int(np.argmin(np.hypot(*(smooth - ego_state[[X, Y]]).T)))
    before_it = (smooth[nearest] - ego_state[[X, Y]]) @ [math.cos(heading[nearest]), math.sin(heading[nearest])]
    rest = np.arange(along[nearest] - before_it, along[-1], SPACING_M)  # from the foot of the perpendicular on
    if len(rest) * SPACING_M <= LEAST_LINE_M:
        return None
    x, y, turned, bend = (np.interp(rest, along, values) for values in (*smooth.T, heading, curvature))
    early = np.minimum(rest, 0.0)  # the ego is short of the line's first point: straight on to it
    x, y = x + early * math.cos(heading[0]), y + early * math.sin(heading[0])
    return Line(np.stack([x, y], axis=1), turned, bend, rest - rest[0])


def _averaged(points: Array, sigma: float) -> Array:
    """Points (N, 2) by a Gaussian of `sigma` points; beyond its ends the line goes on as it came, point-mirrored."""
    reach = min(math.ceil(SIGMAS * sigma), len(points) - 1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    before = 2.0 * points[0] - points[reach:0:-1]
    after = 2.0 * points[-1] - points[-2 : -reach - 2 : -1]
    padded = np.concatenate([before, points, after])
    return np.stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in padded.T], axis=1)


def merging_paths(
    line: Line, ego_state: Array, offsets_m: Sequence[float], merges_s: Sequence[float], least_m: float
) -> DrivePaths:
    """A path for each offset and each merge (L = offsets x merges), the merge running fastest."""
    heading0, curvature0 = float(line.heading[0]), float(line.curvature[0])
    across = np.array([-math.sin(heading0), math.cos(heading0)])
    d = float((ego_state[[X, Y]] - line.xy[0]) @ across)
    theta = float(np.clip(wrap_angle(ego_state[HEADING] - heading0), -MOST_TURNED_RAD, MOST_TURNED_RAD))
    curvature = math.tan(ego_state[STEERING]) / PACIFICA.wheel_base
    stretch = max(1.0 - curvature0 * d, LEAST_STRETCH)
    slope = stretch * math.tan(theta)
    bend = -curvature0 * slope * math.tan(theta)
    bend += stretch / math.cos(theta) ** 2 * (curvature * stretch / math.cos(theta) - curvature0)
    rest = float(line.way[-1])
    merges = [min(max(abs(float(ego_state[VX])) * seconds, least_m), rest) for seconds in merges_s]
    laid = [_laid(line, quintic(line.way, (d, slope, bend), offset, m)) for offset in offsets_m for m in merges]
    x, y, heading, progress, inverse = (np.ascontiguousarray(np.stack(column)) for column in zip(*laid))
    return DrivePaths(x, y, heading, progress, inverse)


def quintic(way: Array, start: tuple[float, float, float], end: float, length_m: float) -> Array:
    """(2, N) d and d' at arc lengths `way` (N,): of fifth degree from (d, d', d'') to (end, 0, 0), then constant."""
    s = np.minimum(way / length_m, 1.0)
    d, slope, bend = start[0] - end, start[1] * length_m, start[2] * length_m**2
    a3 = -10.0 * d - 6.0 * slope - 1.5 * bend
    a4 = 15.0 * d + 8.0 * slope + 1.5 * bend
    a5 = -6.0 * d - 3.0 * slope - 0.5 * bend
    value = end + d + s * (slope + s * (0.5 * bend + s * (a3 + s * (a4 + s * a5))))
    rate = (slope + s * (bend + s * (3.0 * a3 + s * (4.0 * a4 + s * 5.0 * a5)))) / length_m
    return np.stack([value, np.where(way < length_m, rate, 0.0)])


def _laid(line: Line, offset: Array) -> tuple[Array, Array, Array, Array, Array]:
    """x, y, heading, progress (N,) and inverse squares (N - 1,) of DrivePaths for offsets and their slopes (2, N)."""
    d, slope = offset
    x = line.xy[:, 0] - np.sin(line.heading) * d
    y = line.xy[:, 1] + np.cos(line.heading) * d
    heading = line.heading + np.arctan2(slope, np.maximum(1.0 - line.curvature * d, LEAST_STRETCH))
    squares = np.diff(x) ** 2 + np.diff(y) ** 2
    progress = np.concatenate([[0.0], np.cumsum(np.sqrt(squares))])
    return x, y, heading, progress, 1.0 / np.maximum(squares, 1e-12)


def bend_speeds(paths: DrivePaths, lateral_accel_max_mps2: float, decel_mps2: float) -> Array:
    """(L, P) [m/s] at which each path can be driven: v^2 kappa within the bound, and slowed down to before bends."""
    turns = np.abs(np.gradient(paths.heading, axis=1)) / np.maximum(np.gradient(paths.progress, axis=1), 1e-6)
    squares = lateral_accel_max_mps2 / np.maximum(turns, 1e-6)
    steps = 2.0 * decel_mps2 * np.diff(paths.progress, axis=1)
    for k in range(squares.shape[1] - 2, -1, -1):
        squares[:, k] = np.minimum(squares[:, k], squares[:, k + 1] + steps[:, k])
    return np.sqrt(squares)
