"""The ego's body along one trajectory, and the route's centreline that it keeps to (docs/reward.md 2e, 2f, 2h)."""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.trig import sincos
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import HORIZON_STEPS
from tasks.world.frames import EGO_STATE_SIZE, HEADING, VX, VY, X, Y

# Bits of an instant's flags (docs/reward.md 2a)
MULTIPLE_LANES = 1  # corners in more than one lane, and no lane holds all four
NON_DRIVABLE = 2  # some corner is in no drivable polygon
ONCOMING = 4  # the centre is in no lane of the route
CENTER_IN_INTERSECTION = 8
LANES_KNOWN = 16  # MULTIPLE_LANES holds
OFF_LANE = MULTIPLE_LANES | NON_DRIVABLE  # where a lateral contact is the ego's fault


class Body(NamedTuple):
    """Scratch for T instants of one trajectory, or of several one after the other; world frame."""

    x: Array  # (T,) centre of the body [m]
    y: Array  # (T,)
    cos: Array  # (T,) of the heading
    sin: Array  # (T,)
    speed: Array  # (T,) hypot(vx, vy) [m/s]
    flags: Bytes  # (T,) bits above


def as_states(name: str, states: Array) -> Array:
    """Contiguous float64 states (K >= 1, 41, 11) of any values. Raises ValueError where they are of another shape."""
    states = np.ascontiguousarray(states, dtype=np.float64)
    if states.ndim != 3 or states.shape[1:] != (HORIZON_STEPS + 1, EGO_STATE_SIZE) or len(states) == 0:
        raise ValueError(f"{name} must be (K >= 1, {HORIZON_STEPS + 1}, {EGO_STATE_SIZE}), got {states.shape}")
    return states if states.flags.writeable else states.copy()


@register_jitable
def empty_body(n_times: int) -> Body:
    """Scratch to be filled by `place_body`."""
    return Body(
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.zeros(n_times, np.uint8),
    )


@inlined
def instants_of(body: Body, start: int, stop: int) -> Body:
    """Some of the instants."""
    x, y, cos, sin = body.x[start:stop], body.y[start:stop], body.cos[start:stop], body.sin[start:stop]
    return Body(x, y, cos, sin, body.speed[start:stop], body.flags[start:stop])


@kernel
def place_body(states: Array, rear_axle_to_center: float, body: Body) -> None:
    """Fill everything but the flags from states (T, 11); their pose is the rear axle."""
    x, y, cos, sin, speed = body.x, body.y, body.cos, body.sin, body.speed
    for t in range(len(x)):
        x[t], y[t], cos[t] = states[t, X], states[t, Y], states[t, HEADING]
        speed[t] = states[t, VX] * states[t, VX] + states[t, VY] * states[t, VY]
    for t in range(len(x)):
        sin[t], cos[t] = sincos(cos[t])
    for t in range(len(x)):
        x[t] += rear_axle_to_center * cos[t]
        y[t] += rear_axle_to_center * sin[t]
        speed[t] = math.sqrt(speed[t])


# The centreline, indexed once: where along it a point lies, whether points are off it. Both answers are GEOS' to the
# last bit: the same differences, products and quotients, on the segments that can matter. Which can, circles around
# chunks of segments say.

DEVIATION_M = 0.5  # farther than this is off the centreline
CHUNK = 8  # segments within one circle
SLACK_M = 1e-6  # circles reach farther by this: far more than rounding
SLACK = 1.0 + 1e-9  # and by this factor, for points far away


class Centerline(NamedTuple):
    """S segments in C chunks, world frame. Few arrays, as compiled calls pay for each."""

    segments: Array  # (S, 6) [m] start x, y; end x, y; length, 0 where a point repeats; arc length at the start
    circles: Array  # (C, 3) [m] a point of the chunk, x and y, about its middle; radius that holds the chunk


def index_centerline(points: Array) -> Centerline:
    """Index the points (P >= 2, >= 2) of a centreline: world x, y [m], then any other columns. Points may repeat.

    Raises ValueError for a line without length.
    """
    xy = np.asarray(points, dtype=np.float64)[:, :2]
    line = line_through(np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]))
    if line.segments[-1, 4:].sum() == 0.0:
        raise ValueError("centerline must have a length, got 0 m; give it two points that differ")
    return line


@kernel
def line_through(x: Array, y: Array) -> Centerline:
    """The index of a line through points (P >= 2,) [m]."""
    n = len(x) - 1
    segments, circles = np.empty((n, 6)), np.empty(((n + CHUNK - 1) // CHUNK, 3))
    along = 0.0
    for i in range(n):
        dx, dy = x[i + 1] - x[i], y[i + 1] - y[i]
        length = math.sqrt(dx * dx + dy * dy)
        segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3] = x[i], y[i], x[i + 1], y[i + 1]
        segments[i, 4], segments[i, 5] = length, along
        along += length
    for c in range(len(circles)):
        first, last = c * CHUNK, min((c + 1) * CHUNK, n)
        middle, radius = first + (last - first + 1) // 2, 0.0
        for i in range(first, last + 1):
            radius = max(radius, math.hypot(x[i] - x[middle], y[i] - y[middle]))
        circles[c, 0], circles[c, 1], circles[c, 2] = x[middle], y[middle], radius * SLACK + SLACK_M
    return Centerline(segments, circles)


@inlined
def nearest_on_segment(segments: Array, i: int, x: float, y: float) -> tuple[float, float]:
    """Distance [m] of (x, y) to segment i, and the arc length [m] from the segment's start to the nearest place."""
    from_x, from_y = x - segments[i, 0], y - segments[i, 1]
    dx, dy = segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1]
    length = segments[i, 4]
    length_sq = dx * dx + dy * dy
    share = (from_x * dx + from_y * dy) / length_sq if length_sq > 0.0 else 0.0
    if share <= 0.0:
        return math.sqrt(from_x * from_x + from_y * from_y), 0.0
    if share >= 1.0:
        to_x, to_y = x - segments[i, 2], y - segments[i, 3]
        return math.sqrt(to_x * to_x + to_y * to_y), length
    aside = (from_x * dy - from_y * dx) / length_sq
    return abs(aside) * length, share * length


