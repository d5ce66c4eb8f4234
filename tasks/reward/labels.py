"""A vocabulary's labels, and what a drive's end leads to: what the reward asks of traffic that answers anew."""

import math

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.reward.areas import set_area_flags
from tasks.reward.centerline import empty_body, place_body
from tasks.reward.collisions import STOPPED_SPEED_MPS, first_collision, obstacles_of, within_reach
from tasks.reward.epdms import PreparedScene, RuleContext, Scores, collision_scores, rule_context, score, select_rows
from tasks.reward.label_bytes import ARRAYS, VocabularyLabels
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficScene, roll_out_longer
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import (
    AX,
    HALF_LENGTH,
    HALF_WIDTH,
    HEADING,
    PACIFICA,
    REAR_AXLE_TO_CENTER,
    STEERING,
    VX,
    YAW_RATE,
    X,
    Y,
)
from tasks.world.geometry import ego_boxes, touching
from tasks.world.road_map import CenterlineFinder, RoadMap, Route
from tasks.world.vocabulary import Vocabulary

TRAJECTORIES_AT_ONCE = 4096  # 15 MB of states


def vocabulary_labels(
    vocabulary: Vocabulary, scene: Scene, prepared: PreparedScene, reference: Array
) -> VocabularyLabels:
    """The scores of the whole vocabulary, driven by the tracker from the scene's ego state at the sample's now.

    prepared: the scene with the objects that the sample was judged among; reference: (41, 11) PDM-Closed as the tracker
    drives it, to which every trajectory's progress is related.
    """
    trajectories = vocabulary.trajectories
    parts: list[Scores] = []
    reference_m = 0.0
    for start in range(0, len(trajectories), TRAJECTORIES_AT_ONCE):
        driven = track(scene.ego_state, trajectories[start : start + TRAJECTORIES_AT_ONCE], local=True)
        scores = score(prepared, np.concatenate([reference[None], driven]), normalise="pairs")
        reference_m = float(scores.ep_raw_m[0] * scores.multiplier[0])
        parts.append(select_rows(scores, slice(1, None)))
    kept = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    return VocabularyLabels(vocabulary.digest, reference_m, **kept)


# Whether the route goes on where a drive ends (docs/reward.md 2m).

NEAR_M, NEAR_RAD = 0.5, math.radians(30.0)  # of a lane of the route
ONWARD_M = 20.0  # as far as the driving command looks


def route_ahead_m(road_map: RoadMap, route: Route, pose: Array) -> float | None:
    """Metres of the route's lanes ahead of a rear-axle pose (3,), along the longest way; inf: as far as is asked.

    Asked is for ONWARD_M, or to the route's end. None where the pose is on no lane of the route: farther than NEAR_M
    from its polygon, or turned against its centreline by more than NEAR_RAD. Raises NoRoute where the map has none of
    the route's lanes.
    """
    metres = CenterlineFinder(road_map, route).metres_ahead(pose, NEAR_M, NEAR_RAD, ONWARD_M)
    return metres if metres is None or metres < ONWARD_M else math.inf


# Whom a drive hits in the second after its end (docs/reward.md 2m).
#
# A drive is judged up to its last instant, time to collision up to 0.9 s before it. So it may end a moment before a
# collision that nobody can prevent any more. Here traffic and ego go on for a second: the ego at its speed and steering
# angle, or braking on the same arc.

AFTER_STEPS = 10  # 1 s
BRAKING_MPS2 = 3.0  # comfortable: what PDM-Closed brakes with (docs/reward.md 4)


