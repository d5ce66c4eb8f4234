"""The slow twin of 2 Hz -> 10 Hz: a clip at 10 Hz thinned to its frames and brought back, track by track, in a loop.

Written from docs/reward.md 2 and the public metric_cache_processor.py, not looking at factory.datasets.navsim.window.
"""

from dataclasses import dataclass, replace
from math import atan2, cos, pi, sin

import numpy as np
import shapely

from tasks.world.clip import MOVING_KINDS, AgentKind, AgentTracks, Clip
from tasks.world.frames import PACIFICA, box_corners
from tasks.world.road_map import LightState, TrafficLights

FRAMES = 20
NOW, LATER, LAST = 3, 11, 19  # frames T, T+H, T+2H


@dataclass(frozen=True)
class Shown:
    """One object in one frame, world frame."""

    kind: AgentKind
    x: float
    y: float
    heading: float
    length: float
    width: float
    height: float
    vx: float
    vy: float
    z: float


def thinned(clip: Clip) -> Clip:
    """The clip as its frames every 0.5 s alone would give it."""
    ego = clip.ego_states[::5].copy()
    ego[:, 3:7] = ego[:, 3:7].astype(np.float32)  # velocity and acceleration, as the public reader keeps them
    states = np.zeros_like(clip.ego_states)
    for step in range(96):
        a, share = min(step // 5, FRAMES - 2), step / 5 - min(step // 5, FRAMES - 2)
        for column in (0, 1, 3, 4, 5, 6):
            states[step, column] = ego[a, column] + share * (ego[a + 1, column] - ego[a, column])
        turn = (ego[a + 1, 2] - ego[a, 2] + pi) % (2 * pi) - pi
        states[step, 2] = (ego[a, 2] + share * turn + pi) % (2 * pi) - pi
    red = clip.lights.states[::5] == LightState.RED
    lights = np.where(red, LightState.RED, LightState.GREEN).astype(np.int8)
    held = np.stack([lights[step // 5] for step in range(96)])
    frames = [_frame(clip.agents, step) for step in range(0, 96, 5)]
    return replace(
        clip,
        ego_states=states,
        agents=brought_to_10_hz(frames, ego[NOW, :3]),
        lights=TrafficLights(clip.lights.lane_ids, held),
    )


def _frame(agents: AgentTracks, step: int) -> dict[str, Shown]:
    out = {}
    for i in range(len(agents)):
        if agents.valid[step, i]:
            x, y, heading, length, width = agents.boxes[step, i]
            velocity = agents.velocities[step, i] if agents.kinds[i] in MOVING_KINDS else (0.0, 0.0)
            z, height = agents.center_z[step, i], agents.heights[i]
            out[agents.track_ids[i]] = Shown(agents.kinds[i], x, y, heading, length, width, height, *velocity, z)
    return out


def brought_to_10_hz(frames: list[dict[str, Shown]], ego_now: np.ndarray) -> AgentTracks:
    """20 frames, track id -> object, at 96 steps; ego_now: (3,) rear axle at T."""
    order = [*range(NOW, LATER + 1), *range(NOW), *range(LATER + 1, FRAMES)]
    names = list(dict.fromkeys(name for k in order for name in frames[k]))
    n = len(names)
    boxes, velocities = np.full((96, n, 5), np.nan), np.full((96, n, 2), np.nan)
    valid, center_z = np.zeros((96, n), bool), np.full((96, n), np.nan)
    kinds, heights = [], []
    for i, name in enumerate(names):
        kinds.append(next(frames[k][name].kind for k in order if name in frames[k]))
        heights.append(next(frames[k][name].height for k in range(FRAMES) if name in frames[k]))
        for first, last, judged in ((0, NOW, False), (LATER, LAST, True), (NOW, LATER, True)):
            shown = {k: frames[k][name] for k in range(first, last + 1) if name in frames[k]}
            for step in range(5 * first, 5 * last + 1):
                valid[step, i] = False
                boxes[step, i] = velocities[step, i] = center_z[step, i] = np.nan
                at = _at(shown, step, first, judged, ego_now if first == NOW else None)
                if at is None:
                    continue
                valid[step, i] = True
                size = shown[min(shown)]
                boxes[step, i] = at.x, at.y, at.heading, size.length, size.width
                velocities[step, i], center_z[step, i] = (at.vx, at.vy), at.z
    return AgentTracks(
        tuple(names), tuple(kinds), boxes, velocities, valid, center_z, np.array(heights, np.float64).reshape(n)
    )


def _at(shown: dict[int, Shown], step: int, first: int, judged: bool, ego_now: np.ndarray | None) -> Shown | None:
    """The object at a step, by the frames of one part that show it."""
    if not shown:
        return None
    begins, ends = min(shown), max(shown)
    if judged and begins == ends:  # a single frame: there at every step that is judged
        if step == 5 * first and begins != first:
            return None  # as planners find the frame itself
        if begins != first and ego_now is not None and _touches(shown[begins], ego_now):
            return None
        return shown[begins]
    if not 5 * begins <= step <= 5 * ends:
        return None
    before = max(k for k in shown if 5 * k <= step)
    if 5 * before == step:
        return shown[before]
    after = min(k for k in shown if 5 * k >= step)
    share = (step / 5 - before) / (after - before)
    a, b = shown[before], shown[after]
    turn = (b.heading - a.heading + pi) % (2 * pi) - pi
    heading = a.heading + share * turn
    return replace(
        a,
        x=a.x + share * (b.x - a.x),
        y=a.y + share * (b.y - a.y),
        heading=atan2(sin(heading), cos(heading)),
        vx=a.vx + share * (b.vx - a.vx),
        vy=a.vy + share * (b.vy - a.vy),
        z=a.z + share * (b.z - a.z),
    )


def _touches(thing: Shown, ego: np.ndarray) -> bool:
    shift = PACIFICA.rear_axle_to_center
    center = ego[0] + shift * cos(ego[2]), ego[1] + shift * sin(ego[2])
    body = np.array([*center, ego[2], PACIFICA.length, PACIFICA.width])
    box = np.array([thing.x, thing.y, thing.heading, thing.length, thing.width])
    return bool(shapely.Polygon(box_corners(body)).intersects(shapely.Polygon(box_corners(box))))
