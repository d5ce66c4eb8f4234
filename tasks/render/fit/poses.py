"""Small corrections of where the cameras were, and what holds between two corrected photos."""

import numpy as np

from tasks.world.arrays import F32, Array, FloatArray

SIZE = 6  # a photo's row: shift [m], turn [rad], both in its camera's frame


def motion(row: FloatArray) -> Array:
    """(4, 4): x' = R(turn) x + shift of a row (6,)."""
    out = np.eye(4)
    turn = np.asarray(row[3:], np.float64)
    angle = float(np.linalg.norm(turn))
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    out[:3, :3] += first * cross + second * cross @ cross
    out[:3, 3] = row[:3]
    return out


def corrected(scene_from_camera: Array, row: FloatArray) -> Array:
    """The pose (4, 4) of a camera whose points move by `row` (6,)."""
    return np.asarray(scene_from_camera @ np.linalg.inv(motion(row)))


def between(times: FloatArray, rows: F32, time_s: float) -> F32:
    """The row (C,) at a time, linear between those (N, C) at `times` (N,) in any order; the nearest one outside."""
    by_time = np.argsort(times, kind="stable")
    return np.array([np.interp(time_s, times[by_time], column[by_time]) for column in rows.T], np.float32)
