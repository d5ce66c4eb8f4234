"""A dense depth image from lidar points: z-buffer, removal of points seen through others, closing of the gaps.

Inverse depth is linear on the image of a plane, so gaps are interpolated in inverse depth between the nearest returns
above, below, left and right; across a depth edge only the side that the pixel's colour belongs to is used.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.scene.features import SurfacePoints, road_depth
from tasks.render.scene.movers import behind_boxes, world_from_boxes
from tasks.render.scene.sensed import Photo, Tracks, boxes_in_view
from tasks.render.scene.sky import may_be_sky, pixel_directions, sky_agrees
from tasks.render.scene.stereo import (
    FAR_M,
    MAX_BASELINE_M,
    MIN_BASELINE_M,
    Compared,
    choose_partners,
    plane_sweep_depth,
    wide_baseline_depth,
)
from tasks.world.arrays import F32, Array, Bools, ShortInts

NEAR_M = 0.5
MAX_GAP_PX = (12, 24)  # columns, rows that are interpolated between returns
SEE_THROUGH_PX = 5  # how far around a pixel its occluders are looked for
OCCLUDED_RATIO = 0.85  # a return is hidden when returns on both sides are nearer than this share of its depth
EDGE_RATIO = 1.25  # depths further apart than this belong to two surfaces
MAX_BEYOND_PX = 2  # a pixel that is not between two returns is not the same surface much further
SMOOTH_PX = 2  # window of 5 x 5: noise of the lidar and of its poses, a few cm, ripples the road
SMOOTH_RATIO = 1.06  # depths further apart are not averaged
COLOUR_SIGMA = 0.06  # rgb distance that makes a neighbour half as trustworthy


def sparse_depth(
    parts: Iterable[tuple[int, Array]], intrinsics: Array, world_from_camera: Array, width: int, height: int
) -> tuple[F32, ShortInts]:
    """Depth [m] of the nearest point per pixel and its label; 0 and -2 where no point falls.

    `parts`: labels with their points (M, 3), world. Points that are seen only through gaps between nearer ones are
    removed.
    """
    depth, label = np.zeros((height, width), np.float32), np.full((height, width), -2, np.int32)
    camera_from_world = np.ascontiguousarray(np.linalg.inv(world_from_camera))
    for of, points in parts:
        _zbuffer(np.ascontiguousarray(points), of, camera_from_world, intrinsics, depth, label)
    hidden = _occluded(depth)
    depth[hidden], label[hidden] = 0.0, -2
    return depth, label


def dense_depth(depth: F32, label: ShortInts, rgb: F32) -> tuple[F32, ShortInts]:
    """Closes gaps of a sparse depth image (H, W) up to MAX_GAP_PX to the nearest returns.

    `rgb` (H, W, 3) in [0, 1]. Where nothing is near enough the depth stays 0 and the label -2.
    """
    colours = np.ascontiguousarray(rgb, np.float32)
    filled, labels = depth, label
    for _ in range(2):  # the first pass fills rows and columns that hold returns, the second what lies between them
        filled, labels = _fill(filled, labels, colours, *MAX_GAP_PX)
    return _smooth(filled, labels), labels


@kernel
def _zbuffer(points: Any, of: int, camera_from_world: Any, k: Any, depth: Any, label: Any) -> None:
    """Points of one label into a picture's depth and labels (H, W), where nothing is as near."""
    height, width = depth.shape
    r = camera_from_world
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < NEAR_M:
            continue
        u = k[0, 0] * (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z + k[0, 2]
        v = k[1, 1] * (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z + k[1, 2]
        if u < 0.0 or v < 0.0 or u >= width or v >= height:
            continue
        x, y = int(u), int(v)
        if depth[y, x] == 0.0 or z < depth[y, x]:
            depth[y, x] = z
            label[y, x] = of


@kernel
def _nearer(depth: Any, y: int, x: int, dy: int, dx: int, limit: float) -> bool:
    """Whether a strip of three pixels' width in direction (dy, dx) holds a return nearer than `limit`."""
    height, width = depth.shape
    for step in range(1, SEE_THROUGH_PX + 1):
        for side in range(-1, 2):
            yy, xx = y + dy * step + dx * side, x + dx * step + dy * side
            if 0 <= yy < height and 0 <= xx < width and 0.0 < depth[yy, xx] < limit:
                return True
    return False


@kernel
def _occluded(depth: Any) -> Any:
    """Returns with nearer ones on opposite sides. One side alone is a depth edge, or the road further down."""
    height, width = depth.shape
    hidden = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z == 0.0:
                continue
            limit = z * OCCLUDED_RATIO
            across = _nearer(depth, y, x, 0, -1, limit) and _nearer(depth, y, x, 0, 1, limit)
            hidden[y, x] = across or (_nearer(depth, y, x, -1, 0, limit) and _nearer(depth, y, x, 1, 0, limit))
    return hidden


@kernel
def _fill(depth: Any, label: Any, rgb: Any, gap_x: int, gap_y: int) -> Any:
    height, width = depth.shape
    out, out_label = depth.copy(), label.copy()
    zs, trust, near, labels = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4, np.int32)
    for y in range(height):
        for x in range(width):
            if depth[y, x] > 0.0:
                continue
            best = -1
            for side in range(4):
                dy = -1 if side == 0 else (1 if side == 1 else 0)
                dx = -1 if side == 2 else (1 if side == 3 else 0)
                trust[side] = 0.0
                for step in range(1, (gap_x if dy == 0 else gap_y) + 1):
                    yy, xx = y + dy * step, x + dx * step
                    if yy < 0 or xx < 0 or yy >= height or xx >= width:
                        break
                    if depth[yy, xx] > 0.0:
                        apart = 0.0
                        for c in range(3):
                            apart += (rgb[yy, xx, c] - rgb[y, x, c]) ** 2
                        zs[side], near[side], labels[side] = depth[yy, xx], 1.0 / step, label[yy, xx]
                        trust[side] = near[side] / (1.0 + apart / COLOUR_SIGMA**2)
                        break
                if trust[side] > 0.0 and (best < 0 or trust[side] > trust[best]):
                    best = side
            between = (trust[0] > 0.0 and trust[1] > 0.0) or (trust[2] > 0.0 and trust[3] > 0.0)
            if best < 0 or not (between or near[best] * MAX_BEYOND_PX >= 1.0):
                continue
            total, inverse = 0.0, 0.0
            for side in range(4):
                if trust[side] == 0.0 or labels[side] != labels[best]:
                    continue
                if max(zs[side], zs[best]) > EDGE_RATIO * min(zs[side], zs[best]):
                    continue
                total += near[side]  # by distance alone: exact on a plane
                inverse += near[side] / zs[side]
            out[y, x] = total / inverse
            out_label[y, x] = labels[best]
    return out, out_label


@kernel
def _smooth(depth: Any, label: Any) -> Any:
    """Mean inverse depth over symmetric pairs of pixels of the same surface: leaves planes as they are."""
    height, width = depth.shape
    out = depth.copy()
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z == 0.0:
                continue
            total, inverse = 1.0, 1.0 / z
            for dy in range(SMOOTH_PX + 1):
                for dx in range(-SMOOTH_PX, SMOOTH_PX + 1):
                    if dy == 0 and dx <= 0:
                        continue
                    y0, y1, x0, x1 = y - dy, y + dy, x - dx, x + dx
                    if y0 < 0 or y1 >= height or min(x0, x1) < 0 or max(x0, x1) >= width:
                        continue
                    a, b = depth[y0, x0], depth[y1, x1]
                    if a == 0.0 or b == 0.0 or label[y0, x0] != label[y, x] or label[y1, x1] != label[y, x]:
                        continue
                    mean = 0.5 * (1.0 / a + 1.0 / b)
                    if max(mean * z, 1.0 / (mean * z)) < SMOOTH_RATIO and max(a, b) < EDGE_RATIO * min(a, b):
                        total += 2.0
                        inverse += 2.0 * mean
            out[y, x] = total / inverse
    return out


# What one photo shows, pixel by pixel: how far, whose, sky or not.
#
# Lidar gives sparse depth, gaps are closed along surfaces; what lidar does not reach gets its depth from other
# photos.

STREET = -1  # label of a pixel that shows what stays
SHALLOW = -2  # of one without lidar


@dataclass(frozen=True)
class PhotoDepth:
    """What a photo shows, (H, W) each."""

    depth: F32  # [m]; 0: nothing known
    label: ShortInts  # STREET, row of a track, SHALLOW
    sky: Bools
    passing: Bools  # pixels at or behind something that drives, or of the own body: no witnesses of the street


def estimate_photo_depth(
    photo: Photo,
    others: Sequence[Photo],
    known: SurfacePoints,
    per_track: dict[int, Array],
    tracks: Tracks,
    stereo_photos: int,
) -> PhotoDepth:
    """A photo's depth from the fused lidar (`fuse_sweeps`), completed from the `others` it is compared with."""
    height, width = photo.rgb.shape[:2]
    rgb = photo.rgb.astype(np.float32) / 255.0
    boxes, valid = tracks.at(photo.time_s)
    poses = world_from_boxes(boxes)
    bodies = ((j, mine @ poses[j, :3, :3].T + poses[j, :3, 3]) for j, mine in per_track.items() if valid[j])
    camera = photo.intrinsics, photo.world_from_camera
    sparse, label = sparse_depth([(STREET, known.dense), *bodies], *camera, width, height)
    depth, label = dense_depth(sparse, label, rgb)
    rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height)
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])

    def behind(depth: F32, boxes: Array) -> Bools:
        if not len(boxes):
            return np.zeros(depth.shape, bool)
        return np.asarray(behind_boxes((rays * depth[..., None]).reshape(-1, 3) + eye, eye, boxes)).reshape(depth.shape)

    if not per_track:  # without lidar on them nothing but their boxes tells what hides the street behind it
        hidden = (depth > 0.0) & behind(depth, boxes[valid])
        depth, label = np.where(hidden, np.float32(0.0), depth), np.where(hidden, np.int32(SHALLOW), label)
    own = np.zeros((height, width), bool) if photo.own_body is None else photo.own_body
    depth = np.where(own, np.float32(0.0), depth)
    unknown = (depth == 0.0) & ~own
    bright = may_be_sky(rgb)
    hints = _nearest_known_depths(depth)
    if known.corners is None:
        neighbours, sweep = _stereo_neighbours(photo, others, stereo_photos), partial(plane_sweep_depth, rgb, hints)
    else:
        anchors, _ = sparse_depth([(STREET, known.corners)], *camera, width, height)
        neighbours = choose_partners(photo, others, stereo_photos)
        sweep = partial(wide_baseline_depth, rgb, anchors, road_depth(known.dense, eye, rays))
    if neighbours:
        guess, cost, sky_cost = sweep(neighbours, *camera, unknown)
        sky = unknown & ((bright & sky_agrees(sky_cost, cost)) | (guess >= FAR_M))
    else:
        guess, sky = hints[0], unknown & (bright | (hints[0] == 0.0))
    depth = np.where(unknown & ~sky, guess, depth).astype(np.float32)
    driving = boxes[valid & tracks.driving]
    driving = driving[boxes_in_view(driving, photo)]  # of a street's few a camera sees one or none
    passing = behind(np.where(depth > 0, depth, np.float32(FAR_M)), driving) | own
    return PhotoDepth(depth, label, sky, passing)