def hit_after_s(traffic: TrafficScene, prepared: PreparedScene, states: Array, braking_mps2: float = 0.0) -> float:
    """Seconds from a drive's end to the first collision at fault in the second after it; inf: there is none.

    traffic: as the drive with states (41, 11) met it; prepared: the scene that it was judged in. The ego goes on as
    `extrapolate` has it, the traffic answers to that. At fault is what NC takes for it (docs/reward.md 2b); who touches
    the ego at the drive's end is left out, as who touches it at a scene's start is.
    """
    going_on = extrapolate(states, braking_mps2)
    tracks = roll_out_longer(traffic, going_on).window(HORIZON_STEPS, len(going_on))
    after = going_on[HORIZON_STEPS:].copy()
    left = tracks.valid.any(axis=0) & ~touching(ego_boxes(after[0], PACIFICA), tracks.boxes[0])
    boxes = np.where(tracks.valid[:, left, None], tracks.boxes[:, left], np.nan)
    score = collision_scores(tracks.kinds)[left]
    velocity = tracks.velocities[tracks.valid.argmax(axis=0), np.arange(len(tracks))]  # where it is first seen
    is_stopped = (score > 0.0) | (np.hypot(*velocity.T) <= STOPPED_SPEED_MPS)[left]
    return STEP_S * float(_first_hit(rule_context(prepared, with_history=False), boxes, is_stopped, score, after))


def extrapolate(states: Array, braking_mps2: float = 0.0) -> Array:
    """States (51, 11): those of a drive (41, 11), and a second more at its last steering angle.

    At its last speed, or slowing down by `braking_mps2` until it stands. On an arc, since the kinematic bicycle's
    curvature is tan(steering) / wheel base (docs/reward.md 1b).
    """
    end = states[-1]
    seconds = STEP_S * np.arange(1, AFTER_STEPS + 1)
    if braking_mps2 > 0.0:
        seconds = np.minimum(seconds, abs(end[VX]) / braking_mps2)
    slowing = math.copysign(braking_mps2, end[VX])
    way, curvature = end[VX] * seconds - 0.5 * slowing * seconds**2, math.tan(end[STEERING]) / PACIFICA.wheel_base
    turn = curvature * way
    chord = way * np.sinc(turn / (2.0 * np.pi))  # numpy's sinc has pi in it
    after = np.zeros((AFTER_STEPS, len(end)))
    after[:, X] = end[X] + chord * np.cos(end[HEADING] + turn / 2.0)
    after[:, Y] = end[Y] + chord * np.sin(end[HEADING] + turn / 2.0)
    after[:, HEADING] = end[HEADING] + turn
    after[:, VX] = end[VX] - slowing * seconds
    after[:, AX] = -slowing
    after[:, STEERING], after[:, YAW_RATE] = end[STEERING], curvature * after[:, VX]
    return np.concatenate([states, after])


@kernel
def _first_hit(context: RuleContext, boxes: Array, is_stopped: Bools, collision_score: Array, states: Array) -> float:
    """Index of the first collision at fault of states (T, 11) with boxes (T, N, 5), inf: none."""
    body = empty_body(states.shape[0])
    place_body(states, REAR_AXLE_TO_CENTER, body)
    set_area_flags(context.map_index, body, HALF_LENGTH, HALF_WIDTH)
    obstacles, ignored = obstacles_of(boxes, is_stopped, collision_score), np.empty(len(is_stopped), np.bool_)
    return first_collision(obstacles, within_reach(obstacles, body), states, body, ignored)[1]


# What the gate asks of an end.


def check_end(traffic: TrafficScene, prepared: PreparedScene, states: Array, gate: ExpertGate) -> Rejected | None:
    """None where a drive with states (41, 11) leads on; traffic: as it met it; prepared: the scene it was judged in."""
    clip = traffic.scene.clip
    if gate.off_route:
        metres = route_ahead_m(clip.road_map, clip.route, states[-1, : HEADING + 1])
        if metres is None:
            return Rejected("reward", "off_route", "ends on no lane of the route")
        if metres < math.inf:
            return Rejected("reward", "off_route", f"ends on a lane that leaves the route within {metres:.1f} m")
    if gate.after:
        going_on = hit_after_s(traffic, prepared, states)
        if going_on < math.inf:
            braking = hit_after_s(traffic, prepared, states, BRAKING_MPS2)
            if braking < math.inf:
                when = f"after {going_on:.1f} s, after {braking:.1f} s when it brakes"
                return Rejected("reward", "after", f"hits somebody {when}")
    return None
