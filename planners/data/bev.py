"""A sample seen from above: what lies where in the ego frame at now, as a raster of classes and as boxes.

The classes, their order and the drawing follow the public Latent TransFuser for NAVSIM (TransfuserConfig,
TransfuserTargetBuilder), but for cyclists, whom it leaves out, and the route, which it does not draw. In a `public`
layout they are left out here as well, crossings too, whose class is its walkways', and coordinates are cut off at whole
cells as there; among the nearest vehicles are then those behind, whom the losses leave out.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factory.store.schema import AGENT_STEPS, NOW_INDEX
from planners.data.batch import BevLayout
from tasks.world.arrays import F32, Bools, Bytes, ShortInts
from tasks.world.clip import AgentKind
from tasks.world.frames import box_corners


class BevClass(IntEnum):
    """What a cell shows; of several things the one with the largest number, but that the route is under all agents."""

    BACKGROUND = 0
    ROAD = 1
    CROSSING = 2  # in the place of the public raster's walkways
    CENTERLINE = 3
    STATIC = 4
    VEHICLE = 5
    PEDESTRIAN = 6  # and cyclists
    ROUTE = 7  # the centre line that leads where the driving command does


DRAWN_AS: Mapping[str, BevClass] = {
    AgentKind.CZONE_SIGN: BevClass.STATIC,
    AgentKind.BARRIER: BevClass.STATIC,
    AgentKind.TRAFFIC_CONE: BevClass.STATIC,
    AgentKind.GENERIC_OBJECT: BevClass.STATIC,
    AgentKind.VEHICLE: BevClass.VEHICLE,
    AgentKind.PEDESTRIAN: BevClass.PEDESTRIAN,
    AgentKind.BICYCLE: BevClass.PEDESTRIAN,
}
LINE_M = 0.5  # width of a centre line: two of the public raster's cells
_SHIFT = 4  # OpenCV draws at 1/16 cell with this many fractional bits
_STEPS_PER_S = 10


def bev_raster(sample: Mapping[str, Any], layout: BevLayout) -> Bytes:
    """Rasters (T, rows, columns) of BevClass at `layout.times_s`, under one map, in the frame of the ego at now.

    A cell whose centre a shape covers shows it; a shape's outline may reach one cell further.
    Raises ValueError for a time to come or before a sample begins.
    """
    steps = [_step(time_s) for time_s in layout.times_s]
    if layout.public:
        return np.stack([_as_public(sample, layout, step) for step in steps])
    ground = np.full(layout.shape, BevClass.BACKGROUND, np.uint8)
    for name, what in (
        ("drivable_rings", BevClass.ROAD),
        ("lane_polygons", BevClass.ROAD),
        ("crossing_rings", BevClass.CROSSING),
    ):
        for ring in _near(sample[name], layout):
            cv2.fillPoly(ground, [ring], int(what), cv2.LINE_8, _SHIFT)
    width = max(round(LINE_M / layout.cell_m), 1)
    for lines, what in (
        (sample["lane_centerlines"], BevClass.CENTERLINE),
        ([sample["route_centerline"]], BevClass.ROUTE),
    ):
        cv2.polylines(ground, _near(lines, layout), False, int(what), width, cv2.LINE_8, _SHIFT)
    rasters = np.repeat(ground[None], len(steps), axis=0)
    boxes, valid = _agents(sample)
    classes = np.array([DRAWN_AS[kind] for kind in sample["agent_kinds"]], np.uint8)
    for raster, step in zip(rasters, steps):
        there = np.flatnonzero(valid[:, step])
        there = there[np.argsort(classes[there], kind="stable")]
        for box, what in zip(_cells(box_corners(boxes[there, step]), layout), classes[there]):
            cv2.fillConvexPoly(raster, box, int(what), cv2.LINE_8, _SHIFT)
    return rasters


def _as_public(sample: Mapping[str, Any], layout: BevLayout, step: int) -> Bytes:
    """(rows, columns), nearest and right first, as TransfuserTargetBuilder._compute_bev_semantic_map draws.

    OpenCV draws with x along columns there, and what it draws is not the same the other way round.
    """
    drawn = np.zeros(layout.shape[::-1], np.uint8)
    origin = np.array([layout.behind_m, layout.side_m]) / layout.cell_m

    def cells(points: NDArray[Any]) -> NDArray[np.int32]:
        return (np.asarray(points, np.float64)[..., :2] / layout.cell_m + origin).astype(np.int32)

    for name in ("drivable_rings", "lane_polygons"):
        for ring in sample[name]:
            cv2.fillPoly(drawn, [cells(ring)], int(BevClass.ROAD))
    width = max(round(LINE_M / layout.cell_m), 1)
    for line in sample["lane_centerlines"]:
        cv2.polylines(drawn, [cells(line)], False, int(BevClass.CENTERLINE), width)
    boxes, valid = _agents(sample)
    for what in (BevClass.STATIC, BevClass.VEHICLE, BevClass.PEDESTRIAN):
        of_it = [DRAWN_AS[kind] == what and kind != AgentKind.BICYCLE for kind in sample["agent_kinds"]]
        for box in cells(box_corners(boxes[valid[:, step] & np.array(of_it, bool), step].astype(np.float64))):
            cv2.fillPoly(drawn, [box], int(what))
    return np.ascontiguousarray(drawn.T)


def nearest_vehicles(sample: Mapping[str, Any], layout: BevLayout, n: int) -> tuple[F32, Bools]:
    """Vehicles at now whose centre is inside the layout, nearest first: boxes (n, 5) float32 and whether there is one.

    In a public layout those behind too, as far as ahead.

    Boxes are centre x, y [m], heading [rad], length, width [m] in the frame of the ego at now; zeros where none is.
    """
    boxes, there = _agents(sample)
    now, x, y = boxes[:, NOW_INDEX], boxes[:, NOW_INDEX, 0], boxes[:, NOW_INDEX, 1]
    wanted = there[:, NOW_INDEX] & np.array([kind == AgentKind.VEHICLE for kind in sample["agent_kinds"]], bool)
    behind_m = layout.ahead_m if layout.public else layout.behind_m
    wanted &= (-behind_m <= x) & (x <= layout.ahead_m) & (np.abs(y) <= layout.side_m)
    found = np.flatnonzero(wanted)
    found = found[np.argsort(np.hypot(x[found], y[found]), kind="stable")][:n]
    nearest, valid = np.zeros((n, 5), np.float32), np.zeros(n, bool)
    nearest[: len(found)], valid[: len(found)] = now[found], True
    return nearest, valid


def _agents(sample: Mapping[str, Any]) -> tuple[F32, Bools]:
    """Boxes (N, steps, 5) and whether they are there (N, steps), N = 0 included."""
    n = len(sample["agent_kinds"])
    boxes = np.asarray(sample["agent_boxes"], np.float32).reshape(n, AGENT_STEPS, 5)
    return boxes, np.asarray(sample["agent_valid"], bool).reshape(n, AGENT_STEPS)


def _step(time_s: float) -> int:
    step = NOW_INDEX + round(time_s * _STEPS_PER_S)
    if not 0 <= step <= NOW_INDEX:
        raise ValueError(f"bev.times_s has {time_s}: give times from -1.5 s to now, 0.0")
    return step


def _cells(points: NDArray[Any], layout: BevLayout) -> ShortInts:
    """Points (..., >= 2) [m] as OpenCV's fixed-point columns and rows, in which whole numbers are centres of cells."""
    ahead = np.array([layout.side_m, layout.ahead_m], np.float64)
    cells = (ahead - points[..., 1::-1]) / layout.cell_m - 0.5
    return np.round(cells * (1 << _SHIFT)).astype(np.int32)


def _near(shapes: Sequence[NDArray[Any]], layout: BevLayout) -> list[ShortInts]:
    """Those of the shapes (P, >= 2) whose bounds meet the raster, in cells."""
    shapes = [shape for shape in shapes if len(shape)]
    if not shapes:
        return []
    sizes = np.array([len(shape) for shape in shapes])
    starts = np.cumsum(sizes) - sizes
    cells = _cells(np.concatenate([shape[:, :2] for shape in shapes]), layout)
    low, high = np.minimum.reduceat(cells, starts), np.maximum.reduceat(cells, starts)
    rows, columns = layout.shape
    end = np.array([columns, rows]) << _SHIFT
    seen = np.flatnonzero(((high >= -(1 << _SHIFT)) & (low <= end)).all(axis=1))
    return [cells[starts[i] : starts[i] + sizes[i]] for i in seen]
