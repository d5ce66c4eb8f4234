"""Depth where lidar does not reach (upper storeys, trees, sky), from how well other photos agree.

A plane sweep (Collins 1996): each hypothesis of a pixel's depth says where neighbouring photos see the same thing; the
hypothesis under which the colours agree best, over a small window, wins.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import kernel, numpy_division_kernel
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import is_smooth_around, may_be_sky, sky_agrees
from tasks.world.arrays import F32, Array, Bools

FAR_M = 1.0e4  # stands for the sky
LEVELS_M = (*(float(z) for z in 1.0 / np.linspace(1.0 / 5.0, 1.0 / 160.0, 28)), FAR_M)
WINDOW_PX = 7
MIN_BASELINE_M, MAX_BASELINE_M = 0.3, 6.0  # less: no parallax; more: nothing in common
Compared = tuple[F32, Array, Array]  # a photo's rgb (H, W, 3) in [0, 1], intrinsics, world_from_camera
UNSEEN_COST = 0.25  # of a pixel whose hypothesis lies outside the other photo


def plane_sweep_depth(
    rgb: F32, hints: F32, others: Sequence[Compared], intrinsics: Array, world_from_camera: Array, wanted: Bools
) -> tuple[F32, F32, F32]:
    """Best depth (H, W) [m], its cost, and the cost of the sky hypothesis (mean absolute rgb difference).

    `rgb` (H, W, 3) in [0, 1]; `hints` (J, H, W) extra hypotheses per pixel, 0 = none; `others` (rgb of the same size,
    intrinsics, world_from_camera) of at least one other photo. Pixels that are not `wanted` (H, W) hold nothing of use.
    """
    height, width = rgb.shape[:2]
    best, best_cost = np.zeros((height, width), np.float32), np.full((height, width), np.inf, np.float32)
    sky_cost = best_cost
    for hypothesis in (*hints, *LEVELS_M):
        depth = np.broadcast_to(np.asarray(hypothesis, np.float32), (height, width))
        cost = smoothed_cost(rgb, others, intrinsics, world_from_camera, depth, wanted, WINDOW_PX)
        better = cost < best_cost
        best, best_cost = np.where(better, depth, best), np.where(better, cost, best_cost)
        if isinstance(hypothesis, float) and hypothesis == FAR_M:
            sky_cost = cost
    return best, best_cost, sky_cost


def smoothed_cost(
    rgb: F32,
    others: Sequence[Compared],
    intrinsics: Array,
    world_from_camera: Array,
    depth: F32,
    wanted: Bools,
    window: int,
) -> F32:
    """(H, W) disagreement over a window of pixels where these are as deep as `depth` (H, W); infinite where it is 0."""
    around = cv2.dilate(wanted.astype(np.uint8), np.ones((window, window), np.uint8)).astype(np.bool_)
    raw = matching_cost(rgb, others, intrinsics, world_from_camera, depth, around)
    return np.asarray(np.where(depth > 0, cv2.blur(raw, (window, window)), np.float32(np.inf)))


def matching_cost(
    rgb: F32, others: Sequence[Compared], intrinsics: Array, world_from_camera: Array, depth: F32, wanted: Bools
) -> F32:
    """(H, W) what `_disagreement` says, pixel by pixel."""
    photos = np.stack([other_rgb for other_rgb, _, _ in others])
    from_here = [np.linalg.inv(pose) @ world_from_camera for _, _, pose in others]
    turned = np.stack([k @ pose[:3, :3] for (_, k, _), pose in zip(others, from_here)])
    shifts = np.stack([k @ pose[:3, 3] for (_, k, _), pose in zip(others, from_here)])
    return np.asarray(
        _disagreement(rgb, photos, turned, shifts, intrinsics, np.ascontiguousarray(depth, np.float32), wanted)
    )


@numpy_division_kernel
def _disagreement(rgb: Any, photos: Any, turned: Any, shifts: Any, k: Any, depth: Any, wanted: Any) -> Any:
    """(H, W) mean absolute colour difference to the better half of the other photos (n, H, W, 3), pixel by pixel.

    An occluder rarely hides a point from two photos on opposite sides: the half that agrees is trusted.
    """
    n, height, width = photos.shape[:3]
    out, one, half = np.zeros((height, width), np.float32), np.float32(1.0), (n + 1) // 2
    costs, ways = (
        np.empty(n),
        np.empty((n, 6)),
    )  # of each photo: what it sees of a pixel's ray in the row, and its slope
    for row in range(height):
        b = (row + 0.5 - k[1, 2]) / k[1, 1]
        for j in range(n):
            for axis in range(3):
                ways[j, axis] = turned[j, axis, 1] * b + turned[j, axis, 2]
                ways[j, 3 + axis] = turned[j, axis, 0]
        for column in range(width):
            if not wanted[row, column]:
                continue
            z0, a = depth[row, column] if depth[row, column] > 0.0 else 1.0, (column + 0.5 - k[0, 2]) / k[0, 0]
            for j in range(n):
                z = (ways[j, 5] * a + ways[j, 2]) * z0 + shifts[j, 2]
                cost = UNSEEN_COST
                if z > 0.1:
                    x = ((ways[j, 3] * a + ways[j, 0]) * z0 + shifts[j, 0]) / z - 0.5
                    y = ((ways[j, 4] * a + ways[j, 1]) * z0 + shifts[j, 1]) / z - 0.5
                    if 0.0 <= x < width - 1 and 0.0 <= y < height - 1:
                        x0, y0, photo = np.uint64(x), np.uint64(y), np.uint64(j)  # unsigned: none counts from the end
                        x1, y1 = x0 + np.uint64(1), y0 + np.uint64(1)
                        fx, fy = np.float32(x - x0), np.float32(y - y0)
                        off = np.float32(0.0)
                        for c in range(3):
                            top = photos[photo, y0, x0, c] * (one - fx) + photos[photo, y0, x1, c] * fx
                            bottom = photos[photo, y1, x0, c] * (one - fx) + photos[photo, y1, x1, c] * fx
                            off += abs(top * (one - fy) + bottom * fy - rgb[row, column, c])
                        cost = float(off) / 3.0
                place = j
                while place > 0 and costs[place - 1] > cost:
                    costs[place] = costs[place - 1]
                    place -= 1
                costs[place] = cost
            total = 0.0
            for j in range(half):
                total += costs[j]
            out[row, column] = total / half
    return out


# Depth of blocks without lidar, from photos that lie metres apart and look different ways.
#
# A plane sweep at half size over many depths, colours measured against those around them, each depth chosen together
# with its neighbours' (semi-global matching, Hirschmueller 2008), then refined at full size.

NEAREST_M, FARTHEST_M, LEVELS = 1.6, 250.0, 160  # even steps of inverse depth
AROUND_PX, LEAST_CONTRAST = 9, 0.02  # window of the local mean, and what its deviation is taken for at least
COARSE_PX, FINE_PX = 5, 5  # windows of the cost
STEP, JUMP = 0.02, 0.25  # penalties of a neighbour one level off, and further
COST_MAX = 1.0
GRID, DEPTHS_M = (6, 4), (5.0, 10.0, 25.0)  # where in a photo, and how far away, others are asked for what they show
OF_CAMERA, BEST_M = 2, 3.0  # photos of the same camera that are always asked, and the way to them that is best
GOOD_DEG = (2.0, 35.0)  # between two rays to a point: depth is told well from the first on, nothing looks alike beyond
LEAST_WORTH = 0.02  # share of a photo that another must add
BELOW, SLACK = 0.4, 0.1  # cost of what lies below the road, and share of its depth by which it may be lower
ANCHORED = 0.4  # cost of another depth where one is known
BRIGHT_SKY, SMOOTH_SKY = (
    0.03,
    0.2,
)  # cost that the sky is spared where a pixel is bright, and where all around is smooth
GAP_M = 12.0  # a bright pixel that far away or farther may be a gap through which the sky is seen
FINER = (-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75)  # of a level


def wide_baseline_depth(
    rgb: F32, anchors: F32, floor: F32, others: Sequence[Compared], intrinsics: Array, pose: Array, wanted: Bools
) -> tuple[F32, F32, F32]:
    """As `plane_sweep_depth`: best depth (H, W) [m], its cost, and 0 where the sky is seen, infinity elsewhere.

    `anchors` (H, W): depths that are known, 0 elsewhere; `floor` (H, W): depths of the road, below which nothing is,
    0 above the horizon, where alone there may be sky.
    """
    here, there = locally_normalised(rgb), [(locally_normalised(other), k, at) for other, k, at in others]
    inverse = np.linspace(1.0 / NEAREST_M, 1.0 / FARTHEST_M, LEVELS)
    small, few = _halved(here, intrinsics), [(*_halved(other, k), at) for other, k, at in there]
    shape = small[0].shape[:2]
    everywhere = np.ones(shape, bool)
    volume = np.empty((LEVELS, *shape), np.float32)
    for level, z in enumerate((*(1.0 / inverse[:-1]), FAR_M)):
        depth = np.full(shape, z, np.float32)
        raw = matching_cost(small[0], few, small[1], pose, depth, everywhere)
        volume[level] = cv2.blur(np.minimum(raw, COST_MAX), (COARSE_PX, COARSE_PX))
    step = float(inverse[0] - inverse[1])
    _anchor(volume, anchors, float(inverse[0]), step)
    _stand_on(volume, np.ascontiguousarray(floor[::2, ::2]), float(inverse[0]), step, BELOW, SLACK)
    bright = may_be_sky(rgb) & (floor == 0.0)
    smooth = bright & is_smooth_around(rgb, bright)
    favour = BRIGHT_SKY * np.where(bright, 1.0, -1.0) + SMOOTH_SKY * smooth
    volume[-1] -= favour[::2, ::2][: shape[0], : shape[1]].astype(np.float32)
    guide = cv2.resize(rgb, shape[::-1], interpolation=cv2.INTER_AREA)
    chosen = _semi_global_matching(np.ascontiguousarray(volume.transpose(1, 2, 0)), guide)
    height, width = rgb.shape[:2]
    level, solid = (cv2.resize(c.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST) for c in chosen)
    level = np.where(bright, level, solid)  # wires are thinner than what is looked at together
    at = np.where(level < LEVELS - 1, inverse[0] - level * step, 0.0)
    finer = [np.where(at > 0.0, 1.0 / np.maximum(at + part * step, 1.0 / FAR_M), FAR_M) for part in FINER]
    sky = np.full((height, width), FAR_M, np.float32)
    depths = [d.astype(np.float32) for d in finer] + [sky]
    costs = [smoothed_cost(here, there, intrinsics, pose, d, wanted, FINE_PX) for d in depths]
    best = np.argmin(np.stack(costs[:-1]), axis=0)
    depth = np.take_along_axis(np.stack(depths[:-1]), best[None], axis=0)[0]
    cost = np.min(np.stack(costs[:-1]), axis=0)
    gaps = bright & (depth > GAP_M) & sky_agrees(costs[-1], cost)
    open_sky = smooth | gaps | (level == LEVELS - 1)
    return depth, cost, np.where(open_sky, np.float32(0.0), np.float32(np.inf))


def choose_partners(photo: Photo, others: Sequence[Photo], n: int) -> list[Compared]:
    """Up to n photos that together show as much of this one as can be, from directions that tell depth.

    First of its own camera, then one after the other the one that adds most; what is shown already counts for less.
    """
    height, width = photo.rgb.shape[:2]
    u, v = np.meshgrid((np.arange(GRID[0]) + 0.5) / GRID[0] * width, (np.arange(GRID[1]) + 0.5) / GRID[1] * height)
    flat = np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)]) @ np.linalg.inv(photo.intrinsics).T
    local = np.concatenate([depth * flat for depth in DEPTHS_M])
    eye = photo.world_from_camera[:3, 3]
    points = local @ photo.world_from_camera[:3, :3].T + eye
    gains = []
    for other in others:
        there = np.linalg.inv(other.world_from_camera)
        x, y, z = other.intrinsics @ (points @ there[:3, :3].T + there[:3, 3]).T
        ahead = np.maximum(z, 0.1)
        seen = (z > 0.5) & (x > 0) & (x < width * ahead) & (y > 0) & (y < height * ahead)
        ways = [points - at for at in (eye, other.world_from_camera[:3, 3])]
        cosine = (ways[0] * ways[1]).sum(axis=1) / np.linalg.norm(ways[0], axis=1) / np.linalg.norm(ways[1], axis=1)
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        same_size = other.rgb.shape == photo.rgb.shape
        gains.append(seen * np.minimum(angle / GOOD_DEG[0], 1.0) * (angle < GOOD_DEG[1]) * same_size)
    gain = np.stack(gains) if gains else np.zeros((0, len(points)))
    away = [float(np.linalg.norm(other.world_from_camera[:3, 3] - eye)) for other in others]
    mine = [i for i, other in enumerate(others) if other.camera == photo.camera and away[i] >= MIN_BASELINE_M]
    chosen = sorted(mine, key=lambda i: abs(np.log(away[i] / BEST_M)))[: min(OF_CAMERA, n)]
    shown = gain[chosen].sum(axis=0)
    while len(chosen) < min(n, len(others)):
        worth = (gain / (1.0 + shown)).mean(axis=1)
        worth[chosen] = 0.0
        best = int(worth.argmax())
        if worth[best] < LEAST_WORTH:
            break
        chosen.append(best)
        shown += gain[best]
    best_ones = [others[i] for i in chosen]
    return [(o.rgb.astype(np.float32) / 255.0, o.intrinsics, o.world_from_camera) for o in best_ones]


def locally_normalised(rgb: F32) -> F32:
    """Colours (H, W, 3) less their mean around, over their deviation: what two exposures show alike."""
    window = (AROUND_PX, AROUND_PX)
    mean = cv2.blur(rgb, window)
    grey_variance = (cv2.blur(rgb * rgb, window) - mean * mean).mean(axis=-1, keepdims=True)
    deviation = np.sqrt(np.maximum(grey_variance, 0.0)) + np.float32(LEAST_CONTRAST)
    return np.ascontiguousarray((rgb - mean) / (2.0 * deviation), np.float32)


def _halved(picture: F32, intrinsics: Array) -> tuple[F32, Array]:
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    shrink = np.diag([width / picture.shape[1], height / picture.shape[0], 1.0])
    return np.asarray(small, np.float32), shrink @ intrinsics


@kernel
def _anchor(volume: Any, anchors: Any, first: float, step: float) -> None:
    """Adds to the costs (L, h, w) of levels that are not the one of a known depth (H, W) at twice the size."""
    for y in range(anchors.shape[0]):
        for x in range(anchors.shape[1]):
            row, column = y // 2, x // 2
            if anchors[y, x] > 0.0 and row < volume.shape[1] and column < volume.shape[2]:
                at = (first - 1.0 / anchors[y, x]) / step
                for level in range(volume.shape[0]):
                    if abs(level - at) > 1.5:
                        volume[level, row, column] += ANCHORED


@kernel
def _stand_on(volume: Any, floor: Any, first: float, step: float, more: float, slack: float) -> None:
    """Adds to the costs (L, h, w) of levels that lie below the floor (h, w) by more than a share of its depth."""
    for y in range(volume.shape[1]):
        for x in range(volume.shape[2]):
            if floor[y, x] > 0.0:
                at = (first - 1.0 / (floor[y, x] * (1.0 + slack))) / step
                for level in range(max(0, int(np.ceil(at))), volume.shape[0]):
                    volume[level, y, x] += more


@kernel
def _semi_global_matching(volume: Any, guide: Any) -> Any:
    """Level (2, H, W) of least cost (H, W, L) summed over paths from eight sides, of all and of all but the last.

    A jump costs less at an edge.
    """
    height, width, levels = volume.shape
    total = np.zeros(volume.shape, np.float32)
    before = np.empty((4, width, levels), np.float32)  # paths from the left, and from the row before: three ways
    after = np.empty((4, width, levels), np.float32)
    for way in (1, -1):  # down from the upper left, then up from the lower right
        for row in range(height):
            y = row if way == 1 else height - 1 - row
            for column in range(width):
                x = column if way == 1 else width - 1 - column
                for side in range(4):
                    xx, yy = (x - way, y) if side == 0 else (x + side - 2, y - way)
                    inside = 0 <= xx < width and 0 <= yy < height
                    path, last = after[side, x], before[side, xx] if side else after[0, xx]
                    if not inside:
                        for level in range(levels):
                            path[level] = volume[y, x, level]
                            total[y, x, level] += path[level]
                        continue
                    edge, least = 0.0, last[0]
                    for c in range(3):
                        edge += abs(guide[y, x, c] - guide[yy, xx, c])
                    for level in range(1, levels):
                        least = min(least, last[level])
                    jump = np.float32(JUMP / (1.0 + 10.0 * edge))
                    for level in range(levels):
                        best = min(last[level], least + jump)
                        if level > 0:
                            best = min(best, last[level - 1] + np.float32(STEP))
                        if level < levels - 1:
                            best = min(best, last[level + 1] + np.float32(STEP))
                        path[level] = volume[y, x, level] + best - least
                        total[y, x, level] += path[level]
            before, after = after, before
    out = np.zeros((2, height, width), np.int32)
    for y in range(height):
        for x in range(width):
            best = 0
            for level in range(1, levels - 1):
                if total[y, x, level] < total[y, x, best]:
                    best = level
            out[0, y, x] = best if total[y, x, best] <= total[y, x, levels - 1] else levels - 1
            out[1, y, x] = best
    return out
