"""What a simulator has sent of one rollout, and what a planner is shown of it at one moment.

Everything is kept by its stamp, never by its arrival: what was sent before a question may have come in any order.
Frames: `local` is the rollout's fixed one, `rig` the ego's: x ahead, y left, z up, origin on the ground below the rear
axle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from factory.readers.pictures import check_size, decode_rgb, read_header
from planners.data.batch import ImageLayout, one_hot_command
from planners.data.images import stitch, stitch_pixels
from planners.navsim.serve import AgentObservation
from tasks.trajectories import at_ten_hz
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import HORIZON_STEPS
from tasks.world.commands import CommandRule, command_of_points
from tasks.world.frames import to_local, to_world

SECOND_US = 1_000_000
STEP_US = SECOND_US // 10  # between the poses of an answer, and of a plan
FRAMES, ROUTES, STATES = 4, 8, 4096  # kept, the newest by their stamps: of each camera, of a session
EVERY_US = SECOND_US // 2  # the simulator's pictures and questions come so often
STALE_US = EVERY_US + STEP_US  # after which a pose or picture is none of now
APART_US = STEP_US  # of the pictures that are looked at as one
BLENDED_US = EVERY_US  # in which an answer goes over from the ego's own motion to the plan
HISTORY_US = np.arange(-3, 1) * EVERY_US
X, Y, HEADING, Z, VX, VY, AX, AY, YAW_RATE = range(9)  # of a state: local [m], [rad]; rig [m/s], [m/s2], [rad/s]
T = TypeVar("T")


class PoseUnknown(ValueError):
    """A question before what it is about was sent."""


class Unseen(ValueError):
    """The planner cannot be asked: it lacks a picture of now, or one of them is damaged."""


@dataclass
class Session:
    """One rollout. Not to be changed by two threads at once."""

    cameras: tuple[str, ...]  # whose pictures the planner looks at, left to right; names in lower case
    declared: frozenset[str]
    frames: dict[str, dict[int, bytes]] = field(default_factory=dict)
    states: dict[int, Array] = field(default_factory=dict)
    routes: dict[int, Array] = field(default_factory=dict)  # (N, 2) in the rig at the stamp; NaN where there is none

    def keep_frame(self, camera: str, stamp_us: int, picture: bytes) -> None:
        """One that the planner does not look at is checked alone. Raises ValueError for what is no picture."""
        if camera not in self.declared:
            raise ValueError(f"no camera {camera} was declared by start_session: {', '.join(sorted(self.declared))}")
        check_size(read_header(picture)[1])
        if camera in self.cameras:
            _keep(self.frames.setdefault(camera, {}), {stamp_us: picture}, FRAMES)

    def keep_states(self, states: Mapping[int, Array]) -> None:
        """States (9,) by stamp; one that is sent again takes the place of the earlier."""
        _keep(self.states, states, STATES)

    def keep_route(self, stamp_us: int, points: Array) -> None:
        """points: (N, 2) in the rig at the stamp."""
        _keep(self.routes, {stamp_us: points}, ROUTES)


def _keep(kept: dict[int, T], new: Mapping[int, T], most: int) -> None:
    kept.update(new)
    for stamp in sorted(kept)[:-most]:
        del kept[stamp]


@dataclass(frozen=True)
class Moment:
    """What there is to plan from: the session's past and the moment that a plan begins at."""

    session: Session
    stamp_us: int

    @property
    def state(self) -> Array:
        """(9,) of the ego."""
        return state_at(self.session.states, self.stamp_us)

    def observed(self, rule: CommandRule) -> AgentObservation:
        """History at 2 Hz, status and command."""
        states, now = self.session.states, self.state
        poses = np.stack([state_at(states, self.stamp_us + int(offset))[: HEADING + 1] for offset in HISTORY_US])
        history = to_local(now[: HEADING + 1], poses)
        command = one_hot_command(command_of_points(self.route_ahead(), rule))
        status = np.concatenate([command, now[[VX, VY, AX, AY]]])
        return AgentObservation(history, status)

    def route_ahead(self) -> Array:
        """(N, 2) of the newest route by now, in the rig now."""
        session = self.session
        stamp = max((stamp for stamp in session.routes if stamp <= self.stamp_us), default=None)
        if stamp is None:
            return np.empty((0, 2))
        points = session.routes[stamp]
        if stamp == self.stamp_us:
            return points
        then = state_at(session.states, stamp)[: HEADING + 1]
        there = to_world(then, np.column_stack([points, np.zeros(len(points))]))
        return to_local(self.state[: HEADING + 1], there)[:, :2]

    def draw(self, layout: ImageLayout) -> Bytes:
        """The planner's picture, as `planners.data.images` makes it. Raises Unseen."""
        out = np.empty((layout.height, layout.width, 3), np.uint8)
        kept = [self.session.frames[camera] for camera in self.session.cameras]
        pictures = [frames[newest_by(frames, self.stamp_us)] for frames in kept]
        try:
            if all(read_header(picture)[0] == "JPEG" for picture in pictures):
                stitch([np.frombuffer(picture, np.uint8) for picture in pictures], layout, out)
            else:
                stitch_pixels([decode_rgb(picture) for picture in pictures], layout, out)
        except ValueError as error:
            raise Unseen(f"a picture of {', '.join(self.session.cameras)}: {error}") from error
        return out


