"""Parts of an articulated vehicle behind its first one: each on the way that one has come, as far behind as it was.

Where the first part drives by IDM or a policy, the others have no drive of their own. A part's centre keeps its path
length behind the first one's, along where that has been: in the rollout, and before in the log or an earlier rollout;
farther back, where the parts in between and itself have been. It is headed as the chord of that way under its middle.
How far beside that way it starts, and turned against it, fades as it goes; how much faster it is by its log, whose
boxes wander along the road, is braked away as hard as tyres can. Compiled.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel
from tasks.rollout.corridor import fade
from tasks.rollout.lane_following import LOGGED_PATH_SPACING_M
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S, Scene
from tasks.world.geometry import wrapped

CHORD = 0.25  # of a part's length, before and behind its middle: about where its wheels are
ROUNDS = 20  # to find the place of the way that a part is beside


def trails_behind(scene: Scene, first_part: Ints, front_of: dict[int, int]) -> Array:
    """(N, K, 2) where the ways behind the first parts led before the scene, for each towed agent, newest first.

    Filled up with NaN; K = 0 where nothing is towed. first_part (N,), front_of: towed agent -> what tows it.
    """
    trails = {towed: _trail_behind(scene, int(first_part[towed]), towed, front_of) for towed in front_of}
    out = np.full((len(first_part), max(map(len, trails.values()), default=0), 2), np.nan)
    for towed, trail in trails.items():
        out[towed, : len(trail)] = trail
    return out


def _trail_behind(scene: Scene, first: int, towed: int, front_of: dict[int, int]) -> Array:
    chain = [towed]
    while front_of[chain[0]] != first:
        chain.insert(0, front_of[chain[0]])
    way = _been(scene, first, scene.step)[:, :2]
    for part in chain:
        been = _been(scene, part, scene.step + 1)
        end = way[-1] if len(way) else scene.agents.boxes[scene.step, first, :2]
        if np.isfinite(end).all():  # what lies behind its end
            behind = (end[0] - been[:, 0]) * np.cos(been[:, 2]) + (end[1] - been[:, 1]) * np.sin(been[:, 2])
            been = been[behind >= LOGGED_PATH_SPACING_M]
        way = np.concatenate([way, been[:, :2]])
    return way


def _been(scene: Scene, i: int, stop: int) -> Array:
    """(K, 3) poses of agent i before step `stop`, newest first."""
    poses: Array = scene.agents.boxes[:stop, i, :3][scene.agents.valid[:stop, i]][::-1]
    return poses


@inner_kernel
def point_behind(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int, away: float
) -> tuple[float, float]:
    """The place `away` [m] behind agent `first` in row t, along the way it has come; straight on past that way's end.

    boxes (T, >= N, 5), valid (T, >= N): the rollout's rows. Boxes of logs jitter: of the rows before `since`, and of
    trails[i], only those count that lie apart.
    """
    x, y, heading = boxes[t, first, 0], boxes[t, first, 1], boxes[t, first, 2]
    back_x, back_y, left = -math.cos(heading), -math.sin(heading), away
    for k in range(t - 1, -1 - trails.shape[1], -1):
        if k >= 0:
            if not valid[k, first]:
                continue
            px, py = boxes[k, first, 0], boxes[k, first, 1]
        else:
            px, py = trails[i, -1 - k, 0], trails[i, -1 - k, 1]
            if math.isnan(px):
                break
        step = math.hypot(px - x, py - y)
        if step == 0.0 or (k < since and step < LOGGED_PATH_SPACING_M):
            continue
        back_x, back_y = (px - x) / step, (py - y) / step
        if step >= left:
            break
        left -= step
        x, y = px, py
    return x + left * back_x, y + left * back_y


@inner_kernel
def _pose_behind(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int, away: float
) -> tuple[float, float, float]:
    """x, y, heading of a part that is exactly on the way, `away` [m] behind agent `first` in row t."""
    half = CHORD * boxes[since, i, 3]
    x, y = point_behind(boxes, valid, first, t, since, trails, i, away)
    front_x, front_y = point_behind(boxes, valid, first, t, since, trails, i, max(away - half, 0.0))
    rear_x, rear_y = point_behind(boxes, valid, first, t, since, trails, i, away + half)
    return x, y, math.atan2(front_y - rear_y, front_x - rear_x)


@inner_kernel
def hitch(boxes: Array, valid: Bools, first: int, t: int, trails: Array, i: int) -> tuple[float, float, float]:
    """(path length behind agent `first` [m], offset to the left [m], turn [rad]) of agent i, coupled in row t."""
    away = math.hypot(boxes[t, i, 0] - boxes[t, first, 0], boxes[t, i, 1] - boxes[t, first, 1])
    for _ in range(ROUNDS):
        x, y, h = _pose_behind(boxes, valid, first, t, t, trails, i, away)
        away = max(away - (boxes[t, i, 0] - x) * math.cos(h) - (boxes[t, i, 1] - y) * math.sin(h), 0.0)
    x, y, h = _pose_behind(boxes, valid, first, t, t, trails, i, away)
    left = (boxes[t, i, 1] - y) * math.cos(h) - (boxes[t, i, 0] - x) * math.sin(h)
    return away, left, wrapped(boxes[t, i, 2] - h)


@inner_kernel
def faster_than_first(speed: float, hardest: float) -> float:
    """[m/s] above the first part's, below 0: slower, a step later, at `hardest` [m/s2]."""
    return math.copysign(max(abs(speed) - hardest * STEP_S, 0.0), speed)


@inner_kernel
def towed_pose(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int,
    away: float, offset: float, turn: float, travelled: float, blend_length: float,
) -> tuple[float, float, float]:  # fmt: skip
    """x, y, heading in row t of agent i, coupled in row `since` as `hitch` says, `travelled` [m] since then."""
    x, y, h = _pose_behind(boxes, valid, first, t, since, trails, i, away)
    keep, slope = fade(travelled, blend_length)
    heading = wrapped(h + turn * keep + math.atan(offset * slope))
    return x - math.sin(h) * offset * keep, y + math.cos(h) * offset * keep, heading
