"""What the fitted traffic policy sees and wants, slowly: one vehicle at a time, in plain numpy and shapely."""

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.rollout.corridor import Paths
from tasks.rollout.learned.imitation import NetworkWeights
from tasks.rollout.learned.policy import KIND_NUMBER, SeenWorlds
from tasks.world.agents import AgentKind
from tasks.world.frames import wrap_angle

Array = NDArray[np.float64]


def along(ways: Paths, m: int, xy: Array) -> tuple[float, float]:
    """Path length of the nearest point of the way, and the offset to the left of it."""
    line, point = shapely.LineString(ways.xy[m]), shapely.Point(xy)
    s = shapely.line_locate_point(line, point)
    k = min(int(s / 0.5), len(ways.xy[m]) - 2)
    edge, beside = ways.xy[m, k + 1] - ways.xy[m, k], xy - ways.xy[m, k]
    return float(s), float(np.sign(edge[0] * beside[1] - edge[1] * beside[0]) * shapely.distance(line, point))


def heading_at(ways: Paths, m: int, s: float) -> float:
    return float(ways.heading[m, min(max(round(s / 0.5), 0), ways.heading.shape[1] - 1)])


def gap_numbers(gap: float, speed: float, lead_speed: float) -> list[float]:
    if gap > 60.0:
        return [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    gap, closing = max(gap, 0.5), max(speed - lead_speed, 0.0)
    return [
        1.0,
        10.0 / (10.0 + gap),
        3.0 / (3.0 + gap),
        min(gap / max(speed, 0.5), 4.0) / 4.0,
        float(np.clip((speed - lead_speed) / 10.0, -1.0, 1.5)),
        min(closing**2 / (2.0 * gap), 8.0) / 4.0,
        min(speed**2 / (2.0 * gap + lead_speed**2 / 8.0), 8.0) / 4.0,
    ]


def speed_of(seen: SeenWorlds, row: int, b: int, i: int) -> float:
    h = seen.boxes[row, b, i, 2]
    return max(0.0, float(seen.velocities[row, b, i] @ [np.cos(h), np.sin(h)]))


def oneself(seen: SeenWorlds, ways: Paths, way: NDArray[np.int64], b: int, i: int) -> Array:
    """(OWN,)"""
    m, (x, y, h, length, width) = way[i], seen.boxes[-1, b, i]
    v = speed_of(seen, 10, b, i)
    s, left = along(ways, m, np.array([x, y]))
    history = [0.0, 0.0, 0.0]
    if seen.valid[5, b, i]:
        history[:2] = [(v - speed_of(seen, 5, b, i)) / 1.5, 4.0 * float(wrap_angle(h - seen.boxes[5, b, i, 2]))]
        if seen.valid[0, b, i]:
            history[2] = (speed_of(seen, 5, b, i) - speed_of(seen, 0, b, i)) / 1.5
    here = heading_at(ways, m, s)
    bends = [heading_at(ways, m, s + at) - here for at in (4.0, 8.0, 15.0, 25.0, 40.0)]
    first, last = (min(max(round(at / 0.5), 0), ways.heading.shape[1] - 1) for at in (s, s + 3.0 * v + 5.0))
    limits = [ways.target_speed[m, first] / 10.0, ways.target_speed[m, first : max(last, first + 1)].min() / 10.0]
    closed = np.inf
    for q in range(ways.line_start[m], ways.line_start[m + 1]):
        distance = ways.line_at[q] - s - 0.5 * length
        passes_yellow = ways.line_state[0, q] == 1 and v**2 > 4.0 * distance
        if ways.line_state[0, q] and not passes_yellow and (distance >= 0.0 or (distance > -1.0 and v < 1.0)):
            closed = min(closed, max(distance, 0.0))
    gap, lead_speed = np.inf, 0.0
    for j in range(seen.valid.shape[2]):
        if j == i or not seen.valid[-1, b, j]:
            continue
        box = seen.boxes[-1, b, j]
        if np.hypot(*(box[:2] - [x, y])) > 70.0 or (box[:2] - [x, y]) @ [np.cos(h), np.sin(h)] < -25.0:
            continue
        at, beside = along(ways, m, box[:2])
        there = heading_at(ways, m, at)
        c, d = abs(np.cos(box[2] - there)), abs(np.sin(box[2] - there))
        off = beside - left * max(0.0, 1.0 - (at - s) / 20.0)
        if at > s and abs(off) < 0.5 * width + 0.1 + 0.5 * (box[3] * d + box[4] * c):
            bumpers = at - s - 0.5 * length - 0.5 * (box[3] * c + box[4] * d)
            if bumpers < gap:
                gap, lead_speed = bumpers, seen.velocities[-1, b, j] @ [np.cos(there), np.sin(there)]
    chord = ways.xy[m, min(max(round((s + max(v, 4.0)) / 0.5), 0), ways.heading.shape[1] - 1)] - [x, y]
    pursuit = 2.0 * (chord @ [-np.sin(h), np.cos(h)]) / max(chord @ chord, 1.0)
    own = [v / 10.0, *history, length / 5.0, np.clip(left, -3.0, 3.0), 2.0 * np.sin(h - here)]
    return np.array([*own, *bends, *limits, *gap_numbers(closed, v, 0.0), *gap_numbers(gap, v, lead_speed), pursuit])


def neighbours(seen: SeenWorlds, b: int, i: int) -> Array:
    """(n, NEAR) of the eight nearest at most, nearest first."""
    x, y, h = seen.boxes[-1, b, i, :3]
    own = np.array([[np.cos(h), np.sin(h)], [-np.sin(h), np.cos(h)]])
    found = []
    for j in np.flatnonzero(seen.valid[-1, b]):
        box = seen.boxes[-1, b, j]
        apart = np.hypot(*(box[:2] - [x, y]))
        if j == i or apart >= 40.0:
            continue
        (u, v), (vu, vv) = own @ (box[:2] - [x, y]), own @ (seen.velocities[-1, b, j] - seen.velocities[-1, b, i])
        approach = float(np.clip(-(u * vu + v * vv) / max(vu**2 + vv**2, 0.1), 0.0, 4.0))
        turn, is_vehicle = box[2] - h, seen.kinds[j] == KIND_NUMBER[AgentKind.VEHICLE]
        row = [u / 20.0, v / 10.0, np.cos(turn), np.sin(turn), vu / 10.0, vv / 10.0, box[3] / 5.0, box[4] / 2.0]
        row += [float(is_vehicle), approach / 4.0, (u + vu * approach) / 10.0, (v + vv * approach) / 10.0]
        found.append((apart, j, [*row, 5.0 / (5.0 + apart)]))
    return np.array([row for *_, row in sorted(found)[:8]]).reshape(-1, 13)


def wants(weights: NetworkWeights, own: Array, near: Array) -> Array:
    """(2,) of one vehicle: own (OWN,), near (n, NEAR)."""
    w = weights
    pooled = np.maximum(near @ w.near_weight + w.near_bias, 0.0).max(axis=0, initial=0.0)
    hidden = np.maximum(np.concatenate([own, pooled]) @ w.first_weight + w.first_bias, 0.0)
    last = np.maximum(hidden @ w.second_weight + w.second_bias, 0.0) @ w.last_weight + w.last_bias
    return np.array([3.0 * last[0], own[28] + 0.02 * np.tanh(last[1])])
