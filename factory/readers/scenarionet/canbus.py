"""The clock of nuScenes' ego in ScenarioNet's files, put right.

The converter takes the ego from the CAN bus: every fifth 50 Hz pose message, written as if they were 0.1 s apart and
the first one at the log's start. Neither holds, and the agents keep the log's clock:
* A lost message makes a step 0.02 s too long. It shows as such: on the seven scenes 37 steps are late by 0.014-0.025 s
  and one by 0.039 s, all others by 0.002 s (standard deviation). Scene 0061 lost 20 messages, 0.4 s in 19 s.
* Where the bus ends before the log, the converter goes on with keyframe poses, which are on the log's clock: the ego
  falls back by 0.2-0.3 s, 3 m at 15 m/s. That jump tells how far the bus was ahead.
So every message gets its time, and the ego is interpolated at the log's steps. Where the bus lasts to the log's end
nothing tells its start, and 0 is assumed (the three scenes that tell: -0.13, 0.06 and 0.22 s).
"""

import numpy as np
from scipy.ndimage import median_filter

from tasks.world.arrays import Array, Bools
from tasks.world.clip import STEP_S

MESSAGE_S = 0.02
MAX_LOST = 5  # messages in one step
TIMING_NOISE_S = 0.008
MIN_SPEED_MPS = 0.2  # slower, a step does not tell its duration
MAX_AHEAD_S = 0.5
JUMP_M, JUMP_S = 0.3, 0.03  # a 0.1 s step this far (plus this long at its speed) off the median step is a jump


def usual_steps(xy: Array) -> Array:
    """(S - 1, 2) median of the steps around each step, component by component."""
    return np.stack([median_filter(column, 11, mode="nearest") for column in np.diff(xy, axis=0).T], axis=1)


def jumps(xy: Array) -> Bools:
    """(S - 1,) True where the step to the next position is not part of the same drive."""
    usual = usual_steps(xy)
    return np.hypot(*(np.diff(xy, axis=0) - usual).T) > JUMP_M + JUMP_S / STEP_S * np.hypot(*usual.T)


def on_log_clock(xy: Array, heading: Array, valid: Bools) -> tuple[Array, Array, Bools]:
    """Positions (S, 2), unwrapped headings (S,) and valid (S,) at the log's steps, from those stored in message order.

    Steps before the first message and after the last one are not valid. An ego with gaps is given back as it is.
    """
    if not valid.all():
        return xy, heading, valid
    last = int(np.argmax(jumps(xy))) if jumps(xy).any() else len(xy) - 1  # index of the last message
    late = _late(xy)
    times = STEP_S * np.arange(last + 1) + MESSAGE_S * np.concatenate([[0.0], np.cumsum(_lost(late[:last]))])
    if last < len(xy) - 1:
        ahead = -late[last]
        if not 0.0 <= ahead <= MAX_AHEAD_S:
            return xy, heading, valid
        times += STEP_S * last + ahead - times[-1]
    steps = STEP_S * np.arange(len(xy))
    bus = slice(0, last + 1)
    moved = np.stack([np.interp(steps, times, column) for column in xy[bus].T], axis=1)
    told = (steps >= times[0] - 1e-9) & (steps <= times[-1] + 1e-9)
    return moved, np.interp(steps, times, np.unwrap(heading[bus])), told


def _late(xy: Array) -> Array:
    """(S - 1,) seconds by which each step took longer than 0.1 s, at the speed of the steps around it; 0 when slow."""
    usual = usual_steps(xy)
    length = np.hypot(*usual.T)
    excess = ((np.diff(xy, axis=0) - usual) * usual).sum(axis=1) / np.maximum(length, 1e-9)
    return np.where(length > MIN_SPEED_MPS * STEP_S, STEP_S * excess / np.maximum(length, 1e-9), 0.0)


def _lost(late: Array) -> Array:
    """(S,) messages lost within each step."""
    count = np.rint(late / MESSAGE_S)
    sure = (count >= 1) & (count <= MAX_LOST) & (np.abs(late - MESSAGE_S * count) < TIMING_NOISE_S)
    return np.where(sure, count, 0.0)