def moment_of(session: Session, now_us: int) -> Moment:
    """The moment of the newest pictures by now; now itself where the planner looks at none.

    Raises PoseUnknown where the ego's pose is not known now, Unseen where a camera has no picture of it.
    """
    newest = max(session.states, default=None)
    if newest is None or now_us - newest > STALE_US or now_us < min(session.states):
        known = "none" if newest is None else f"{min(session.states)} to {newest} us"
        raise PoseUnknown(f"time_now_us={now_us}: send the ego's poses up to it before drive; known: {known}")
    if not session.cameras:
        return Moment(session, now_us)
    stamps = {camera: newest_by(session.frames.get(camera, {}), now_us) for camera in session.cameras}
    at = max(stamps.values())
    for camera, stamp in stamps.items():
        if now_us - stamp > STALE_US or at - stamp > APART_US:
            raise Unseen(f"no picture of {camera} of now")
    return Moment(session, at)


def newest_by(kept: Mapping[int, Any], now_us: int) -> int:
    """The newest stamp by now; one long ago where there is none."""
    return max((stamp for stamp in kept if stamp <= now_us), default=-(1 << 62))


def state_at(states: Mapping[int, Array], stamp_us: int) -> Array:
    """(9,) interpolated between the states around a stamp; beyond them, on at the nearest one's speed and yaw rate.

    The first poses of a rollout may be 17 ms apart: nothing is taken from their difference.
    """
    stamps = sorted(states)
    after = int(np.searchsorted(np.array(stamps), stamp_us))
    if after < len(stamps) and stamps[after] == stamp_us:
        return states[stamp_us]
    if 0 < after < len(stamps):
        first, second = stamps[after - 1], stamps[after]
        a, b = states[first], states[second].copy()
        b[HEADING] = a[HEADING] + float(to_local(a[: HEADING + 1], b[: HEADING + 1])[HEADING])
        share = (stamp_us - first) / (second - first)
        return (1.0 - share) * a + share * b
    nearest = stamps[min(after, len(stamps) - 1)]
    moved = states[nearest].copy()
    moved[: HEADING + 1] = to_world(moved[: HEADING + 1], driven_on(moved, (stamp_us - nearest) / SECOND_US))
    return moved


def driven_on(state: Array, after_s: float | Array) -> Array:
    """(..., 3) where speed and yaw rate lead from a state, in its own frame: an arc."""
    turned = state[YAW_RATE] * np.asarray(after_s)
    chord = state[VX] * np.asarray(after_s) * np.sinc(turned / (2.0 * np.pi))
    return np.stack([chord * np.cos(turned / 2.0), chord * np.sin(turned / 2.0), turned], axis=-1)


def straight_on(state: Array) -> Array:
    """(40, 3) for want of a plan: straight ahead at the ego's speed."""
    after_s = np.arange(1, HORIZON_STEPS + 1) * STEP_US / SECOND_US
    return np.column_stack([max(state[VX], 0.0) * after_s, np.zeros((HORIZON_STEPS, 2))])


def local_poses(plan: Array, state: Array, begin_us: int, now_us: int, query_us: int) -> dict[int, Array]:
    """Stamp -> x, y [m], heading [rad] in `local`, every 0.1 s from now to 4 s later, or beyond the queried time.

    plan: (8 or 40, 3) from the ego's `state` at `begin_us` on, on whose clock it stays. In its first 0.5 s it goes over
    from the ego's own speed and yaw rate, which a plan at 2 Hz jumps from. After its end it goes on at its last speed.
    """
    knots = np.concatenate([np.zeros((1, 3)), at_ten_hz(plan[None])[0]])
    knots[:, HEADING] = np.unwrap(knots[:, HEADING])
    knots_us = np.arange(len(knots)) * STEP_US
    share = np.clip(knots_us / BLENDED_US, 0.0, 1.0)
    share = (share**2 * (3.0 - 2.0 * share))[:, None]
    knots = share * knots + (1.0 - share) * driven_on(state, knots_us / SECOND_US)
    steps = max(HORIZON_STEPS, -(-(query_us - now_us) // STEP_US))
    stamps = [now_us + STEP_US * i for i in range(steps + 1)]
    after_us = np.array([stamp - begin_us for stamp in stamps])
    poses = np.stack([np.interp(after_us, knots_us, knots[:, i]) for i in range(3)], axis=-1)
    beyond = np.maximum(after_us - knots_us[-1], 0)[:, None] / STEP_US
    poses[:, :HEADING] += beyond * (knots[-1] - knots[-2])[:HEADING]
    return dict(zip(stamps, to_world(state[: HEADING + 1], poses)))
