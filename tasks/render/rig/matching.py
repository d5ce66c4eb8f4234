"""Which photos are compared, and the corners that show one point in several of them."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tasks.render.rig.adjust import Matched, offsets, rays, triangulated
from tasks.render.rig.corners import Corners, matches
from tasks.render.rig.rig import Rig, Shots
from tasks.world.arrays import Array
from tasks.world.camera import Camera

DEPTHS_M = (5.0, 12.0, 40.0)  # at which it is asked what two photos share
LIKELY, LIKELY_SHARE = 0.09, 0.5  # 5 degrees that a match may be off as given; share of a pair's that must not be
GRID = (6, 4)  # pixels of a photo that are asked for, across and down
LEAST_SHARE = 0.15  # of the first photo that the second must show
BASELINES_M = (0.3, 20.0)  # less: no parallax; more: nothing looks the same
BEST_M = (1.0, 3.0, 8.0)  # baselines that partners of the same camera are chosen near; a gap in one is filled by others


def pairs(rig: Rig, shots: Shots, cameras: Sequence[Camera], partners: int) -> list[tuple[int, int]]:
    """Rows of the photos that are compared: of each camera up to `partners` of those that show the same place."""
    poses = shots.world_from_ego @ rig.ego_from_camera[shots.camera_of]
    found = set()
    for i in range(len(poses)):
        share = _shared(i, poses, rig, shots, cameras)
        away = np.linalg.norm(poses[:, :3, 3] - poses[i, :3, 3], axis=1)
        for c in range(len(cameras)):
            mine = c == shots.camera_of[i]
            reach = (away > (BASELINES_M[0] if mine else 0.0)) & (away < BASELINES_M[1])
            rows = np.flatnonzero((shots.camera_of == c) & (share >= LEAST_SHARE) & reach)
            rows = rows[rows != i]
            if mine:
                rows = rows[rows > i]
                best = [rows[np.argmin(np.abs(np.log(away[rows] / m)))] for m in BEST_M if len(rows)]
                nearest = rows[np.argsort(away[rows], kind="stable")[:partners]]
                chosen = {int(j) for j in (*best, *nearest)}
            else:
                chosen = {int(j) for j in rows[np.argsort(-share[rows], kind="stable")[:partners]]}
            found |= {(min(i, j), max(i, j)) for j in chosen}
    return sorted(found)


def _shared(i: int, poses: Array, rig: Rig, shots: Shots, cameras: Sequence[Camera]) -> Array:
    """(V,) share of photo i that each photo shows, were all of it at DEPTHS_M."""
    camera, lens = cameras[shots.camera_of[i]], rig.lenses[shots.camera_of[i]]
    u, v = np.meshgrid((np.arange(GRID[0]) + 0.5) / GRID[0], (np.arange(GRID[1]) + 0.5) / GRID[1])
    x, y = (u.ravel() * camera.width - lens[2]) / lens[0], (v.ravel() * camera.height - lens[3]) / lens[1]
    way = np.column_stack([x, y, np.ones(len(x))])
    points = np.concatenate([depth * way for depth in DEPTHS_M]) @ poses[i, :3, :3].T + poses[i, :3, 3]
    local = np.einsum("vji,vpj->vpi", poses[:, :3, :3], points - poses[:, None, :3, 3])
    lenses = rig.lenses[shots.camera_of][:, None]
    size = np.array([(c.width, c.height) for c in cameras])[shots.camera_of][:, None]
    ahead = np.maximum(local[..., 2], 0.1)
    column, row = (lenses[..., k] * local[..., k] / ahead + lenses[..., 2 + k] for k in range(2))
    inside = (local[..., 2] > 0.5) & (column > 0) & (column < size[..., 0]) & (row > 0) & (row < size[..., 1])
    return np.asarray(inside.mean(axis=1))


def _likely(rig: Rig, shots: Shots, views: tuple[int, int], at_a: Array, at_b: Array) -> float:
    """Share of two photos' matches (M, 2) that the rig as given explains but for some degrees."""
    n = len(at_a)
    at = np.stack([at_a, at_b], axis=1).reshape(-1, 2)
    focal = rig.lenses[shots.camera_of[list(views)], 0]
    pair = Matched(2 * np.arange(n + 1), np.tile(views, n), at, np.tile(focal, n))
    points, there = triangulated(rig, shots, pair)
    _, ways = rays(rig, shots, pair)
    near = np.nan_to_num(offsets(rig, shots, pair, points).reshape(-1, 2).max(axis=1), nan=np.inf) < LIKELY
    far = np.linalg.norm(ways[0::2] - ways[1::2], axis=1) < LIKELY
    return float(((near & there) | far).mean())


def matched_corners(rig: Rig, shots: Shots, corners: Sequence[Corners], compared: Sequence[tuple[int, int]]) -> Matched:
    """Matches of all pairs of photos, joined where they share a corner; without what has two corners in one photo.

    A pair of photos most of whose matches lie far from where the rig as given has them is left out: one of the two is
    not what it is said to be.
    """
    starts = np.concatenate([[0], np.cumsum([len(c.at) for c in corners])]).astype(np.int64)
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for i, j in compared:
        a, b = matches(corners[i], corners[j])
        if len(a) and _likely(rig, shots, (i, j), corners[i].at[a], corners[j].at[b]) >= LIKELY_SHARE:
            first.append(starts[i] + a)
            second.append(starts[j] + b)
    edges = np.concatenate(first), np.concatenate(second)
    n = int(starts[-1])
    _, label = connected_components(coo_array((np.ones(len(edges[0]), bool), edges), shape=(n, n)), directed=False)
    view = np.searchsorted(starts, np.arange(n), side="right") - 1
    matched = np.zeros(n, bool)
    matched[edges[0]] = matched[edges[1]] = True
    size = np.bincount(label)
    # Rows of one point and photo stand side by side: a point with such a pair is a mix of several.
    order = np.lexsort((view, label))
    twice = (label[order][1:] == label[order][:-1]) & (view[order][1:] == view[order][:-1])
    mixed = np.zeros(len(size), bool)
    mixed[label[order][1:][twice]] = True
    rows = order[(matched & ~mixed[label])[order]]
    at = np.concatenate([c.at for c in corners])
    pixel = np.array([c.pixel for c in corners])
    ends = np.flatnonzero(np.diff(label[rows], append=-1)) + 1
    return Matched(np.concatenate([[0], ends]).astype(np.int64), view[rows], at[rows], pixel[view[rows]])