def _nearest_known_depths(depth: F32) -> F32:
    """(3, H, W) depths of the nearest known pixel below, to the left and to the right; 0 where there is none.

    A facade or a tree goes on above the last lidar return with the depth of that return.
    """
    height, width = depth.shape
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    known = depth > 0
    below = np.minimum.accumulate(np.where(known, rows, height)[::-1], axis=0)[::-1]
    left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    return np.stack(
        [
            np.where(below < height, depth[np.minimum(below, height - 1), columns], 0.0),
            np.where(left >= 0, depth[rows, np.maximum(left, 0)], 0.0),
            np.where(right < width, depth[rows, np.minimum(right, width - 1)], 0.0),
        ]
    ).astype(np.float32)


def _stereo_neighbours(photo: Photo, others: Sequence[Photo], n: int) -> list[Compared]:
    """The n photos whose baseline is closest to 1 m and that look the same way."""
    candidates = []
    for i, other in enumerate(others if n else ()):
        baseline = float(np.linalg.norm(other.world_from_camera[:3, 3] - photo.world_from_camera[:3, 3]))
        same_way = float(other.world_from_camera[:3, 2] @ photo.world_from_camera[:3, 2]) > 0.9
        if MIN_BASELINE_M <= baseline <= MAX_BASELINE_M and same_way and other.rgb.shape == photo.rgb.shape:
            candidates.append((abs(np.log(baseline)), i))
    best = [others[i] for _, i in sorted(candidates)[:n]]
    return [(o.rgb.astype(np.float32) / 255.0, o.intrinsics, o.world_from_camera) for o in best]


