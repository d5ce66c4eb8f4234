"""What one photo shows, pixel by pixel: how far, whose, sky or not.

Lidar gives sparse depth, gaps are closed along surfaces; what lidar does not reach gets its depth from other photos.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tasks.render.scene.depth import dense_depth, sparse_depth
from tasks.render.scene.driven_road import road_depth
from tasks.render.scene.features import Points
from tasks.render.scene.movers import behind_boxes, world_from_boxes
from tasks.render.scene.sensed import Photo, Tracks
from tasks.render.scene.sky import directions, may_be_sky, no_worse
from tasks.render.scene.stereo import FAR_M, MAX_BASELINE_M, MIN_BASELINE_M, Compared, sweep_depth
from tasks.render.scene.wide_stereo import partners, wide_depth
from tasks.world.arrays import F32, Array, Bools, ShortInts

SHALLOW = -2  # label of a pixel without lidar


@dataclass(frozen=True)
class Seen:
    """What a photo shows, (H, W) each."""

    depth: F32  # [m]; 0: nothing known
    label: ShortInts  # -1 background, row of a track, SHALLOW
    sky: Bools
    passing: Bools  # pixels at or behind something that drives, or of the own body: no witnesses of the street


def see(
    photo: Photo,
    others: Sequence[Photo],
    known: Points,
    per_track: dict[int, Array],
    tracks: Tracks,
    stereo_photos: int,
) -> Seen:
    """A photo's depth from the fused lidar (`fuse`), completed from the `others` it is compared with."""
    height, width = photo.rgb.shape[:2]
    rgb = photo.rgb.astype(np.float32) / 255.0
    boxes, valid = tracks.at(photo.taken_s)
    poses = world_from_boxes(boxes)
    points, labels = [known.dense], [np.full(len(known.dense), -1, np.int32)]
    for j, mine in per_track.items():
        if valid[j]:
            points.append(mine @ poses[j, :3, :3].T + poses[j, :3, 3])
            labels.append(np.full(len(mine), j, np.int32))
    sparse, label = sparse_depth(
        np.concatenate(points), np.concatenate(labels), photo.intrinsics, photo.world_from_camera, width, height
    )
    depth, label = dense_depth(sparse, label, rgb)
    rays = directions(photo.intrinsics, photo.world_from_camera, width, height)
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])

    def behind(depth: F32, boxes: Array) -> Bools:
        return np.asarray(behind_boxes((rays * depth[..., None]).reshape(-1, 3) + eye, eye, boxes)).reshape(depth.shape)

    if not per_track:  # without lidar on them nothing but their boxes tells what hides the street behind it
        hidden = (depth > 0.0) & behind(depth, boxes[valid])
        depth, label = np.where(hidden, np.float32(0.0), depth), np.where(hidden, np.int32(SHALLOW), label)
    own = np.zeros((height, width), bool) if photo.own_body is None else photo.own_body
    depth = np.where(own, np.float32(0.0), depth)
    unknown = (depth == 0.0) & ~own
    bright = may_be_sky(rgb)
    hints, camera = _hints(depth), (photo.intrinsics, photo.world_from_camera)
    if known.corners is None:
        neighbours, sweep = _neighbours(photo, others, stereo_photos), partial(sweep_depth, rgb, hints)
    else:
        anchors, _ = sparse_depth(known.corners, np.zeros(len(known.corners), np.int32), *camera, width, height)
        neighbours = partners(photo, others, stereo_photos)
        sweep = partial(wide_depth, rgb, anchors, road_depth(known.dense, eye, rays))
    if neighbours:
        guess, cost, sky_cost = sweep(neighbours, *camera, unknown)
        sky = unknown & ((bright & no_worse(sky_cost, cost)) | (guess >= FAR_M))
    else:
        guess, sky = hints[0], unknown & (bright | (hints[0] == 0.0))
    depth = np.where(unknown & ~sky, guess, depth).astype(np.float32)
    passing = behind(np.where(depth > 0, depth, np.float32(FAR_M)), boxes[valid & tracks.driving]) | own
    return Seen(depth, label, sky, passing)


def _hints(depth: F32) -> F32:
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


def _neighbours(photo: Photo, others: Sequence[Photo], n: int) -> list[Compared]:
    """The n photos whose baseline is closest to 1 m and that look the same way."""
    candidates = []
    for i, other in enumerate(others):
        baseline = float(np.linalg.norm(other.world_from_camera[:3, 3] - photo.world_from_camera[:3, 3]))
        same_way = float(other.world_from_camera[:3, 2] @ photo.world_from_camera[:3, 2]) > 0.9
        if MIN_BASELINE_M <= baseline <= MAX_BASELINE_M and same_way and other.rgb.shape == photo.rgb.shape:
            candidates.append((abs(np.log(baseline)), i))
    best = [others[i] for _, i in sorted(candidates)[:n]]
    return [(o.rgb.astype(np.float32) / 255.0, o.intrinsics, o.world_from_camera) for o in best]
