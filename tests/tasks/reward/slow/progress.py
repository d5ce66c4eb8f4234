"""How the ego moves along its route: progress, driving direction, lane keeping (docs/reward.md 2e, 2f, 2h)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.tasks.reward.slow.areas import EgoAreas

Array = NDArray[np.float64]

DDC_WINDOW = 11  # indices t-10 .. t, the public 1.0 s
DDC_TOLERATED_M, DDC_FAILED_M = 2.0, 6.0
LK_DEVIATION_M = 0.5
LK_STEPS = 20  # 2.0 s


def progress_along(centerline: shapely.LineString, boxes: Array) -> Array:
    """EP raw (K,) [m]: arc length gained by the ego's centre along the centreline, at least 0."""
    start, end = (shapely.line_locate_point(centerline, shapely.points(boxes[:, t, :2])) for t in (0, -1))
    gained: Array = np.clip(end - start, 0.0, None)
    return gained


def driving_direction_compliance(boxes: Array, areas: EgoAreas) -> tuple[Array, Array]:
    """DDC (K,) in {0, 0.5, 1} and the first time index (K,) with 2 m or more against traffic within 1 s (inf: none)."""
    moved = np.zeros(boxes.shape[:2])
    moved[:, 1:] = np.hypot(*np.moveaxis(np.diff(boxes[..., :2], axis=1), -1, 0))
    wrong_way = np.where(areas.oncoming & ~areas.center_in_intersection, moved, 0.0)
    padded = np.pad(wrong_way, ((0, 0), (DDC_WINDOW - 1, 0)))
    recent = np.lib.stride_tricks.sliding_window_view(padded, DDC_WINDOW, axis=1).sum(axis=-1)
    worst = recent.max(axis=1)
    ddc = np.where(worst < DDC_TOLERATED_M, 1.0, np.where(worst < DDC_FAILED_M, 0.5, 0.0))
    return ddc, first_true(recent >= DDC_TOLERATED_M)


def lane_keeping(centerline: shapely.LineString, boxes: Array, areas: EgoAreas) -> tuple[Array, Array]:
    """LK (K,) in {0, 1} and the time index (K,) that completes 20 steps off the centreline (inf: none).

    Steps inside an intersection neither count nor interrupt the count.
    """
    distance = shapely.distance(centerline, shapely.points(boxes[..., :2]))
    count = np.zeros(boxes.shape[0], dtype=np.int64)
    failed = np.zeros(boxes.shape[:2], dtype=bool)
    for t in range(boxes.shape[1]):
        deviating = distance[:, t] > LK_DEVIATION_M
        count = np.where(areas.center_in_intersection[:, t], count, np.where(deviating, count + 1, 0))
        failed[:, t] = count >= LK_STEPS
    return np.where(failed.any(axis=1), 0.0, 1.0), first_true(failed)


def first_true(flags: NDArray[np.bool_]) -> Array:
    """Index (K,) of the first True along the second axis of (K, T), inf where there is none."""
    return np.where(flags.any(axis=1), flags.argmax(axis=1), np.inf)