# Depths of photos that other photos' depths confirm: what two saw from two places is not a guess.

ALIKE, ALIKE_PER_M = 0.03, 0.001  # two depths are one within this share, and this share more for each metre of it
NEAREST_M = 0.5


def label_confirmed(photos: Sequence[Photo], seen: Sequence[PhotoDepth]) -> list[PhotoDepth]:
    """The same, guesses that another photo confirms labelled as what is known."""
    depths = [np.where(s.sky | (s.depth >= FAR_M), np.float32(0.0), s.depth) for s in seen]
    agreed = confirm_depths(photos, depths)
    return [
        replace(s, label=np.where(sure & (s.label == SHALLOW), np.int32(STREET), s.label))
        for s, sure in zip(seen, agreed)
    ]


def confirm_depths(photos: Sequence[Photo], depths: Sequence[F32]) -> list[Bools]:
    """Of each photo the pixels (H, W) whose depth [m] (H, W) is another photo's there as well; 0: nothing known."""
    from_world = [np.linalg.inv(photo.world_from_camera) for photo in photos]
    out = []
    for i, photo in enumerate(photos):
        sure = np.zeros(depths[i].shape, np.bool_)
        for j, other in enumerate(photos):
            if j != i:
                there_from_here = from_world[j] @ photo.world_from_camera
                _confirm(depths[i], photo.intrinsics, there_from_here, depths[j], other.intrinsics, sure)
        out.append(sure)
    return out


