"""What the fitted policy sees of one vehicle: itself, its way, who is in its way, and its neighbours. Compiled.

All in the vehicle's own frame and of a size near 1, so that a network needs no statistics of its data.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.rollout.corridor import Paths, project_on_path
from tasks.rollout.idm import stop_line_gap
from tasks.rollout.learned.policy import SEEN_ROWS, SeenWorlds
from tasks.rollout.rules import cell_of
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.geometry import wrapped

OWN, NEAR, NEIGHBOURS = 29, 13, 8  # numbers of oneself, of each neighbour, and neighbours: the nearest
PURSUIT = 28  # column of the curvature [1/m] that leads onto the way a second on
COLUMNS = [1, OWN, NEAR, NEIGHBOURS]  # in a file of weights; the first is raised by hand where a column changes
NEAR_M = 40.0  # of a neighbour's centre
AHEAD_M = 60.0  # of the way, for leaders and stop lines
MARGIN_M = 0.1  # beside the body, each side
FADES_M = 20.0  # of way on which the offset to it is thought to be given up
SMALLEST_GAP_M = 0.5
SHORTEST_PURSUIT_M = 4.0
HALF, NOW = SEEN_ROWS // 2, SEEN_ROWS - 1  # rows
LOOKS_M = (4.0, 8.0, 15.0, 25.0, 40.0)  # along the way, where it is asked how it bends
COMFORTABLE_MPS2 = 2.0  # of braking for a yellow light
VEHICLE = 0


@kernel
def asked_of(asked: Bools) -> Ints:
    """(A, 2) world and agent of everyone who is asked, world by world."""
    out, n = np.empty((asked.size, 2), np.int64), 0
    for b in range(asked.shape[0]):
        for i in range(asked.shape[1]):
            if asked[b, i]:
                out[n, 0], out[n, 1] = b, i
                n += 1
    return out[:n].copy()


@kernel
def look(seen: SeenWorlds, ways: Paths, way: Ints, who: Ints) -> tuple[Array, Array, Ints]:
    """(A, OWN) of themselves, (A, NEIGHBOURS, NEAR) of their neighbours, nearest first, and how many those are (A,).

    who: (A, 2) world and agent.
    """
    own = np.zeros((len(who), OWN))
    near = np.zeros((len(who), NEIGHBOURS, NEAR))
    count = np.zeros(len(who), np.int64)
    for a in range(len(who)):
        _see_oneself(seen, ways, way, who[a, 0], who[a, 1], a, own)
        _see_leader(seen, ways, way, who[a, 0], who[a, 1], a, own)
        count[a] = _see_neighbours(seen, who[a, 0], who[a, 1], a, near)
    return own, near, count


@inner_kernel
def forward_speed(seen: SeenWorlds, row: int, b: int, i: int) -> float:
    """[m/s] along the heading, never below 0."""
    h = seen.boxes[row, b, i, 2]
    return max(0.0, seen.velocities[row, b, i, 0] * math.cos(h) + seen.velocities[row, b, i, 1] * math.sin(h))


@inner_kernel
def _see_oneself(seen: SeenWorlds, ways: Paths, way: Ints, b: int, i: int, a: int, own: Array) -> None:
    m, h = way[i], seen.boxes[NOW, b, i, 2]
    speed = forward_speed(seen, NOW, b, i)
    s, left = project_on_path(ways, m, seen.boxes[NOW, b, i, 0], seen.boxes[NOW, b, i, 1])
    here = cell_of(ways, s)
    own[a, 0] = speed / 10.0
    if seen.valid[HALF, b, i]:
        own[a, 1] = (speed - forward_speed(seen, HALF, b, i)) / 1.5
        own[a, 2] = 4.0 * wrapped(h - seen.boxes[HALF, b, i, 2])
        if seen.valid[0, b, i]:
            own[a, 3] = (forward_speed(seen, HALF, b, i) - forward_speed(seen, 0, b, i)) / 1.5
    own[a, 4] = seen.boxes[NOW, b, i, 3] / 5.0
    own[a, 5] = min(max(left, -3.0), 3.0)
    own[a, 6] = 2.0 * math.sin(h - ways.heading[m, here])
    for k in range(len(LOOKS_M)):
        there = cell_of(ways, s + LOOKS_M[k])
        own[a, 7 + k] = ways.heading[m, there] - ways.heading[m, here]
    slowest = ways.target_speed[m, here]
    own[a, 12] = slowest / 10.0
    for p in range(here, cell_of(ways, s + 3.0 * speed + 5.0)):
        slowest = min(slowest, ways.target_speed[m, p])
    own[a, 13] = slowest / 10.0
    nose = s + 0.5 * seen.boxes[NOW, b, i, 3]
    gap = stop_line_gap(ways, m, 0, nose, speed, COMFORTABLE_MPS2)
    _put_gap(gap, speed, 0.0, a, 14, own)
    there = cell_of(ways, s + max(speed, SHORTEST_PURSUIT_M))
    dx, dy = ways.xy[m, there, 0] - seen.boxes[NOW, b, i, 0], ways.xy[m, there, 1] - seen.boxes[NOW, b, i, 1]
    across, square = dy * math.cos(h) - dx * math.sin(h), dx * dx + dy * dy
    own[a, PURSUIT] = 2.0 * across / max(square, 1.0)


@inner_kernel
def _put_gap(gap: float, speed: float, lead_speed: float, a: int, at: int, own: Array) -> None:
    """Seven numbers of what is `gap` ahead: there or not, how near, in seconds, how fast, what braking it asks for."""
    if gap > AHEAD_M:
        own[a, at + 3] = 1.0
        return
    gap = max(gap, SMALLEST_GAP_M)
    closing = max(speed - lead_speed, 0.0)
    own[a, at] = 1.0
    own[a, at + 1] = 10.0 / (10.0 + gap)
    own[a, at + 2] = 3.0 / (3.0 + gap)
    own[a, at + 3] = min(gap / max(speed, 0.5), 4.0) / 4.0
    own[a, at + 4] = min(max((speed - lead_speed) / 10.0, -1.0), 1.5)
    own[a, at + 5] = min(closing * closing / (2.0 * gap), 8.0) / 4.0
    own[a, at + 6] = min(speed * speed / (2.0 * gap + lead_speed * lead_speed / 8.0), 8.0) / 4.0


@inner_kernel
def _see_leader(seen: SeenWorlds, ways: Paths, way: Ints, b: int, i: int, a: int, own: Array) -> None:
    """Whoever's box reaches nearest into the strip that the body will sweep along its way."""
    m = way[i]
    x, y, h = seen.boxes[NOW, b, i, 0], seen.boxes[NOW, b, i, 1], seen.boxes[NOW, b, i, 2]
    s, left = project_on_path(ways, m, x, y)
    front, half_width = 0.5 * seen.boxes[NOW, b, i, 3], 0.5 * seen.boxes[NOW, b, i, 4] + MARGIN_M
    least, lead_speed = np.inf, 0.0
    for j in range(seen.valid.shape[2]):
        if j == i or not seen.valid[NOW, b, j]:
            continue
        dx, dy = seen.boxes[NOW, b, j, 0] - x, seen.boxes[NOW, b, j, 1] - y
        if dx * dx + dy * dy > (AHEAD_M + 10.0) ** 2 or dx * math.cos(h) + dy * math.sin(h) < -25.0:
            continue
        at, beside = project_on_path(ways, m, seen.boxes[NOW, b, j, 0], seen.boxes[NOW, b, j, 1])
        there = ways.heading[m, cell_of(ways, at)]
        turn = seen.boxes[NOW, b, j, 2] - there
        c, d = abs(math.cos(turn)), abs(math.sin(turn))
        half_along = 0.5 * (seen.boxes[NOW, b, j, 3] * c + seen.boxes[NOW, b, j, 4] * d)
        half_across = 0.5 * (seen.boxes[NOW, b, j, 3] * d + seen.boxes[NOW, b, j, 4] * c)
        middle = left * max(0.0, 1.0 - (at - s) / FADES_M)
        gap = at - half_along - s - front
        if at > s and abs(beside - middle) < half_width + half_across and gap < least:
            least = gap
            lead_speed = seen.velocities[NOW, b, j, 0] * math.cos(there) + seen.velocities[NOW, b, j, 1] * math.sin(
                there
            )
    _put_gap(least, forward_speed(seen, NOW, b, i), lead_speed, a, 21, own)


