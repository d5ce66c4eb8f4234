"""The driving command a planner is given: which way the route goes next."""

import numpy as np
from numpy.typing import NDArray

from tasks.world.frames import points_to_local, wrap_angle

LOOKAHEAD_M = 20.0  # NAVSIM: the route 20 m ahead decides ...
LATERAL_M = 2.0  # ... left or right where it lies more than 2 m to a side


def driving_command(centerline: NDArray[np.float64], pose: NDArray[np.float64]) -> str:
    """left, straight, right, or unknown where less than 20 m of route are left.

    Args:
        centerline: (P, 3) the route ahead, x, y [m], heading [rad].
        pose: (3,) the ego's rear axle.

    Rule: the side offset of the route's point 20 m ahead, in the frame of the route at the ego (NAVSIM's command).
    """
    steps = np.hypot(*np.diff(centerline[:, :2], axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    gaps = np.hypot(*(centerline[:, :2] - pose[:2]).T) + np.abs(wrap_angle(centerline[:, 2] - pose[2]))
    nearest = int(np.argmin(gaps))
    ahead = arc[nearest] + LOOKAHEAD_M
    if ahead > arc[-1]:
        return "unknown"
    target = np.array([np.interp(ahead, arc, centerline[:, 0]), np.interp(ahead, arc, centerline[:, 1])])
    side = float(points_to_local(centerline[nearest], target)[1])
    return "left" if side >= LATERAL_M else "right" if side <= -LATERAL_M else "straight"
