"""Boxes that touch all their life are one articulated vehicle: a truck cab and its trailer, a car and its caravan.

Labels have a box and a track for each part. Nobody else drives so near: two vehicles are coupled where, of the frames
they share, they touch in at least half, in all and in those in which they drive, and are never farther apart than
labels wander. The numbers are chosen on real logs: the cab and trailer of AV2's 7fab2350 overlap or touch in 65 % of
their frames, 53 % in the worst window, and are 3.2 m apart at most, since far boxes wander along the road; cars that
stay one behind the other in a queue touch in no frame (nuScenes, eight scenes: 0.55 m and more between them).
"""

import math

import numpy as np

from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.geometry import touching
from tasks.world.repair.records import Repair

TOUCHES_M, TOUCHES_S = 0.5, 0.1  # between two parts: a drawbar, and what no driver follows as near as
TOUCHES_IN = 0.5  # of the frames
APART_M = 4.0  # in any frame: then each goes its own way
LOOK_STEPS = 8  # of every so many frames one tells which vehicles are worth a look at all of them
SLACK = 1.5  # boxes are that much nearer to each other at a corner
SHARED = 0.8  # of both lives
DRIVES_MPS, DRIVES_STEPS = 2.0, 5  # as fast for as long: parked cars and those that wait are not coupled
MOVES_M = 2.0  # from where it is first seen


def couplings(agents: AgentTracks) -> tuple[tuple[int, int], ...]:
    """Pairs (front, towed) of vehicles that are parts of one; the front leads in the direction of motion.

    A vehicle tows one at most and is towed by one at most; what is towed may tow in turn. Of several that could be the
    nearest is.
    """
    found = [pair for i, j in _always_near(agents) if (pair := _coupled(agents, i, j)) is not None]
    chosen: list[tuple[int, int]] = []
    first = list(range(len(agents)))  # of each train, by its parts
    for _, front, towed in sorted(found):
        if all(front != f and towed != t for f, t in chosen) and first[front] != first[towed]:
            chosen.append((front, towed))
            first = [first[front] if k == first[towed] else k for k in first]
    return tuple(sorted(chosen, key=lambda pair: pair[1]))


def first_parts(n: int, pairs: tuple[tuple[int, int], ...]) -> Ints:
    """(N,) the first part of the vehicle that each of N boxes is of: itself where nothing tows it."""
    front_of = {towed: front for front, towed in pairs}
    out = np.arange(n)
    for towed in front_of:
        part = towed
        while part in front_of:
            part = front_of[part]
        out[towed] = part
    return out


def articulated(agents: AgentTracks) -> tuple[Repair, ...]:
    """A record for each part that the simulation moves behind the one before it. The tracks stay as they are."""
    names = agents.track_ids
    return tuple(
        Repair("articulated", names[towed], math.nan, "an agent of its own", f"towed by {names[front]}")
        for front, towed in couplings(agents)
    )


def _always_near(agents: AgentTracks) -> list[tuple[int, int]]:
    """Pairs of vehicles that move, share most of their lives and are never far apart; a first, cheap look."""
    n = len(agents)
    seen_at = agents.boxes[agents.valid.argmax(axis=0), np.arange(n), :2]
    moved = np.where(agents.valid, _lengths(agents.boxes[..., :2] - seen_at), 0.0).max(axis=0, initial=0.0)
    is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds], dtype=bool)
    moving = np.flatnonzero(is_vehicle & (moved >= MOVES_M))
    valid = agents.valid[:, moving].astype(np.float64)
    shared, lives = valid.T @ valid, valid.sum(axis=0)
    boxes, there = agents.boxes[::LOOK_STEPS, moving], agents.valid[::LOOK_STEPS, moving]
    radius = np.where(there, 0.5 * _lengths(boxes[..., 3:]), 0.0).max(axis=0, initial=0.0)
    apart = _lengths(boxes[:, :, None, :2] - boxes[:, None, :, :2])
    far = (apart > radius[:, None] + radius + SLACK * APART_M).any(axis=0)  # false next to absent frames
    near = ~far & (shared >= DRIVES_STEPS) & (shared >= SHARED * np.maximum(lives[:, None], lives))
    return [(int(moving[i]), int(moving[j])) for i, j in np.argwhere(np.triu(near, 1))]


def _lengths(vectors: Array) -> Array:
    out: Array = np.hypot(vectors[..., 0], vectors[..., 1])
    return out


def _coupled(agents: AgentTracks, i: int, j: int) -> tuple[float, int, int] | None:
    """(distance [m], front, towed) of two vehicles that are coupled."""
    both = agents.valid[:, i] & agents.valid[:, j]
    one, other = agents.boxes[both, i], agents.boxes[both, j]
    if not _within(one, other, APART_M).all():
        return None
    velocities = agents.velocities[both, i], agents.velocities[both, j]
    speed = np.maximum(*map(_lengths, velocities))
    touches, drives = _within(one, other, TOUCHES_M + TOUCHES_S * speed), speed >= DRIVES_MPS
    if drives.sum() < DRIVES_STEPS or min(touches.mean(), touches[drives].mean()) < TOUCHES_IN:
        return None
    # One behind the other: not side by side, and not one vehicle that is labelled twice. On a circle the line between
    # two parts is headed as they are on average.
    between = one[:, :2] - other[:, :2]
    ahead = np.stack([f(one[:, 2]) + f(other[:, 2]) for f in (np.cos, np.sin)], axis=1)
    ahead /= np.maximum(_lengths(ahead), 1e-9)[:, None]
    along, across = (between * ahead).sum(axis=1), between[:, 1] * ahead[:, 0] - between[:, 0] * ahead[:, 1]
    lengths, widths = one[:, 3] + other[:, 3], one[:, 4] + other[:, 4]
    if np.median(np.abs(along) / lengths) < 0.25 or np.median(np.abs(across) / widths) > 0.25:
        return None
    leads = float((between * (velocities[0] + velocities[1])).sum())
    distance = float(np.median(_lengths(between)))
    return (distance, i, j) if leads > 0.0 else (distance, j, i)


def _within(one: Array, other: Array, gap: Array | float) -> Bools:
    """(K,) whether boxes (K, 5) are that near [m] to each other, at corners a little farther."""
    one, other = one.copy(), other.copy()
    for boxes in (one, other):
        boxes[:, 3:] += np.reshape(gap, (-1, 1))
    return touching(one, other)
