"""Score one's own trajectories on a clip: poses in, sub-scores out (docs/reward.md 1, 2 and 4)."""

from typing import Literal

import numpy as np

from tasks.experts.pdm_closed import plan_for
from tasks.kernels.compiled import kernel
from tasks.reward.comfort import unwrap
from tasks.reward.epdms import N_TIMES, Scores, prepare_scene, score, select_rows
from tasks.rollout.lqr import track
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, Scene, scene_of_clip
from tasks.world.frames import HEADING

Reference = Literal["pdm_closed", "batch"]

COARSE_STEPS = 8  # 4 s at 2 Hz, the public planners' output
_PLACE = np.arange(1, HORIZON_STEPS + 1) * STEP_S / (HORIZON_STEPS * STEP_S / COARSE_STEPS)
BEFORE = np.minimum(_PLACE.astype(np.int64), COARSE_STEPS - 1)  # (40,) the knot before, the ego's pose being knot 0
SHARE = _PLACE - BEFORE  # (40,) of the way to the next


def score_trajectories(clip: Clip, poses: Array, *, reference: Reference | Array = "pdm_closed") -> Scores:
    """Scores of K plans made at T of the clip, driven by the tracker among the logged traffic, without human filter.

    poses: (K, 40, 3) at 0.1 .. 4.0 s or (K, 8, 3) at 0.5 .. 4.0 s: x, y, heading in the ego frame at T.
    reference: what progress, and with it the score, is relative to.
      "pdm_closed": each row is scored in the two-row batch with PDM-Closed, as published scores are;
      (40 or 8, 3) poses: the same with that plan in its place;
      "batch": the K rows are scored against each other. The best compliant one has EP 1 however slow it is, and all
      have where none gets further than 5 m: a standing car alone scores 1. Comparable within this call only.
    Raises ValueError for other shapes, non-finite poses, another word, or a route without length.
    """
    plans = at_ten_hz(np.asarray(poses, dtype=np.float64))
    scene = scene_of_clip(clip)
    states = track(scene.ego_state, plans, local=True)
    prepared = prepare_scene(scene, clip.agents.window(NOW, NOW + N_TIMES))
    if isinstance(reference, str) and reference == "batch":
        return score(prepared, states)
    pair = np.concatenate([_reference_states(scene, reference), states])
    return select_rows(score(prepared, pair, normalise="pairs"), slice(1, None))


def _reference_states(scene: Scene, reference: Reference | Array) -> Array:
    """(1, 41, 11) the reference as the tracker drives it."""
    if not isinstance(reference, str):
        plan = at_ten_hz(np.asarray(reference, dtype=np.float64)[None])
        return track(scene.ego_state, plan, local=True)
    if reference != "pdm_closed":
        raise ValueError(f'reference must be "pdm_closed", "batch" or poses, got {reference!r}')
    return plan_for(scene).driven[None]


def at_ten_hz(poses: Array) -> Array:
    """Ego-frame plans (K, 40, 3) from (K, 40, 3) or, linearly from the ego's pose on, from (K, 8, 3) at 2 Hz."""
    if poses.ndim != 3 or poses.shape[1] not in (HORIZON_STEPS, COARSE_STEPS) or poses.shape[2] != 3:
        raise ValueError(f"poses must be (K, {HORIZON_STEPS} or {COARSE_STEPS}, 3), got {poses.shape}")
    return poses if poses.shape[1] == HORIZON_STEPS else interpolated(np.ascontiguousarray(poses, np.float64))


@kernel
def interpolated(poses: Array) -> Array:
    """Ego-frame plans (K, 40, 3) at 10 Hz, linear between the ego's pose and those (K, 8, 3) at 2 Hz."""
    fine, knots = np.empty((len(poses), HORIZON_STEPS, 3)), np.zeros(COARSE_STEPS + 1)
    for k in range(len(poses)):
        for c in range(3):
            knots[1:] = poses[k, :, c]
            if c == HEADING:
                unwrap(knots, 1)
            for t in range(HORIZON_STEPS):
                before, share = BEFORE[t], SHARE[t]
                fine[k, t, c] = (1.0 - share) * knots[before] + share * knots[before + 1]
    return fine
