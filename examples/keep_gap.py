"""A traffic policy: on at the speed of now, and to a stop where somebody is near ahead.

    python -m factory.run traffic=custom traffic.policy=examples.keep_gap:KeepGap

It looks at boxes and ways only. What it is shown, and what it answers: tasks/rollout/simulate.py.
"""

import numpy as np

from tasks.rollout.simulate import SeenTraffic
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S
from tasks.world.frames import wrap_angle

BRAKES_MPS2, SECONDS, LEAST_M, FAR_M = 3.0, 1.5, 2.0, 1e3


class KeepGap:
    """Brakes for boxes within 1.5 s and 2 m straight ahead; turns as its way does."""

    def digest(self) -> str:
        """Rows of another version are other rows."""
        return "keep gap 1"

    def next_states(self, seen: SeenTraffic) -> Array:
        """(N, 4) x, y, heading, speed in 0.1 s."""
        boxes, n = seen.boxes[-1], len(seen.asked)
        x, y, heading, length, width = boxes[:n].T
        c, s = np.cos(heading), np.sin(heading)
        speed = np.maximum(seen.velocities[-1, :n, 0] * c + seen.velocities[-1, :n, 1] * s, 0.0)

        dx, dy = boxes[:, 0] - x[:, None], boxes[:, 1] - y[:, None]  # (N, N + 1)
        ahead, beside = dx * c[:, None] + dy * s[:, None], dy * c[:, None] - dx * s[:, None]
        in_the_way = seen.valid[-1] & (ahead > 0.0) & (np.abs(beside) < 0.5 * width[:, None] + 1.0)
        gap = np.where(in_the_way, ahead - 0.5 * (length[:, None] + boxes[:, 3]), FAR_M).min(axis=-1)
        brakes = gap < LEAST_M + SECONDS * speed
        slowed = np.where(brakes, np.maximum(speed - BRAKES_MPS2 * STEP_S, 0.0), speed)

        turn = np.zeros(n)
        for i in np.flatnonzero(seen.asked):
            way = seen.ways.xy[seen.way[i]]
            here = int(np.argmin(np.hypot(*(way - boxes[i, :2]).T)))
            to = way[min(here + 8, len(way) - 1)] - boxes[i, :2]  # 4 m on
            turn[i] = wrap_angle(np.arctan2(to[1], to[0]) - heading[i]) * 0.5 * slowed[i] * STEP_S
        gone = slowed * STEP_S
        return np.stack([x + gone * c, y + gone * s, wrap_angle(heading + turn), slowed], axis=-1)
