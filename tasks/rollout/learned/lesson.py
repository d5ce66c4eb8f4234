"""What leads a vehicle back to what its log did, from wherever it has come to: what a policy is fitted to. Compiled.

Within a second to the speed that the log has a second on from the nearest place, on the arc to where it then goes.
"""

import math

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.rollout.corridor import Paths, pose_on_path, project_on_path
from tasks.rollout.idm import IdmDriver, following_acceleration
from tasks.world.arrays import Array, Ints
from tasks.world.clip import STEP_S

LOOK_ON_STEPS = 10  # 1 s
FEWEST_STEPS = 3  # of the log, for its speeds to say something
NEAR_STEPS = 40  # of the log, before and after, in which the nearest place is looked for
AS_NEAR_M = 0.3  # places of the log as near as that are told apart by time
SHORTEST_ARC_M = 4.0


@kernel
def lessons(
    xy: Array, speed: Array, step: int, boxes: Array, velocities: Array, who: Ints
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Acceleration [m/s2] and curvature [1/m] (A, 2), whether each is known (A, 2), and metres to the log (A,).

    xy (S, N, 2), speed (S, N): the logs, NaN where absent; step: of them, now; boxes (B, N, 5), velocities (B, N, 2)
    of the worlds now; who (A, 2) world and agent.
    """
    wants, known, away = np.zeros((len(who), 2)), np.zeros((len(who), 2)), np.full(len(who), np.inf)
    for a in range(len(who)):
        b, i = who[a, 0], who[a, 1]
        x, y, h = boxes[b, i, 0], boxes[b, i, 1], boxes[b, i, 2]
        v = max(0.0, velocities[b, i, 0] * math.cos(h) + velocities[b, i, 1] * math.sin(h))
        first, last = max(step - NEAR_STEPS, 0), min(step + NEAR_STEPS, len(xy) - 1)
        for k in range(first, last + 1):
            distance = math.hypot(xy[k, i, 0] - x, xy[k, i, 1] - y)
            if distance < away[a]:  # never where the log is absent
                away[a] = distance
        place = -1
        for k in range(first, last + 1):
            near = math.hypot(xy[k, i, 0] - x, xy[k, i, 1] - y) <= away[a] + AS_NEAR_M
            if near and (place < 0 or abs(k - step) < abs(place - step)):
                place = k
        if place < 0:
            continue
        on = place
        while on + 1 < len(xy) and on < place + LOOK_ON_STEPS and not math.isnan(speed[on + 1, i]):
            on += 1
        if on - place >= FEWEST_STEPS:
            wants[a, 0], known[a, 0] = (speed[on, i] - v) / (STEP_S * (on - place)), 1.0
        on, arc = place, 0.0
        while on + 1 < len(xy) and arc < max(v, SHORTEST_ARC_M) and not math.isnan(xy[on + 1, i, 0]):
            arc += math.hypot(xy[on + 1, i, 0] - xy[on, i, 0], xy[on + 1, i, 1] - xy[on, i, 1])
            on += 1
        if arc >= 0.5 * SHORTEST_ARC_M:
            dx, dy = xy[on, i, 0] - x, xy[on, i, 1] - y
            across, square = dy * math.cos(h) - dx * math.sin(h), dx * dx + dy * dy
            if square > 1.0:
                wants[a, 1], known[a, 1] = 2.0 * across / square, 1.0
    return wants, known, away


@kernel
def braked_for(
    wants: Array, ways: Paths, way: Ints, driver: IdmDriver, boxes: Array, velocities: Array, who: Ints, lead: int
) -> None:
    """Lowers the accelerations (A, 2) to what IDM allows behind agent `lead`, where that is in front on the way."""
    for a in range(len(who)):
        b, i = who[a, 0], who[a, 1]
        if math.isnan(boxes[b, lead, 0]):
            continue
        h, g = boxes[b, i, 2], boxes[b, lead, 2]
        v = max(0.0, velocities[b, i, 0] * math.cos(h) + velocities[b, i, 1] * math.sin(h))
        lead_speed = velocities[b, lead, 0] * math.cos(g) + velocities[b, lead, 1] * math.sin(g)
        s = project_on_path(ways, way[i], boxes[b, i, 0], boxes[b, i, 1])[0]
        on = project_on_path(ways, way[i], boxes[b, lead, 0], boxes[b, lead, 1])[0]
        gap = on - s - 0.5 * (boxes[b, i, 3] + boxes[b, lead, 3])
        if on > s:
            wants[a, 0] = min(wants[a, 0], following_acceleration(driver.accel_max, v, gap, lead_speed, driver))


@kernel
def poses_along(ways: Paths, m: int, s: Array) -> Array:
    """(T, 3) x, y, heading of way m at path lengths (T,)."""
    out = np.empty((len(s), 3))
    for t in range(len(s)):
        out[t, 0], out[t, 1], out[t, 2] = pose_on_path(ways, m, s[t], np.inf, 0.0, 0.0, 1.0)
    return out


@kernel
def length_along(ways: Paths, m: int, x: float, y: float) -> float:
    """[m] of way m up to its point nearest to (x, y)."""
    return project_on_path(ways, m, x, y)[0]
