"""A block without photos: lidar returns as grey discs, bright where the return was strong. No picture of the world.

It shows where things are, not what they look like, and only near the few places the sweeps were taken from: the gaps
between the rings on the road grow with the square of the distance.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.boxes import box_gaussians
from tasks.render.scene.build import MIN_NODE_DISCS
from tasks.render.scene.choose import with_mirror_image
from tasks.render.scene.movers import owners, world_from_boxes
from tasks.render.scene.sensed import Sweep, Tracks, on_ego, shifted, voxel_rows
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.scene.surfels import Discs, concatenate_discs, gaussians_of
from tasks.render.splatting.gaussians import EMPTY, concatenate
from tasks.render.splatting.project import OF_DISCS
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import F32, Array, Bools, Bytes

DARKEST, BRIGHTEST, STRONG = 0.12, 0.9, 120.0  # grey of no and of a strong return: lane paint, signs, plates
SKY_RGB, HAZE_RGB = (0.72, 0.78, 0.85), (0.30, 0.30, 0.31)  # above and below the horizon, where nothing was hit
CELL_M, GROUND_STEP_M, GROUND_RISE = 2.0, 0.25, 0.05  # ground: near the lowest return around, itself not high up
NEIGHBOUR = 4  # the size of a disc is the distance to this one
PER_RANGE = (0.004, 0.015)  # least and most of it, as a share of the distance to the sensor
RING_GAP_PER_M = 0.004  # gap between rings on flat ground / distance^2: 0.4 deg between beams, 1.7 m above the road
MAX_RING_GAP_M = 1.5
INNER_SHARE = 0.9  # of a mover's box: a plain one behind its returns, for few come back from dark paint and windows


def lidar_asset(sweeps: Sequence[Sweep], agents: AgentTracks | None) -> RenderAsset:
    """The scene of a block seen by lidar alone; sweeps with intensity. psnr_db is NaN: nothing to compare with.

    Raises ValueError without sweeps or intensity.
    """
    if not sweeps or any(sweep.intensity is None for sweep in sweeps):
        raise ValueError("lidar_asset: no sweeps, or sweeps without intensity")
    origin = np.round(sweeps[0].world_from_ego[:3, 3])
    tracks = Tracks(agents, origin)
    static: list[Discs] = []
    moving: dict[int, list[Discs]] = {}
    sizes: dict[int, Array] = {}
    for sweep in sweeps:
        pose = shifted(sweep.world_from_ego, -origin)
        discs = _discs(sweep).moved(pose)
        boxes, valid = tracks.at(sweep.time_s)
        owner = owners(discs.points, boxes, valid)
        static.append(discs.take(owner < 0))
        poses = world_from_boxes(boxes)
        for j in np.unique(owner[owner >= 0]):
            sizes[int(j)] = boxes[j, 4:7]
            mine = discs.take(owner == j).moved(np.linalg.inv(poses[j]).astype(np.float64))
            moving.setdefault(int(j), []).append(mine)
    nodes = {}
    for j, parts in sorted(moving.items()):
        whole = _thinned(parts)
        if len(whole.points) >= MIN_NODE_DISCS:
            whole = with_mirror_image(whole) if tracks.kinds[j] == AgentKind.VEHICLE else whole
            inner = box_gaussians(sizes[j] * INNER_SHARE, tracks.kinds[j])
            nodes[tracks.ids[j]] = concatenate([gaussians_of(whole), inner])
    street = _thinned(static)
    background = gaussians_of(street) if len(street.points) else EMPTY
    return RenderAsset(origin, background, nodes, plain_sky(), float("nan"), screen=OF_DISCS)


def grey_of(intensity: Bytes) -> F32:
    """(M, 3) rgb of returns (M,): grey, by the square root, so that dark asphalt is not black."""
    strength = np.sqrt(np.minimum(intensity / STRONG, 1.0))
    return np.repeat((DARKEST + (BRIGHTEST - DARKEST) * strength)[:, None], 3, axis=1).astype(np.float32)


def plain_sky() -> SkyMap:
    """One colour above the horizon, one below."""
    rgb = np.empty((ROWS, COLUMNS, 3), np.float32)
    rgb[: ROWS // 2], rgb[ROWS // 2 :] = SKY_RGB, HAZE_RGB
    return SkyMap(rgb)


def _discs(sweep: Sweep) -> Discs:
    """One disc per return, ego frame: flat on the ground and long towards the next ring, else facing the sensor."""
    assert sweep.intensity is not None
    keep = ~on_ego(sweep.points)
    points = sweep.points[keep].astype(np.float64)
    distance = np.maximum(np.linalg.norm(points, axis=1), 1.0)
    apart = cKDTree(points).query(points, k=min(NEIGHBOUR + 1, len(points)))[0][:, -1]
    size = np.clip(apart, PER_RANGE[0] * distance, PER_RANGE[1] * distance)
    outward = points / distance[:, None]
    flat = np.column_stack([points[:, :2], np.zeros(len(points))])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    side = np.column_stack([-flat[:, 1], flat[:, 0], np.zeros(len(points))])
    gap = np.clip(RING_GAP_PER_M * distance**2, size, MAX_RING_GAP_M)
    ground = _is_ground(points)[:, None]
    down = np.where(ground, flat * gap[:, None], np.cross(outward, side) * size[:, None])
    return Discs(
        points,
        (side * size[:, None]).astype(np.float32),
        down.astype(np.float32),
        grey_of(sweep.intensity[keep]),
        size.astype(np.float32),
        np.zeros((len(points), 2), np.int32),
    )


def _is_ground(points: Array) -> Bools:
    """(M,) returns close above the lowest one of their cell, where that one is about as high as the ego stands."""
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    lowest = np.full(cell.max(initial=-1) + 1, np.inf)
    np.minimum.at(lowest, cell.ravel(), points[:, 2])
    floor = lowest[cell.ravel()]
    level = np.abs(floor) < 1.0 + GROUND_RISE * np.hypot(points[:, 0], points[:, 1])
    return np.asarray(level & (points[:, 2] - floor < GROUND_STEP_M))


def _thinned(parts: Sequence[Discs]) -> Discs:
    whole = concatenate_discs(list(parts))
    return whole.take(voxel_rows(whole.points))
