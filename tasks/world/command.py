"""The driving command a planner is given: which way the route goes next."""

import numpy as np

from tasks.world.arrays import Array
from tasks.world.frames import to_local, wrap_angle

LOOKAHEAD_M = 20.0  # NAVSIM: the route 20 m ahead decides ...
LATERAL_M = 2.0  # ... left or right where it lies 2 m or more to a side
SPACING_M = 0.5  # the route is looked at this densely, however few points it came with


def driving_command(centerline: Array, pose: Array) -> str:
    """left, straight, right, or unknown where less than 20 m of route are left ahead of the rear axle's `pose` (3,).

    NAVSIM's command: the side offset of the route's point 20 m ahead, in the frame of the route at the ego.
    centerline: (P, 3) the route ahead, x, y [m], heading [rad].
    """
    steps = np.hypot(*np.diff(centerline[:, :2], axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    columns = (centerline[:, 0], centerline[:, 1], np.unwrap(centerline[:, 2]))

    def at(lengths: Array) -> Array:
        return np.stack([np.interp(lengths, arc, column) for column in columns], axis=-1)

    along = np.append(np.arange(0.0, arc[-1], SPACING_M), arc[-1])
    route = at(along)
    gaps = np.hypot(*(route[:, :2] - pose[:2]).T) + np.abs(wrap_angle(route[:, 2] - pose[2]))
    nearest = int(np.argmin(gaps))
    ahead = along[nearest] + LOOKAHEAD_M
    if ahead > arc[-1]:
        return "unknown"
    side = float(to_local(route[nearest], at(ahead))[1])
    return "left" if side >= LATERAL_M else "right" if side <= -LATERAL_M else "straight"
