"""A traffic policy: on at the speed of now, and to a stop where somebody is near ahead.

    python -m factory.run traffic=learned traffic.policy=examples.keep_gap:KeepGap

It looks at boxes and ways only. What it is shown, and what it answers: tasks/rollout/learned/policy.py.
"""

import numpy as np

from tasks.rollout.learned.policy import RoadLines, SeenWorlds
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S
from tasks.world.frames import wrap_angle

BRAKES_MPS2, SECONDS, LEAST_M, FAR_M = 3.0, 1.5, 2.0, 1e3


class KeepGap:
    """Brakes for boxes within 1.5 s and 2 m straight ahead; turns as its way does."""

    def __init__(self, weights: str | None = None) -> None:
        """weights: a file that it does not need."""

    def digest(self) -> str:
        """Rows of another version are other rows."""
        return "keep gap 1"

    def next_states(self, seen: SeenWorlds, streets: RoadLines) -> Array:
        """(B, N, 4) x, y, heading, speed in 0.1 s, each of B worlds and N agents for itself."""
        boxes, n = seen.boxes[-1], seen.asked.shape[1]
        x, y, heading, length = (boxes[:, :n, k] for k in range(4))
        c, s = np.cos(heading), np.sin(heading)
        speed = np.maximum(seen.velocities[-1, :, :n, 0] * c + seen.velocities[-1, :, :n, 1] * s, 0.0)

        dx, dy = boxes[:, None, :, 0] - x[..., None], boxes[:, None, :, 1] - y[..., None]  # (B, N, N + 1)
        ahead, beside = dx * c[..., None] + dy * s[..., None], dy * c[..., None] - dx * s[..., None]
        in_the_way = seen.valid[-1, :, None] & (ahead > 0.0) & (np.abs(beside) < 0.5 * boxes[:, :n, None, 4] + 1.0)
        gap = np.where(in_the_way, ahead - 0.5 * (length[..., None] + boxes[:, None, :, 3]), FAR_M).min(axis=-1)
        brakes = gap < LEAST_M + SECONDS * speed
        slowed = np.where(brakes, np.maximum(speed - BRAKES_MPS2 * STEP_S, 0.0), speed)

        turn = np.zeros_like(speed)
        for b, i in np.argwhere(seen.asked):
            way = streets.ways.xy[streets.way[i]]
            here = int(np.argmin(np.hypot(*(way - boxes[b, i, :2]).T)))
            to = way[min(here + 8, len(way) - 1)] - boxes[b, i, :2]  # 4 m on
            turn[b, i] = wrap_angle(np.arctan2(to[1], to[0]) - heading[b, i]) * 0.5 * slowed[b, i] * STEP_S
        gone = slowed * STEP_S
        return np.stack([x + gone * c, y + gone * s, wrap_angle(heading + turn), slowed], axis=-1)
