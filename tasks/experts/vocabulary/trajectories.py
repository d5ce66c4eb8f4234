"""A vocabulary as the ego could drive it on from here: which trajectories, and how they start."""

from dataclasses import dataclass, field

import numpy as np

from tasks.experts.vocabulary.settings import VocabularySettings
from tasks.world.arrays import Array, Indices
from tasks.world.clip import STEP_S
from tasks.world.frames import wrap_angle
from tasks.world.vehicle import VX, YAW_RATE
from tasks.world.vocabulary import Vocabulary

FIT_STEPS = 5  # speed and yaw rate at the start are those of parabolas through the origin and the first 0.5 s


@dataclass(frozen=True)
class Moving:
    """K trajectories, how fast they start, and how far they have come."""

    vocabulary: Vocabulary
    speed_mps: Array = field(init=False)  # (K,) at the start
    yaw_rate_radps: Array = field(init=False)  # (K,)
    way_m: Array = field(init=False)  # (K, 41) along the poses at 0 .. 4.0 s

    def __post_init__(self) -> None:
        poses = self.vocabulary.trajectories
        t = STEP_S * np.arange(1, FIT_STEPS + 1)
        at_start = np.linalg.pinv(np.stack([t, t**2 / 2.0], axis=1))[0]
        steps = np.diff(poses[..., :2], axis=1, prepend=0.0)
        way = np.cumsum(np.hypot(steps[..., 0], steps[..., 1]), axis=1)
        turned = np.unwrap(poses[:, :FIT_STEPS, 2], axis=1)
        for name, value in (
            ("speed_mps", way[:, :FIT_STEPS] @ at_start),
            ("yaw_rate_radps", turned @ at_start),
            ("way_m", np.concatenate([np.zeros((len(way), 1)), way], axis=1)),
        ):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def starting_like(self, ego_state: Array, settings: VocabularySettings) -> Indices:
        """Those whose start is near the speed and yaw rate of `ego_state` (11,), in their order."""
        off_speed = np.abs(self.speed_mps - ego_state[VX]) / settings.speed_off_mps
        off_turn = np.abs(self.yaw_rate_radps - ego_state[YAW_RATE]) / settings.yaw_rate_off_radps
        return np.flatnonzero((off_speed <= 1.0) & (off_turn <= 1.0))

    def started_at(self, speed_mps: float, members: Indices, blend_s: float) -> Array:
        """(M, 40, 3) the members' paths at the ego's speed, which fades into their own: x, y, heading, ego frame.

        s(t) = s_own(t) + dv T (1 - exp(-t / T)), never backwards; beyond a path's end straight on. x, y, heading are
        linear between the poses, the ego's own among them.
        """
        t = STEP_S * np.arange(1, self.way_m.shape[1])
        faded = blend_s * (1.0 - np.exp(-t / blend_s))
        own, off = self.way_m[members], speed_mps - self.speed_mps[members]
        way = np.maximum.accumulate(np.maximum(own[:, 1:] + off[:, None] * faded, 0.0), axis=1)
        poses = self.vocabulary.trajectories[members]
        poses = np.concatenate([np.zeros((len(members), 1, 3)), poses], axis=1)
        after = (own[:, None, 1:] < way[:, :, None]).sum(axis=-1)  # whole segments behind
        k = np.minimum(after, own.shape[1] - 2)
        row = np.arange(len(members))[:, None]
        length = own[row, k + 1] - own[row, k]
        share = np.where(length > 0.0, (way - own[row, k]) / np.where(length > 0.0, length, 1.0), 0.0)
        inside = np.minimum(share, 1.0)
        before, then = poses[row, k], poses[row, k + 1]
        turn = wrap_angle(then[..., 2] - before[..., 2])
        heading = wrap_angle(before[..., 2] + inside * turn)
        xy = before[..., :2] + inside[..., None] * (then[..., :2] - before[..., :2])
        beyond = np.maximum(way - own[:, -1:], 0.0)
        along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return np.concatenate([xy + beyond[..., None] * along, heading[..., None]], axis=-1)
