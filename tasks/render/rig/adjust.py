"""Rig and points moved until the matched corners fall where they were seen (bundle adjustment, Triggs et al. 2000).

Cauchy's loss, whose width shrinks from round to round: what is far off at first, because the calibration is, counts
then, and what stays far off does not count in the end. Levenberg-Marquardt with the points eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.render.rig.normal import MOUNT, N_CAMERA, N_CORNER, normal_equations, residuals, solved
from tasks.render.rig.rig import Rig, Shots
from tasks.world.arrays import Array, Bools, Ints

WIDTHS_PX = (16.0, 8.0, 4.0, 2.0, 1.0)  # of the loss, in pixels of the pictures that corners were looked for in
OUT = 4.0  # times the width: a corner further off is left out of the round
STEPS = 12  # a round, at most
DAMPING = (1e-4, 1e-9, 1e8)  # first, least, most
SETTLED = 1e-4  # share of the cost by which a step must lower it to be followed by another
NO_MORE = 1e6  # square of an offset in widths: a point that a step puts behind a camera must not stop the others
LEAST_PARALLAX_DEG = 0.5
FARTHEST_M = 300.0


@dataclass(frozen=True)
class Matched:
    """Corners that show one point each, ordered by point."""

    starts: Ints  # (P + 1,) rows of the corners of point p: starts[p] to starts[p + 1]
    view_of: Ints  # (N,) row of the photo
    at: Array  # (N, 2) pixels of the photo as taken
    pixel: Array  # (N,) pixels of the photo per pixel of the picture that corners were looked for in
    after_s: Array | None = None  # (N,) how long after the middle row of its photo a corner was read; None: all at once

    @property
    def point_of(self) -> Ints:
        """(N,)"""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


@dataclass(frozen=True)
class Bundle:
    """A rig and its points, and which corners agree with them."""

    rig: Rig
    points: Array  # (P, 3)
    used: Bools  # (N,)


def adjusted(
    rig: Rig,
    shots: Shots,
    matched: Matched,
    sigmas: Array,
    start: Rig | None = None,
    widths: Sequence[float] = WIDTHS_PX,
) -> Bundle:
    """The rig that explains the corners best without leaving the given one by many `sigmas` (n,); 0 holds.

    `start`: where to begin, by default at the given one.
    """
    now, points = start or rig, np.zeros((len(matched.starts) - 1, 3))
    for width in widths:
        points, there = triangulated(now, shots, matched)
        off = offsets(now, shots, matched, points)
        used = with_company((off < OUT * width) & there[matched.point_of], matched)
        now, points = _settled(rig, now, shots, matched, points, used, width, sigmas)
    points, there = triangulated(now, shots, matched)
    last = offsets(now, shots, matched, points)
    return Bundle(now, points, with_company((last < OUT * WIDTHS_PX[-1]) & there[matched.point_of], matched))


def without(matched: Matched, views: Array) -> Matched:
    """Without the corners of some photos, and without points that then have fewer than two."""
    return part_of(matched, ~np.isin(matched.view_of, views))


def part_of(matched: Matched, keep: Bools) -> Matched:
    """The corners (N,) to keep, but for those whose point then has fewer than two."""
    count = np.bincount(matched.point_of, keep, len(matched.starts) - 1)
    keep = keep & (count >= 2)[matched.point_of]
    ends = np.cumsum(count[count >= 2]).astype(np.int64)
    after_s = None if matched.after_s is None else matched.after_s[keep]
    return Matched(np.concatenate([[0], ends]), matched.view_of[keep], matched.at[keep], matched.pixel[keep], after_s)


def read_after_s(matched: Matched, shots: Shots, readouts_s: Array, heights: Array) -> Array | None:
    """(N,) how long after the middle row of its photo each corner was read; None where no camera (C,) reads by rows."""
    if not readouts_s.any():
        return None
    camera_of = shots.camera_of[matched.view_of]
    return np.asarray(readouts_s[camera_of] * (matched.at[:, 1] / heights[camera_of] - 0.5))


def with_company(used: Bools, matched: Matched) -> Bools:
    """Without corners whose point has no second one."""
    count = np.bincount(matched.point_of, used, len(matched.starts) - 1)
    return np.asarray(used & (count[matched.point_of] >= 2))


def offsets(rig: Rig, shots: Shots, matched: Matched, points: Array) -> Array:
    """(N,) distance of each corner from where its point falls, in pixels of the picture it was looked for in."""
    return np.asarray(np.hypot(*_residuals(rig, shots, matched, points).T) / matched.pixel)


def _residuals(rig: Rig, shots: Shots, matched: Matched, points: Array) -> Array:
    view_of, seen = _seen(shots, matched)
    ego_from_world = np.linalg.inv(rig.ego_poses(seen, _after(matched)))
    of_photo = view_of, matched.at, seen.camera_of, ego_from_world, np.linalg.inv(rig.ego_from_camera), rig.lenses
    return np.asarray(residuals(points, matched.point_of, *of_photo))


def _seen(shots: Shots, matched: Matched) -> tuple[Ints, Shots]:
    """The photos and which a corner (N,) is of; where rows are read one after the other, each corner as its own."""
    if matched.after_s is None:
        return matched.view_of, shots
    v = matched.view_of
    return np.arange(len(v)), Shots(shots.camera_of[v], shots.instant_of[v], shots.world_from_ego[v], shots.twists[v])


def _after(matched: Matched) -> Array | float:
    return 0.0 if matched.after_s is None else matched.after_s


def rays(rig: Rig, shots: Shots, matched: Matched) -> tuple[Array, Array]:
    """Eyes (N, 3) and unit directions (N, 3) in the world of the corners."""
    camera_of = shots.camera_of[matched.view_of]
    lens = rig.lenses[camera_of].T
    seen = (matched.at[:, 0] - lens[2]) / lens[0], (matched.at[:, 1] - lens[3]) / lens[1]
    x, y = seen
    k1, k2, p1, p2, k3 = lens[4:]
    for _ in range(20):  # as OpenCV does: the lens moves a pixel little
        r2 = x * x + y * y
        s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = (
            (seen[0] - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / s,
            (seen[1] - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / s,
        )
    view_of, seen_by = _seen(shots, matched)
    pose = (rig.ego_poses(seen_by, _after(matched)) @ rig.ego_from_camera[seen_by.camera_of])[view_of]
    way = np.einsum("nij,nj->ni", pose[:, :3, :3], np.column_stack([x, y, np.ones(len(x))]))
    return pose[:, :3, 3], way / np.linalg.norm(way, axis=1, keepdims=True)


def triangulated(rig: Rig, shots: Shots, matched: Matched, used: Bools | None = None) -> tuple[Array, Bools]:
    """Points (P, 3) nearest to their corners' rays, and which of them are there: with parallax, ahead, not too far."""
    eyes, ways = rays(rig, shots, matched)
    weight = np.ones(len(eyes)) if used is None else used.astype(np.float64)
    first = matched.starts[:-1]
    across = weight[:, None, None] * (np.eye(3) - ways[:, :, None] * ways[:, None, :])
    blocks = np.add.reduceat(across, first)
    sides = np.add.reduceat(np.einsum("nij,nj->ni", across, eyes), first)
    mean = np.add.reduceat(weight[:, None] * ways, first)
    count = np.maximum(np.add.reduceat(weight, first), 1.0)
    # Rays within an angle a of each other have a mean shorter than 1 by a^2 / 8.
    length = np.linalg.norm(mean / count[:, None], axis=1)
    there = (length < 1.0 - np.radians(LEAST_PARALLAX_DEG) ** 2 / 8.0) & (np.add.reduceat(weight, first) >= 2.0)
    blocks[~there] = np.eye(3)
    points = np.linalg.solve(blocks, sides[..., None])[..., 0]
    ahead = np.einsum("ni,ni->n", points[matched.point_of] - eyes, ways)
    ahead = np.where(weight > 0.0, ahead, 1.0)
    there &= (np.minimum.reduceat(ahead, first) > 0.0) & (np.maximum.reduceat(ahead, first) < FARTHEST_M)
    return points, there


