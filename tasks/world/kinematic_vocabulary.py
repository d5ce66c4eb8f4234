"""A vocabulary without data: trajectories of a point on a curve with random speeds, accelerations and curvatures.

For the synthetic town and for first looks, where no file of clustered human trajectories is at hand. Real runs name a
file of human trajectories or build one from their own TRAIN clips.
"""

import numpy as np

from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S

MAX_SPEED_MPS = 18.0
ACCEL_STD_MPS2 = 1.0  # of the one-second pieces
LATERAL_ACCEL_MAX_MPS2 = 2.5
CURVATURE_MAX_1PM = 0.12  # about the turning circle of a large car
STRAIGHT_SHARE = 0.4  # most human driving is nearly straight: those draw a tenth of the curvature


def kinematic_trajectories(k: int, seed: int) -> Array:
    """(k, 40, 3) x [m], y [m], heading [rad] in the ego frame at 0.1 .. 4.0 s; equal (k, seed) give equal numbers.

    Speed: uniform start, acceleration constant over each second, never below 0. Curvature: linear between knots at
    whole seconds, bounded by the turning circle and by the lateral acceleration. x' = v cos(heading),
    y' = v sin(heading), heading' = v * curvature, integrated at the step's middle.
    """
    rng = np.random.Generator(np.random.Philox(key=np.uint64(seed)))
    seconds = int(HORIZON_STEPS * STEP_S)
    start_speed = rng.uniform(0.0, MAX_SPEED_MPS, k)
    accel = np.repeat(rng.normal(0.0, ACCEL_STD_MPS2, (k, seconds)), HORIZON_STEPS // seconds, axis=1)
    knots = rng.normal(0.0, 0.4, (k, seconds + 1)) * np.where(rng.random((k, 1)) < STRAIGHT_SHARE, 0.1, 1.0)

    speed = np.empty((k, HORIZON_STEPS + 1))
    speed[:, 0] = start_speed
    for step in range(HORIZON_STEPS):
        speed[:, step + 1] = np.clip(speed[:, step] + accel[:, step] * STEP_S, 0.0, MAX_SPEED_MPS)
    middle_speed = (speed[:, 1:] + speed[:, :-1]) / 2.0

    at = (np.arange(HORIZON_STEPS) + 0.5) * STEP_S
    left = np.minimum(at.astype(int), seconds - 1)
    share = at - left
    unit = knots[:, left] * (1.0 - share) + knots[:, left + 1] * share
    bound = np.minimum(CURVATURE_MAX_1PM, LATERAL_ACCEL_MAX_MPS2 / np.maximum(middle_speed, 0.1) ** 2)
    curvature = np.clip(unit, -1.0, 1.0) * bound

    turn = curvature * middle_speed * STEP_S
    heading = np.cumsum(turn, axis=1)
    along = heading - turn / 2.0
    x = np.cumsum(middle_speed * np.cos(along) * STEP_S, axis=1)
    y = np.cumsum(middle_speed * np.sin(along) * STEP_S, axis=1)
    return np.stack([x, y, heading], axis=-1)
