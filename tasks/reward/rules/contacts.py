"""No at-fault collision and time to collision of one trajectory (docs/reward.md 2b, 2g).

Both rules walk through the contacts of the ego's body in time and stop looking at an object once a contact with it was
harmless.
"""

import math

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.reward.rules.area_flags import in_intersection
from tasks.reward.rules.ego import OFF_LANE, Body
from tasks.reward.rules.map_index import MapIndex
from tasks.reward.rules.obstacles import Box, Obstacles, apart, box_at, cell_of, centroid, out_of_reach, touching
from tasks.world.arrays import Array, Bools
from tasks.world.frames import HEADING, X, Y

STOPPED_EGO_MPS = 0.05
STOPPED_EGO_TTC_MPS = 5e-3
BEHIND_RAD = math.radians(150.0)
AHEAD_RAD = math.radians(30.0)
TTC_STEPS = (0, 3, 6, 9)  # projections 0, 0.3, 0.6, 0.9 s ahead


@kernel
def first_collision(
    obstacles: Obstacles, states: Array, body: Body, half_length: float, half_width: float, ignored: Bools
) -> tuple[float, float]:
    """NC in {0, 0.5, 1} and the time index of the first collision at fault, inf where there is none.

    states: (41, 11) of one trajectory; body: placed there, with its flags; half_length, half_width: of the body [m];
    ignored: (N,) scratch.
    """
    ignored[:] = False
    nc, first = 1.0, math.inf
    for t in range(states.shape[0]):
        ego = Box(
            body.x[t], body.y[t], states[t, HEADING], body.cos[t], body.sin[t], 2.0 * half_length, 2.0 * half_width
        )
        cell = cell_of(obstacles, t, ego.x, ego.y)
        for entry in range(obstacles.starts[cell], obstacles.starts[cell + 1]):
            item = obstacles.items[entry]
            if ignored[item] or out_of_reach(obstacles, t, item, ego):
                continue
            other = box_at(obstacles, t, item)
            if apart(ego, other) or not touching(ego, other):
                continue
            off_lane = (body.flags[t] & OFF_LANE) != 0
            if _at_fault(ego, states[t, X], states[t, Y], body.speed[t], off_lane, other, obstacles.is_stopped[item]):
                nc, first = min(nc, obstacles.collision_score[item]), min(first, float(t))
            else:
                ignored[item] = True
        if nc == 0.0:
            break
    return nc, first


@kernel
def first_time_to_collision(
    obstacles: Obstacles,
    states: Array,
    body: Body,
    map_index: MapIndex,
    half_length: float,
    half_width: float,
    ignored: Bools,
) -> float:
    """First time index at which the ego, going straight on for up to 0.9 s, runs into something; inf: none.

    Arguments as for `first_collision`; map_index: within its intersections contacts beside the ego count too.
    """
    ignored[:] = False
    for t in range(states.shape[0] - max(TTC_STEPS)):
        if body.speed[t] < STOPPED_EGO_TTC_MPS:
            continue
        c, s = body.cos[t], body.sin[t]
        for step in TTC_STEPS:
            gone = body.speed[t] * (step * 0.1)
            x, y = body.x[t] + c * gone, body.y[t] + s * gone
            ego = Box(x, y, states[t, HEADING], c, s, 2.0 * half_length, 2.0 * half_width)
            cell = cell_of(obstacles, t + step, x, y)
            for entry in range(obstacles.starts[cell], obstacles.starts[cell + 1]):
                item = obstacles.items[entry]
                if ignored[item] or out_of_reach(obstacles, t + step, item, ego):
                    continue
                other = box_at(obstacles, t + step, item)
                if apart(ego, other) or not touching(ego, other):
                    continue
                angle = _angle_to(states[t, X], states[t, Y], ego.heading, other)  # the ego as it is now
                if angle < AHEAD_RAD or (not angle > BEHIND_RAD and _exposed(map_index, states, body, t)):
                    return float(t)
                ignored[item] = True
    return math.inf


@kernel
def reach_of(body: Body) -> tuple[float, float, float, float]:
    """Least x, y, most x, y [m] of the places of a placed body that both rules look at."""
    ahead = max(TTC_STEPS) * 0.1
    least_x, least_y, most_x, most_y = math.inf, math.inf, -math.inf, -math.inf
    for t in range(len(body.x)):
        x, y, gone = body.x[t], body.y[t], body.speed[t] * ahead
        ahead_x, ahead_y = x + body.cos[t] * gone, y + body.sin[t] * gone
        least_x, least_y = min(least_x, x, ahead_x), min(least_y, y, ahead_y)
        most_x, most_y = max(most_x, x, ahead_x), max(most_y, y, ahead_y)
    return least_x, least_y, most_x, most_y


@kernel
def _exposed(map_index: MapIndex, states: Array, body: Body, t: int) -> bool:
    """Whether objects beside the ego count at step t: between lanes, off the road or in an intersection."""
    return (body.flags[t] & OFF_LANE) != 0 or in_intersection(map_index, states[t, X], states[t, Y])


@kernel
def _at_fault(ego: Box, rear_x: float, rear_y: float, speed: float, off_lane: bool, other: Box, stopped: bool) -> bool:
    """Whether the ego, its rear axle at (rear_x, rear_y) [m], is to blame for touching another box."""
    if speed <= STOPPED_EGO_MPS:
        return False
    if stopped:
        return True
    if _angle_to(rear_x, rear_y, ego.heading, other) > BEHIND_RAD:
        return False
    half_length = ego.length / 2.0
    front_x, front_y = ego.x + half_length * ego.cos, ego.y + half_length * ego.sin
    return off_lane or touching(Box(front_x, front_y, ego.heading, ego.cos, ego.sin, 0.0, ego.width), other)


@kernel
def _angle_to(x: float, y: float, heading: float, other: Box) -> float:
    """Angle [rad] between a heading [rad] and the ray from (x, y) [m] to the centroid of a box.

    The cosine is not clipped, as in the public metric: where rounding lifts it above 1 the angle is NaN, so a
    perfectly aligned object is neither ahead nor behind (docs/reward.md 2g); so is one centred on (x, y). The last bit
    decides there, so the heading's sine and cosine are the machine's own, as numpy's are, not the body's.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    to_x, to_y = centroid(other)
    dx, dy = to_x - x, to_y - y
    distance = math.hypot(dx, dy)
    return math.acos(cos * np.divide(dx, distance) + sin * np.divide(dy, distance))  # numpy's: 0 / 0 is NaN
