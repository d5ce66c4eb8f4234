"""Score one's own trajectories on a clip: poses in, sub-scores out (docs/reward.md 1 and 2)."""

import numpy as np
from numpy.typing import NDArray

from tasks.reward.epdms import Scores, rows, score
from tasks.reward.prepare import N_TIMES, prepare_scene
from tasks.rollout.lqr import track
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, scene_of_clip
from tasks.world.frames import to_world

Array = NDArray[np.float64]

COARSE_STEPS = 8  # 4 s at 2 Hz, the public planners' output


def score_trajectories(clip: Clip, poses: Array, *, rival: Array | None = None) -> Scores:
    """Scores of K plans made at T of the clip, driven by the tracker among the logged traffic.

    poses: (K, 40, 3) at 0.1 .. 4.0 s or (K, 8, 3) at 0.5 .. 4.0 s: x, y, heading in the ego frame at T.
    rival: (40 or 8, 3) the plan whose progress each row is held against, as the public metric does with PDM-Closed;
    without it progress is relative to the best row. Raises ValueError for other shapes or non-finite poses.
    """
    plans = at_ten_hz(np.asarray(poses, dtype=np.float64))
    if rival is not None:
        plans = np.concatenate([at_ten_hz(np.asarray(rival, dtype=np.float64)[None]), plans])
    scene = scene_of_clip(clip)
    states = track(scene.ego_state, to_world(scene.ego_state[:3], plans))
    prepared = prepare_scene(scene, clip.agents.window(NOW, NOW + N_TIMES))
    if rival is None:
        return score(prepared, states)
    return rows(score(prepared, states, normalise="pairs"), slice(1, None))


def at_ten_hz(poses: Array) -> Array:
    """Ego-frame plans (K, 40, 3) from (K, 40, 3) or, linearly from the ego's pose on, from (K, 8, 3) at 2 Hz."""
    if poses.ndim != 3 or poses.shape[1] not in (HORIZON_STEPS, COARSE_STEPS) or poses.shape[2] != 3:
        raise ValueError(f"poses must be (K, {HORIZON_STEPS} or {COARSE_STEPS}, 3), got {poses.shape}")
    if poses.shape[1] == HORIZON_STEPS:
        return poses
    knots = np.concatenate([np.zeros((len(poses), 1, 3)), poses], axis=1)
    knots[..., 2] = np.unwrap(knots[..., 2], axis=1)
    position = np.arange(1, HORIZON_STEPS + 1) * STEP_S / (HORIZON_STEPS * STEP_S / COARSE_STEPS)
    before = np.minimum(position.astype(np.int64), COARSE_STEPS - 1)
    share = (position - before)[:, None]
    fine: Array = (1.0 - share) * knots[:, before] + share * knots[:, before + 1]
    return fine
