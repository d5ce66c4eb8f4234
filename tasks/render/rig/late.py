"""Which cameras took their photos later than their stamps say, where photos can tell.

A camera that is late is shifted along the road by the ego's speed: at a steady speed, straight on, a mount that is
wrong explains the same photos, and nothing is gained by a delay. So one is believed where corners that were not fitted
agree clearly better with it. They can where speeds change or the ego turns.
"""

from dataclasses import dataclass

import numpy as np

from tasks.render.rig.adjust import Bundle, Matched, adjusted, offsets, part_of, triangulated
from tasks.render.rig.normal import N_CAMERA, STAMP
from tasks.render.rig.rig import Rig, Shots
from tasks.world.arrays import Array, Bools

STAMP_OF_CAMERA = STAMP - 6  # of a camera's parameters
EVERY = 4  # of so many points one is fitted and another measured: they decide as all do, in a fraction of the time
LEAST_LATE_S = 0.01  # less is a decimetre at 10 m/s, which mounts have as well
SURE = 5.0  # standard errors by which corners must agree better
LEAST_GAIN = 0.02  # share of what they are off
WIDTHS_PX = (8.0, 4.0, 2.0, 1.0)


@dataclass(frozen=True)
class Delays:
    """What photos say of their cameras' stamps."""

    late_s: Array  # (C,) that photos are taken later than said, were it so
    gain: float  # share by which corners that were not fitted are less off then
    sure: float  # the same in standard errors
    believed: Bools  # (C,)


def delays(given: Rig, shots: Shots, matched: Matched, held: Bundle, sigmas: Array, stamp_s: float) -> Delays:
    """Whose delay explains what nothing else does; `held` is what `sigmas` (n,), no delays, came to."""
    every = np.ones(len(given.stamps), np.bool_)
    fitted, measured = (part_of(matched, matched.point_of % EVERY == k) for k in (0, 1))
    late = adjusted(given, shots, fitted, with_stamps(sigmas, every, stamp_s), held.rig, WIDTHS_PX).rig
    found = np.abs(late.stamps) >= LEAST_LATE_S
    if not found.any():
        return Delays(late.stamps, 0.0, 0.0, found)
    on_time = adjusted(given, shots, fitted, sigmas, held.rig, WIDTHS_PX).rig
    gained, off = _gained(on_time, late, shots, measured)
    if len(gained) < 2 or off == 0.0:
        return Delays(late.stamps, 0.0, 0.0, ~every)
    gain, sure = gained.mean() / off, gained.mean() / (gained.std() / np.sqrt(len(gained)) + 1e-12)
    return Delays(late.stamps, float(gain), float(sure), found & bool(gain > LEAST_GAIN and sure > SURE))


def with_stamps(sigmas: Array, cameras: Bools, stamp_s: float) -> Array:
    """(n,) the same, the stamps of some cameras (C,) free."""
    out = sigmas.copy()
    of_camera = out[len(out) - N_CAMERA * len(cameras) :].reshape(-1, N_CAMERA)
    of_camera[cameras, STAMP_OF_CAMERA] = stamp_s
    return out


def _gained(one: Rig, other: Rig, shots: Shots, matched: Matched) -> tuple[Array, float]:
    """(P',) by how much less each point is off with the other rig, and how much all are on average with the first."""
    costs, there = [], np.ones(len(matched.starts) - 1, np.bool_)
    for rig in (one, other):
        points, seen = triangulated(rig, shots, matched)
        off = np.where(seen[matched.point_of], offsets(rig, shots, matched, points), 0.0)
        costs.append(np.add.reduceat(np.log1p(np.minimum(off, 1e3) ** 2), matched.starts[:-1]))
        there &= seen
    return (costs[0] - costs[1])[there], float(costs[0][there].mean()) if there.any() else 0.0
