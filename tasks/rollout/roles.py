"""The agents' roles, as a scene's log gives them: who stands, who joins the lanes when, who starts when."""

import numpy as np

from tasks.rollout.lane_index import LaneIndex, lane_costs, on_a_lane
from tasks.world.agents import AgentTracks
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene

NEVER = 1_000_000  # a step no clip has
STANDS_WITHIN_M, STANDS_BELOW_MPS = 1.0, 0.3  # over a whole log: boxes of parked cars jitter by decimetres
STARTED_AFTER_M = 0.5  # a car that stood has started


def stands_always(log: AgentTracks) -> Bools:
    """(N,) tracks that never leave their place."""
    seen = log.valid.sum(axis=0)
    first = np.take_along_axis(log.boxes[..., :2], log.valid.argmax(axis=0)[None, :, None], axis=0)
    away = np.hypot(*np.moveaxis(log.boxes[..., :2] - first, -1, 0))
    way = np.where(log.valid, away, 0.0).max(axis=0)
    stands: Bools = (way < STANDS_WITHIN_M) & (way < STANDS_BELOW_MPS * STEP_S * (seen - 1) + 0.1)
    return stands & (seen >= 2)


def join_steps(index: LaneIndex, scene: Scene) -> Ints:
    """(N,) the scene's step for agents that are on a lane now, NEVER for all others."""
    start = scene.step
    out = np.full(len(scene.agents), NEVER)
    here = np.flatnonzero(scene.agents.valid[start])
    on = on_a_lane(*lane_costs(index, scene.agents.boxes[start, here, :3])).any(axis=1)
    out[here[on]] = start
    return out


def later_join_step(index: LaneIndex, scene: Scene, i: int) -> int:
    """First later step at which agent i is on a lane; NEVER if it never is."""
    log, start = scene.clip.agents, scene.step
    steps = start + 1 + np.flatnonzero(log.valid[start + 1 : start + HORIZON_STEPS + 1, i])
    on = on_a_lane(*lane_costs(index, log.boxes[steps, i, :3])).any(axis=1)
    return int(steps[on.argmax()]) if on.any() else NEVER


def start_step(log: AgentTracks, i: int, step: int) -> int:
    """When a vehicle that stands at `step` starts in its log: 0 if it moves at `step`, NEVER if it does not start."""
    if not log.valid[step, i] or np.hypot(*log.velocities[step, i]) >= STANDS_BELOW_MPS:
        return 0
    away = np.hypot(*(log.boxes[step:, i, :2] - log.boxes[step, i, :2]).T)
    started = log.valid[step:, i] & (np.nan_to_num(away) > STARTED_AFTER_M)
    return step + int(np.argmax(started)) if started.any() else NEVER


def clocks(scene: Scene) -> Ints:
    """(N,) the step of its log each agent is at: the scene's, or earlier for one that an earlier rollout made wait."""
    log, start = scene.clip.agents, scene.step
    here = scene.agents.boxes[start, :, :2]
    away = np.where(log.valid[: start + 1], np.hypot(*np.moveaxis(log.boxes[: start + 1, :, :2] - here, -1, 0)), np.inf)
    backwards = np.where(np.isnan(away), np.inf, away)[::-1]  # the latest of equal ones
    clock: Ints = start - np.argmin(backwards, axis=0)
    return clock


def logged_track(scene: Scene, i: int, clock: int) -> Array:
    """(K, 5) x, y, heading, height, speed of agent i: where it is, if it is there, then its log after step `clock`."""
    parts = []
    for agents, steps in (
        (scene.agents, slice(scene.step, scene.step + 1)),
        (scene.clip.agents, slice(clock + 1, None)),
    ):
        seen = agents.valid[steps, i]
        speed = np.hypot(*agents.velocities[steps, i].T)
        parts.append(np.column_stack([agents.boxes[steps, i, :3], agents.center_z[steps, i], speed])[seen])
    return np.concatenate(parts)
