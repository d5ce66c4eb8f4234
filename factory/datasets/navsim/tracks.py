"""2 Hz frames as 10 Hz states, as the public code makes them; frame k stands at 0.5 k s, whatever its stamp.

Rules of docs/reward.md 2 (autonomousvision/navsim @ 0a380a9, metric_cache_processor.py:99-267): a
box and its velocity are placed by the ego pose of their frame and are linear in between in x, y, unwrapped heading, vx,
vy; size and class are those of the first frame. An object is there from its first to its last frame OF THE 4 S THAT ARE
JUDGED, and one that is seen in a single frame of them stands there at all of their steps. So the frames of a window are
taken in three parts that know nothing of each other: before T, T to T+H, T+H to T+2H. The step T itself holds what its
frame shows, as planners find it; an object of a single frame whose box would touch the ego there is left out, since the
public log replay drops it. A light holds its state until the next frame.

Between frames the ego's pose, velocity and acceleration are linear too. Steering and rates are 0, as there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from factory.datasets.navsim.log import Frame
from factory.readers.settings import FRAME_STEPS
from tasks.world.arrays import Array, Bools
from tasks.world.clip import CLIP_STEPS, HISTORY_STEPS, HORIZON_STEPS, MOVING_KINDS, AgentKind, AgentTracks
from tasks.world.frames import AX, EGO_STATE_SIZE, HEADING, PACIFICA, VX, X, wrap_angle
from tasks.world.geometry import ego_boxes, touching
from tasks.world.road_map import LightState, TrafficLights

FRAMES_BEFORE = HISTORY_STEPS // FRAME_STEPS  # of T in a window
HORIZON_FRAMES = HORIZON_STEPS // FRAME_STEPS
WINDOW_FRAMES = (CLIP_STEPS - 1) // FRAME_STEPS + 1  # 20
BOX, VELOCITY, HEIGHT_AT = slice(0, 3), slice(3, 5), 5  # columns of what is linear between frames


@dataclass(frozen=True)
class SeenBoxes:
    """What F frames show of N objects, world frame; NaN where a frame does not show one."""

    track_ids: tuple[str, ...]  # (N,)
    kinds: tuple[AgentKind, ...]  # (N,)
    linear: Array  # (F, N, 6) centre x, y [m], unwrapped heading [rad], vx, vy [m/s], centre z [m]
    sizes: Array  # (F, N, 3) length, width, height [m]

    @property
    def valid(self) -> Bools:
        """(F, N)"""
        return np.isfinite(self.linear[..., 0])


def n_steps(n_frames: int) -> int:
    """Steps of 0.1 s from the first of n frames to the last, both counted."""
    return FRAME_STEPS * (n_frames - 1) + 1


def ego_states(frames: Sequence[Frame]) -> Array:
    """Ego states (S, 11) from the first frame to the last."""
    known = np.zeros((len(frames), EGO_STATE_SIZE))
    known[:, X : HEADING + 1] = [frame.pose for frame in frames]
    known[:, HEADING] = np.unwrap(known[:, HEADING])
    known[:, VX : AX + 2] = [frame.dynamic_state for frame in frames]
    states = _between(known)
    states[:, HEADING] = wrap_angle(states[:, HEADING])
    return states


def world_from_ego(frames: Sequence[Frame]) -> Array:
    """Ego poses in space (S, 4, 4): linear in position, spherical in rotation."""
    known = np.stack([frame.world_from_ego for frame in frames])
    at = np.arange(n_steps(len(frames))) / FRAME_STEPS
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, 3] = _between(known[:, :3, 3])
    turned = Rotation.from_matrix(known[:, :3, :3])
    poses[:, :3, :3] = Slerp(np.arange(len(frames)), turned)(at).as_matrix() if len(frames) > 1 else turned.as_matrix()
    return poses


def lights(frames: Sequence[Frame], lane_ids: Sequence[str]) -> TrafficLights:
    """The lights (S, L) of those `lane_ids` that any frame names; unknown in frames that do not name them."""
    wanted = frozenset(lane_ids)
    named = sorted({lane_id for frame in frames for lane_id, _ in frame.lights if lane_id in wanted})
    column = {lane_id: i for i, lane_id in enumerate(named)}
    known = np.full((len(frames), len(named)), LightState.UNKNOWN, np.int8)
    for row, frame in zip(known, frames):
        for lane_id, is_red in frame.lights:
            if lane_id in column and row[column[lane_id]] != LightState.RED:  # red where it is named twice
                row[column[lane_id]] = LightState.RED if is_red else LightState.GREEN
    return TrafficLights(tuple(named), known[np.arange(n_steps(len(frames))) // FRAME_STEPS])


def window_agents(frames: Sequence[Frame]) -> AgentTracks:
    """The objects of a window of 20 frames over its 96 steps, as the module says."""
    assert len(frames) == WINDOW_FRAMES
    now, later, end = FRAMES_BEFORE, FRAMES_BEFORE + HORIZON_FRAMES, WINDOW_FRAMES
    seen = _seen(frames, (*range(now, later + 1), *range(now), *range(later + 1, end)))  # T's horizon has the first say
    agents = _nowhere(seen, CLIP_STEPS)
    for first, last, judged in ((0, now, False), (later, end - 1, True), (now, later, True)):
        _write(agents, seen, frames, first, last, judged)
    return agents


def stretch_agents(frames: Sequence[Frame]) -> AgentTracks:
    """The objects of any number of frames, each from its first frame to its last."""
    seen = _seen(frames, range(len(frames)))
    agents = _nowhere(seen, n_steps(len(frames)))
    _write(agents, seen, frames, 0, len(frames) - 1, False)
    return agents


def _between(known: Array) -> Array:
    """Rows (F, ...) at frames as rows (S, ...) at steps, linear."""
    at = np.arange(n_steps(len(known)))
    before = np.minimum(at // FRAME_STEPS, max(len(known) - 2, 0))
    share = (at / FRAME_STEPS - before).reshape(-1, *[1] * (known.ndim - 1))
    after = np.minimum(before + 1, len(known) - 1)
    return np.asarray(known[before] + share * (known[after] - known[before]))


def _seen(frames: Sequence[Frame], order: Sequence[int]) -> SeenBoxes:
    """The objects of frames; order: in which the frames say what an object is. A frame without boxes shows none."""
    kind_of: dict[str, AgentKind] = {}
    for boxes in (frames[i].boxes for i in order):
        if boxes is not None:
            for track_id, kind in zip(boxes.track_tokens, boxes.kinds):
                kind_of.setdefault(track_id, kind)
    column = {track_id: i for i, track_id in enumerate(kind_of)}
    linear = np.full((len(frames), len(column), 6), np.nan)
    sizes = np.full((len(frames), len(column), 3), np.nan)
    for row, frame in enumerate(frames):
        if frame.boxes is not None:
            at = [column[track_id] for track_id in frame.boxes.track_tokens]
            linear[row, at] = _in_world(frame)
            sizes[row, at] = frame.boxes.boxes[:, 3:6]
    stands = np.array([kind not in MOVING_KINDS for kind in kind_of.values()], bool)
    linear[:, stands, VELOCITY] = 0.0  # a thing that stands has no velocity in the public code, whatever the log says
    return SeenBoxes(tuple(kind_of), tuple(kind_of.values()), linear, sizes)


def _in_world(frame: Frame) -> Array:
    """(N, 6) as in `SeenBoxes.linear`: turned by the ego's heading alone, the height by its whole pose."""
    assert frame.boxes is not None
    boxes, velocities = frame.boxes.boxes, frame.boxes.velocities
    (x, y, heading), space = frame.pose, frame.world_from_ego
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [
            boxes[:, 0] * c - boxes[:, 1] * s + x,
            boxes[:, 0] * s + boxes[:, 1] * c + y,
            wrap_angle(boxes[:, 6] + heading),
            velocities[:, 0] * c - velocities[:, 1] * s,
            velocities[:, 0] * s + velocities[:, 1] * c,
            boxes[:, :3] @ space[2, :3] + space[2, 3],
        ]
    )


