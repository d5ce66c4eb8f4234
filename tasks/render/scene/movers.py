"""Boxes that move: where they are at an instant, where photos say that they were, and which points are theirs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Array, Bools, FloatArray
from tasks.world.clip import STEP_S, AgentKind, AgentTracks
from tasks.world.frames import planar_matrices, wrap_angle

MARGIN_M = 0.15  # boxes are drawn tightly; mirrors and noise stick out
BEYOND_M = 0.12  # around a driving box nothing is trusted to be the street
DRIVING_M = 1.0
GROUND_CLEARANCE_M = 0.12  # the road under a car stays behind when it leaves
KNOT_S = 0.5  # between two instants that a box is off by numbers of their own: logs are annotated at 2 Hz at the least
SHIFT_SIZE = 4  # along, across, up [m], in the box as it is turned; turn [rad]


def boxes_at(agents: AgentTracks, time_s: float) -> tuple[Array, Bools]:
    """Boxes (N, 7) x, y, z of the centre, heading, length, width, height at a time since the first step; valid (N,).

    Linear between steps; valid where both neighbouring steps are.
    """
    at = np.clip(time_s / STEP_S, 0.0, agents.n_steps - 1.0)
    before = int(np.floor(at + 1e-6))
    after = min(before + 1, agents.n_steps - 1)
    share = float(np.clip(at - before, 0.0, 1.0))
    if share < 1e-3:
        after, share = before, 0.0
    first, second = agents.boxes[before], agents.boxes[after]
    xy = first[:, :2] * (1 - share) + second[:, :2] * share
    z = agents.center_z[before] * (1 - share) + agents.center_z[after] * share
    heading = first[:, 2] + share * wrap_angle(second[:, 2] - first[:, 2])
    boxes = np.column_stack([xy, z, heading, first[:, 3:5], agents.heights])
    return boxes, agents.valid[before] & agents.valid[after]


def lift_tracks(agents: AgentTracks, times_s: Array, rises_m: Array) -> AgentTracks:
    """The tracks moved up by `rises_m` (T,) at `times_s` (T,), ascending, in seconds since their first step.

    A box is logged as high as its sensor saw it above the ego's own road; where photos say that this lies higher or
    lower than the log has it, so does the box. What they say of the ego's place in the plane moves no box: on nuScenes,
    where boxes come with better poses than photos here, they fit the photos as they are.
    """
    if len(times_s) == 0:
        return agents
    rise = np.interp(np.arange(agents.n_steps) * STEP_S, times_s, rises_m)
    return replace(agents, center_z=agents.center_z + rise[:, None])


@dataclass(frozen=True)
class BoxShifts:
    """How far tracks were from where they were logged, as photos say: at knots every KNOT_S, linear between them."""

    track_ids: tuple[str, ...]
    rows: F32  # (N, K, SHIFT_SIZE); knot 0 is the block's first step

    def at(self, time_s: float, track_ids: Sequence[str]) -> F32:
        """(M, SHIFT_SIZE) of the tracks named, `time_s` since the block's first step; zeros of others."""
        known = {name: n for n, name in enumerate(self.track_ids)}
        out = np.zeros((len(track_ids), SHIFT_SIZE), np.float32)
        mine = [m for m, name in enumerate(track_ids) if name in known]
        if mine:
            out[mine] = interpolate_knots(self.rows[[known[track_ids[m]] for m in mine]], time_s)
        return out

    def select(self, track_ids: Sequence[str]) -> "BoxShifts":
        """Of these tracks alone."""
        rows = [self.track_ids.index(name) for name in track_ids]
        return BoxShifts(tuple(track_ids), self.rows[rows])

    def settled(self, agents: AgentTracks, first_s: float) -> AgentTracks:
        """The tracks, whose first step is at `first_s` of the block, where photos say that they were."""
        if not self.track_ids:
            return agents
        boxes, center_z = agents.boxes.copy(), agents.center_z.copy()
        for k in range(agents.n_steps):
            at = np.column_stack([boxes[k, :, :2], center_z[k], boxes[k, :, 2], boxes[k, :, 3:], agents.heights])
            there = shift_boxes(at, self.at(first_s + k * STEP_S, agents.track_ids))
            boxes[k, :, :2], center_z[k], boxes[k, :, 2] = there[:, :2], there[:, 2], there[:, 3]
        return replace(agents, boxes=boxes, center_z=center_z)


NO_SHIFTS = BoxShifts((), np.zeros((0, 1, SHIFT_SIZE), np.float32))


def knots_at(time_s: float, n_knots: int) -> tuple[int, float]:
    """The knot before a time, and the share that the one behind it has of what is so then."""
    at = float(np.clip(time_s / KNOT_S, 0.0, n_knots - 1.0))
    before = min(int(at), max(n_knots - 2, 0))
    return before, at - before


def interpolate_knots(rows: F32, time_s: float) -> F32:
    """(N, C) of rows (N, K, C) at a time."""
    before, share = knots_at(time_s, rows.shape[1])
    after = min(before + 1, rows.shape[1] - 1)
    return np.asarray((1.0 - share) * rows[:, before] + share * rows[:, after], np.float32)


