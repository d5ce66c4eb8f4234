"""Keeping to the lane's middle and to its direction (docs/reward.md 2e, 2h)."""

import math

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.reward.rules.centerline import Centerline, is_off
from tasks.reward.rules.ego import CENTER_IN_INTERSECTION, ONCOMING, Body

LK_STEPS = 20  # 2.0 s
DDC_WINDOW = 11  # indices t - 10 .. t, the public 1.0 s
DDC_TOLERATED_M, DDC_FAILED_M = 2.0, 6.0


@kernel
def lane_keeping(line: Centerline, body: Body) -> float:
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
                if not is_off(line, x[back], y[back]):
                    break
                seen += 1
            back -= 1
        if seen == unseen:
            return float(t)
        off, unseen = seen, 0
    return math.inf


@kernel
def driving_direction(body: Body) -> tuple[float, float]:
    """DDC in {0, 0.5, 1}, and the first time index with 2 m or more against traffic within 1 s (inf: none)."""
    x, y, flags = body.x, body.y, body.flags
    n = len(x)
    any_oncoming = False
    for t in range(1, n):
        any_oncoming |= (flags[t] & (ONCOMING | CENTER_IN_INTERSECTION)) == ONCOMING
    if not any_oncoming:
        return 1.0, math.inf
    before = DDC_WINDOW - 1
    moved = np.zeros(before + n)  # from the step before, where that is against traffic
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