def _settled(
    given: Rig, rig: Rig, shots: Shots, matched: Matched, points: Array, used: Bools, width: float, sigmas: Array
) -> tuple[Rig, Array]:
    """Rig and points after some steps of Levenberg-Marquardt."""
    free = sigmas > 0.0
    trust = np.where(free, 1.0 / np.where(free, sigmas, 1.0) ** 2, 0.0)
    places = _places(rig, shots, matched)
    view_of, seen = _seen(shots, matched)
    damping = DAMPING[0]
    width_px = width * matched.pixel

    def cost_of(rig: Rig, points: Array) -> tuple[float, Array]:
        off = _residuals(rig, shots, matched, points)
        square = np.minimum((off[used] ** 2).sum(axis=1) / width_px[used] ** 2, NO_MORE)
        weights = np.zeros(len(used))
        weights[used] = np.where(square < NO_MORE, 1.0 / ((1.0 + square) * matched.pixel[used] ** 2), 0.0)
        away = rig.away_from(given)
        return float((np.log1p(square) * width**2).sum() + (trust * away**2).sum()), weights

    cost, weights = cost_of(rig, points)
    for _ in range(STEPS):
        ego_from_world = np.linalg.inv(rig.ego_poses(seen, _after(matched)))
        matrix, right, inverses, sides, mixed = normal_equations(
            points, matched.starts, view_of, matched.at, weights, damping, seen.camera_of, places,
            ego_from_world, np.linalg.inv(rig.ego_from_camera), rig.lenses, seen.twists, len(sigmas),
        )  # fmt: skip
        right = right - trust * rig.away_from(given)
        matrix[np.diag_indices(len(sigmas))] = np.diag(matrix) * (1.0 + damping) + trust
        matrix[~free], matrix[:, ~free], right[~free] = 0.0, 0.0, 0.0
        matrix[~free, ~free] = 1.0
        step = solved(matrix, right)
        if np.isfinite(step).all():
            moved = np.einsum("nkm,nk->nm", mixed, step[places])
            by_point = np.add.reduceat(moved, matched.starts[:-1])
            there = points + np.einsum("pij,pj->pi", inverses, sides - by_point)
            tried = rig.moved(step)
            new_cost, new_weights = cost_of(tried, there)
        else:
            new_cost = np.inf
        if new_cost < cost:
            gained = (cost - new_cost) / cost
            rig, points, cost, weights = tried, there, new_cost, new_weights
            damping = max(damping / 10.0, DAMPING[1])
            if gained < SETTLED:
                break
        else:
            damping *= 10.0
            if damping > DAMPING[2]:
                break
    return rig, points


def _places(rig: Rig, shots: Shots, matched: Matched) -> Ints:
    """(N, 22) rows of the parameters that a corner depends on."""
    n = 6 * len(rig.corrections)
    of_instant = 6 * shots.instant_of[matched.view_of, None] + np.arange(MOUNT)
    of_camera = n + N_CAMERA * shots.camera_of[matched.view_of, None] + np.arange(N_CORNER - MOUNT)
    return np.concatenate([of_instant, of_camera], axis=1)