@kernel
def _confirm(depth: Any, k: Any, there_from_here: Any, seen: Any, k_there: Any, sure: Any) -> None:
    """Marks in `sure` (H, W) where a photo's `depth` (H, W) and what another has `seen` (h, w) are one surface."""
    height, width = depth.shape
    r = there_from_here
    for row in range(height):
        for column in range(width):
            z0 = depth[row, column]
            if z0 <= 0.0 or sure[row, column]:
                continue
            a, b = z0 * (column + 0.5 - k[0, 2]) / k[0, 0], z0 * (row + 0.5 - k[1, 2]) / k[1, 1]
            z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * z0 + r[2, 3]
            if z < NEAREST_M:
                continue
            u = (r[0, 0] * a + r[0, 1] * b + r[0, 2] * z0 + r[0, 3]) / z * k_there[0, 0] + k_there[0, 2]
            v = (r[1, 0] * a + r[1, 1] * b + r[1, 2] * z0 + r[1, 3]) / z * k_there[1, 1] + k_there[1, 2]
            if u < 0.0 or v < 0.0 or u >= seen.shape[1] or v >= seen.shape[0]:
                continue
            there = seen[int(v), int(u)]
            sure[row, column] = there > 0.0 and abs(z - there) < (ALIKE + ALIKE_PER_M * z) * z
