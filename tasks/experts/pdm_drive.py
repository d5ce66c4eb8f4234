"""PDM's proposals as the tracker drives them: the reference starts on the PATH, not where the ego is.

`tasks.rollout.lqr.track` starts its reference at the ego's own pose, as a planner's output does. PDM-Closed hands its
tracker the proposal's own first pose, the ego's projection on the (sideways moved) path, so the first displacement is
one along the path and the tracker sees the whole lateral error at once (METRIC.md section 4).
"""

import numpy as np
from numpy.typing import NDArray

from tasks.rollout import bicycle, lqr
from tasks.world.vehicle import EGO_STATE_SIZE, PACIFICA, Vehicle

Array = NDArray[np.float64]


def drive(ego_state0: Array, reference: Array, vehicle: Vehicle = PACIFICA) -> Array:
    """Simulated states (K, 41, 11) from `ego_state0` (11,) after references (K, 41, 3), world frame, 0 .. 4.0 s."""
    velocity = lqr.velocity_profile(reference)
    curvature = lqr.curvature_profile(reference, velocity)
    steps = velocity.shape[1]
    states = np.empty((len(reference), steps + 1, EGO_STATE_SIZE))
    states[:, 0] = ego_state0
    for k in range(steps):
        target = min(k + lqr.TRACKING_STEPS, steps - 1)
        horizon = curvature[:, np.minimum(np.arange(k, k + lqr.TRACKING_STEPS), target)]
        command = lqr._commands(states[:, k], reference[:, k], velocity[:, target], horizon, vehicle)
        states[:, k + 1] = bicycle.step(states[:, k], *command, vehicle)
    return states