@inner_kernel
def _see_neighbours(seen: SeenWorlds, b: int, i: int, a: int, near: Array) -> int:
    """The nearest, nearest first; of equally near ones the first."""
    x, y, h = seen.boxes[NOW, b, i, 0], seen.boxes[NOW, b, i, 1], seen.boxes[NOW, b, i, 2]
    c, s = math.cos(h), math.sin(h)
    farther, after, count = -1.0, -1, 0
    while count < NEIGHBOURS:
        best, which = NEAR_M * NEAR_M, -1
        for j in range(seen.valid.shape[2]):
            if j == i or not seen.valid[NOW, b, j]:
                continue
            square = (seen.boxes[NOW, b, j, 0] - x) ** 2 + (seen.boxes[NOW, b, j, 1] - y) ** 2
            if square < best and (square > farther or (square == farther and j > after)):
                best, which = square, j
        if which < 0:
            break
        farther, after = best, which
        dx, dy = seen.boxes[NOW, b, which, 0] - x, seen.boxes[NOW, b, which, 1] - y
        u, v = dx * c + dy * s, dy * c - dx * s
        vx = seen.velocities[NOW, b, which, 0] - seen.velocities[NOW, b, i, 0]
        vy = seen.velocities[NOW, b, which, 1] - seen.velocities[NOW, b, i, 1]
        vu, vv = vx * c + vy * s, vy * c - vx * s
        turn = wrapped(seen.boxes[NOW, b, which, 2] - h)
        approach = min(max(-(u * vu + v * vv) / max(vu * vu + vv * vv, 0.1), 0.0), 4.0)  # [s] until they are nearest
        near[a, count, 0], near[a, count, 1] = u / 20.0, v / 10.0
        near[a, count, 2], near[a, count, 3] = math.cos(turn), math.sin(turn)
        near[a, count, 4], near[a, count, 5] = vu / 10.0, vv / 10.0
        near[a, count, 6], near[a, count, 7] = seen.boxes[NOW, b, which, 3] / 5.0, seen.boxes[NOW, b, which, 4] / 2.0
        near[a, count, 8] = 1.0 if seen.kinds[which] == VEHICLE else 0.0
        near[a, count, 9] = approach / 4.0
        near[a, count, 10] = (u + vu * approach) / 10.0
        near[a, count, 11] = (v + vv * approach) / 10.0
        near[a, count, 12] = 5.0 / (5.0 + math.hypot(u, v))
        count += 1
    return count