def _nowhere(seen: SeenBoxes, steps: int) -> AgentTracks:
    """Tracks that are absent at all steps."""
    n = len(seen.track_ids)
    known = seen.valid
    first = np.argmax(known, axis=0)
    return AgentTracks(
        track_ids=seen.track_ids,
        kinds=seen.kinds,
        boxes=np.full((steps, n, 5), np.nan),
        velocities=np.full((steps, n, 2), np.nan),
        valid=np.zeros((steps, n), bool),
        center_z=np.full((steps, n), np.nan),
        heights=seen.sizes[first, np.arange(n), 2],
    )


def _write(agents: AgentTracks, seen: SeenBoxes, frames: Sequence[Frame], first: int, last: int, judged: bool) -> None:
    """Frames first..last into the steps from the one to the other, whatever stood there."""
    steps = slice(FRAME_STEPS * first, FRAME_STEPS * last + 1)
    at = np.arange(n_steps(last - first + 1))
    known = seen.valid[first : last + 1]
    agents.valid[steps] = False
    for column in (agents.boxes, agents.velocities, agents.center_z):
        column[steps] = np.nan
    for i in np.flatnonzero(known.any(axis=0)):
        shown = np.flatnonzero(known[:, i])
        here = (at >= FRAME_STEPS * shown[0]) & (at <= FRAME_STEPS * shown[-1])
        rows = seen.linear[first + shown, i]
        rows[:, 2] = np.unwrap(rows[:, 2])
        size = seen.sizes[first + shown[0], i]
        if judged and len(shown) == 1:
            here = (at > 0) | (shown[0] == 0)  # at all steps that are judged, but for the first ...
            box = np.concatenate([rows[0, BOX], size[:2]])
            if not here[0] and bool(touching(box, ego_boxes(_rear_axle(frames[first]), PACIFICA))):
                continue  # ... and never where it would touch the ego at that one
        linear = np.stack([np.interp(at[here], FRAME_STEPS * shown, column) for column in rows.T], axis=1)
        step = np.arange(steps.start, steps.stop)[here]
        agents.valid[step, i] = True
        agents.boxes[step, i, :3], agents.boxes[step, i, 3:] = linear[:, BOX], size[:2]
        agents.boxes[step, i, 2] = wrap_angle(linear[:, 2])
        agents.velocities[step, i], agents.center_z[step, i] = linear[:, VELOCITY], linear[:, HEIGHT_AT]


def _rear_axle(frame: Frame) -> Array:
    state = np.zeros(EGO_STATE_SIZE)
    state[X : HEADING + 1] = frame.pose
    return state