def shift_boxes(boxes: Array, by: FloatArray) -> Array:
    """Boxes (N, 7) turned, then moved in their own axes, by rows (N, SHIFT_SIZE)."""
    out = boxes.copy()
    out[:, 3] += by[:, 3]
    cosine, sine = np.cos(out[:, 3]), np.sin(out[:, 3])
    out[:, 0] += cosine * by[:, 0] - sine * by[:, 1]
    out[:, 1] += sine * by[:, 0] + cosine * by[:, 1]
    out[:, 2] += by[:, 2]
    return out


def world_from_boxes(boxes: Array) -> Array:
    """Poses (N, 4, 4) of boxes (N, 7): origin at the centre, x along the heading, z up."""
    poses = planar_matrices(boxes[:, [0, 1, 3]])
    poses[:, 2, 3] = boxes[:, 2]
    return poses


@dataclass(frozen=True)
class PlacedAgents:
    """Who is in the scene, and where: vehicles, pedestrians and bicycles."""

    track_ids: tuple[str, ...]
    kinds: tuple[AgentKind, ...]
    boxes: Array  # (N, 7) x, y, z of the centre, heading, length, width, height; world [m, rad]


NOBODY = PlacedAgents((), (), np.zeros((0, 7)))


def agents_at_time(
    agents: AgentTracks, time_s: float, around: Array | None = None, reach_m: float = np.inf
) -> PlacedAgents:
    """The tracks that are there at a time since their first step; given a place `around` (2,), those within reach."""
    boxes, valid = boxes_at(agents, time_s)
    if around is not None:
        valid = valid & (np.hypot(*(boxes[:, :2] - around).T) < reach_m)
    rows = np.flatnonzero(valid)
    return PlacedAgents(tuple(agents.track_ids[j] for j in rows), tuple(agents.kinds[j] for j in rows), boxes[rows])


def ever_moves(agents: AgentTracks) -> Bools:
    """(N,) tracks that leave their place at some time; the others may be taken for part of the street."""
    first = np.argmax(agents.valid, axis=0)
    start = agents.boxes[first, np.arange(len(agents)), :2]
    away = np.linalg.norm(agents.boxes[..., :2] - start, axis=-1)
    return np.asarray((np.where(agents.valid, away, 0.0) > DRIVING_M).any(axis=0))


@kernel
def behind_boxes(points: Any, eye: Any, boxes: Any) -> Any:
    """Whether the sight line from `eye` (3,) to a point (M, 3), and a little further, meets a moving box (N, 7): (M,).

    Such a pixel shows the mover, its shadow or its edge: nothing that stays.
    """
    out = np.zeros(points.shape[0], np.bool_)
    cosines, sines = np.cos(boxes[:, 3]), np.sin(boxes[:, 3])
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        length = dx * dx + dy * dy + dz * dz
        for j in range(boxes.shape[0]):
            ex, ey, ez = eye[0] - boxes[j, 0], eye[1] - boxes[j, 1], eye[2] - boxes[j, 2]
            reach = 0.0  # of a ball around the box, squared: most lines miss most balls, which is soon known
            for k in range(4, 7):
                half = 0.5 * boxes[j, k] + 2.0 * BEYOND_M
                reach += half * half
            along = ex * dx + ey * dy + ez * dz
            if (ex * ex + ey * ey + ez * ez - reach) * length > along * along:
                continue
            enter, leave = 0.0, 1.0 + BEYOND_M / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-3)
            for axis in range(3):
                if axis == 0:
                    start, step, half = cosines[j] * ex + sines[j] * ey, cosines[j] * dx + sines[j] * dy, boxes[j, 4]
                elif axis == 1:
                    start, step, half = cosines[j] * ey - sines[j] * ex, cosines[j] * dy - sines[j] * dx, boxes[j, 5]
                else:
                    start, step, half = ez, dz, boxes[j, 6]
                half = 0.5 * half + BEYOND_M
                if abs(step) < 1e-9:
                    if abs(start) > half:
                        leave = -1.0
                    continue
                a, b = (-half - start) / step, (half - start) / step
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            if enter <= leave:
                out[i] = True
                break
    return out


@kernel
def box_of_points(points: Any, boxes: Any, movable: Any) -> Any:
    """Row of the box each point (M, 3) lies in, -1 for none; the box with the nearest centre wins.

    `boxes` (N, 7), `movable` (N,) False: box is not looked at.
    """
    out = np.full(points.shape[0], -1, np.int32)
    cosines, sines = np.cos(boxes[:, 3]), np.sin(boxes[:, 3])
    for i in range(points.shape[0]):
        nearest = np.inf
        for j in range(boxes.shape[0]):
            if not movable[j]:
                continue
            dx, dy, dz = points[i, 0] - boxes[j, 0], points[i, 1] - boxes[j, 1], points[i, 2] - boxes[j, 2]
            along = cosines[j] * dx + sines[j] * dy
            across = cosines[j] * dy - sines[j] * dx
            half_height = 0.5 * boxes[j, 6]
            if abs(along) > 0.5 * boxes[j, 4] + MARGIN_M or abs(across) > 0.5 * boxes[j, 5] + MARGIN_M:
                continue
            if dz > half_height + MARGIN_M or dz < -half_height + GROUND_CLEARANCE_M:
                continue
            distance = dx * dx + dy * dy
            if distance < nearest:
                nearest, out[i] = distance, j
    return out