@kernel
def arc_length_at(line: Centerline, x: float, y: float) -> float:
    """Arc length [m] of the centreline's point nearest to (x, y), the first of several; beyond its ends: the end's."""
    circles, segments = line.circles, line.segments
    nearest_sq = math.inf
    for c in range(len(circles)):
        dx, dy = x - circles[c, 0], y - circles[c, 1]
        nearest_sq = min(nearest_sq, dx * dx + dy * dy)
    at_most = math.sqrt(nearest_sq) * SLACK  # each centre is a point of the line
    nearest, place = math.inf, 0.0
    for c in range(len(circles)):
        dx, dy, reach = x - circles[c, 0], y - circles[c, 1], at_most + circles[c, 2]
        if dx * dx + dy * dy <= reach * reach:
            for i in range(c * CHUNK, min((c + 1) * CHUNK, len(segments))):
                distance, along = nearest_on_segment(segments, i, x, y)
                if distance < nearest:
                    nearest, place = distance, segments[i, 5] + along
    return place


@kernel
def progress_m(line: Centerline, x0: float, y0: float, x1: float, y1: float, begun: Array) -> float:
    """EP raw [m]: arc length gained along the centreline from (x0, y0) to (x1, y1), at least 0.

    begun: (3,) scratch: where the drive before began, x (NaN: none), y and arc length [m]. Most begin at one place.
    """
    if begun[0] != x0 or begun[1] != y0:
        begun[0], begun[1], begun[2] = x0, y0, arc_length_at(line, x0, y0)
    return max(0.0, arc_length_at(line, x1, y1) - begun[2])


@kernel
def is_off_centerline(line: Centerline, x: float, y: float) -> bool:
    """Whether (x, y) is more than DEVIATION_M from the centreline."""
    circles, segments = line.circles, line.segments
    for c in range(len(circles)):
        dx, dy, reach = x - circles[c, 0], y - circles[c, 1], DEVIATION_M + circles[c, 2]
        if dx * dx + dy * dy <= reach * reach:
            for i in range(c * CHUNK, min((c + 1) * CHUNK, len(segments))):
                if nearest_on_segment(segments, i, x, y)[0] <= DEVIATION_M:
                    return False
    return True


# Keeping to the lane's middle and to its direction (docs/reward.md 2e, 2h).

LK_STEPS = 20  # 2.0 s
DDC_WINDOW = 11  # indices t - 10 .. t, the public 1.0 s
DDC_TOLERATED_M, DDC_FAILED_M = 2.0, 6.0


@kernel
def lane_keeping_failure(line: Centerline, body: Body) -> float:
    """The time index that completes 20 steps in a row off the centreline, inf where there is none.

    Steps inside an intersection neither count nor interrupt the count. A step is only looked at when 20 could be
    complete with it, the newest first: one on the centreline ends every run before it.
    """
    x, y, flags = body.x, body.y, body.flags
    off, unseen = 0, 0  # the counted steps so far that may be one run: first those known to be off, then the others
    for t in range(len(flags)):
        if flags[t] & CENTER_IN_INTERSECTION:
            continue
        unseen += 1
        if off + unseen < LK_STEPS:
            continue
        seen, back = 0, t
        while seen < unseen:
            if not flags[back] & CENTER_IN_INTERSECTION:
                if not is_off_centerline(line, x[back], y[back]):
                    break
                seen += 1
            back -= 1
        if seen == unseen:
            return float(t)
        off, unseen = seen, 0
    return math.inf


@kernel
def driving_direction_compliance(body: Body, moved: Array) -> tuple[float, float]:
    """DDC in {0, 0.5, 1}, and the first time index with 2 m or more against traffic within 1 s (inf: none).

    moved: (10 + 41,) scratch.
    """
    x, y, flags = body.x, body.y, body.flags
    n = len(x)
    any_oncoming = False
    for t in range(1, n):
        any_oncoming |= (flags[t] & (ONCOMING | CENTER_IN_INTERSECTION)) == ONCOMING
    if not any_oncoming:
        return 1.0, math.inf
    before = DDC_WINDOW - 1
    for t in range(len(moved)):
        moved[t] = 0.0  # from the step before, where that is against traffic
    for t in range(1, n):
        if (flags[t] & (ONCOMING | CENTER_IN_INTERSECTION)) == ONCOMING:
            moved[before + t] = math.hypot(x[t] - x[t - 1], y[t] - y[t - 1])
    worst, first = 0.0, math.inf
    for t in range(n):
        m = moved[t : t + DDC_WINDOW]
        # numpy's order of adding 11 values
        recent = ((m[0] + m[1]) + (m[2] + m[3])) + ((m[4] + m[5]) + (m[6] + m[7])) + m[8] + m[9] + m[10]
        if recent >= DDC_TOLERATED_M and first == math.inf:
            first = float(t)
        worst = max(worst, recent)
    return (1.0 if worst < DDC_TOLERATED_M else 0.5 if worst < DDC_FAILED_M else 0.0), first
