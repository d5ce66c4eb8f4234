"""The driving command from points of the route ahead, as a closed-loop simulator sends them, and as a row holds them.

`tasks.world.road_map.driving_command` is NAVSIM's own, for a route that begins at the ego. AlpaSim sends 20 points
4.21 m apart from the ego's projection on, those before 40 m left out (NVlabs/alpasim 9177bd0,
src/runtime/alpasim_runtime/route_generator.py): a side offset there means another bend than one at 20 m.
"""

from typing import Literal

import numpy as np

from tasks.world.arrays import Array
from tasks.world.road_map import LATERAL_M, LOOKAHEAD_M, SPACING_M, arc_lengths

# navsim: where the route lies 20 m ahead. curvature: where the arc from the ego through its first points lies there, on
# arcs the same. simscale: which side its first point from 5 m on lies to, as SimScale's AlpaSim samples have it
# (NVlabs/alpasim a2a98a2, command_from_route), to whom a route of NaN alone is straight.
CommandRule = Literal["navsim", "curvature", "simscale"]
FITTED = 3  # points: the first ones from LOOKAHEAD_M on
SIMSCALE_FROM_M = 5.0
SENT_M = np.linspace(0.0, 80.0, 20)  # along the route from the ego's projection
SENT_FROM_M = 40.0


def command_of_points(points: Array, rule: CommandRule) -> str:
    """left, straight, right, or unknown where no point lies far enough ahead; by simscale, where nothing was sent.

    points: (N, 2) x, y [m] in the ego frame at now, in the order of the route; NaN where there is none.
    navsim is curvature here: these points do not begin at the ego. The arc leaves the ego straight ahead, y = k d^2 / 2
    at the distance d; k by least squares. It lies 2 sin^2(10 k) / k to a side 20 m along it.
    """
    sent, points = len(points) > 0, points[np.isfinite(points).all(axis=1)]
    distance = np.hypot(*points.T)
    if rule == "simscale":
        ahead = points[distance >= SIMSCALE_FROM_M]
        if not len(ahead):
            return "straight" if sent else "unknown"
        side = float(ahead[0, 1])
        return "left" if side > LATERAL_M else "right" if side < -LATERAL_M else "straight"
    ahead = points[distance >= LOOKAHEAD_M][:FITTED]
    if not len(ahead):
        return "unknown"
    square = (ahead**2).sum(axis=1)
    bend = 2.0 * (ahead[:, 1] @ square) / (square @ square)  # 1/m
    side = bend * LOOKAHEAD_M**2 / 2.0 * np.sinc(bend * LOOKAHEAD_M / (2.0 * np.pi)) ** 2
    return "left" if side >= LATERAL_M else "right" if side <= -LATERAL_M else "straight"


def route_points(centerline: Array) -> Array:
    """(20, 2) points as AlpaSim would send them of a row's route, NaN before 40 m and after its end.

    centerline: (P, 3) of the route, in the ego frame at now. Raises ValueError where the row has none.
    """
    if not len(centerline):
        raise ValueError("route_centerline is empty: make the samples with a map, or planner.settings.command=navsim")
    arc = arc_lengths(centerline)
    dense = np.append(np.arange(0.0, arc[-1], SPACING_M), arc[-1])
    at = np.stack([np.interp(dense, arc, centerline[:, i]) for i in (0, 1)], axis=-1)
    along = dense[np.argmin(np.hypot(*at.T))] + SENT_M
    sent = np.stack([np.interp(along, arc, centerline[:, i]) for i in (0, 1)], axis=-1)
    sent[(SENT_M < SENT_FROM_M) | (along > arc[-1])] = np.nan
    return sent
