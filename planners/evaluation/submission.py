"""A submission to NAVSIM's leaderboard, read as data: the plans of whichever agent wrote it, scene by scene.

What run_create_submission_pickle.py writes of any agent of NAVSIM (autonomousvision/navsim @ 0a380a9,
navsim/planning/script), of both its eras: one stage under `predictions`, or two.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factory.readers.base import BadClip
from factory.readers.pickles import Record, load_records
from tasks.trajectories import COARSE_STEPS, at_ten_hz
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS

TRAJECTORY = "navsim.common.dataclasses Trajectory"
SAMPLING = "nuplan.planning.simulation.trajectory.trajectory_sampling TrajectorySampling"
STAGES = ("predictions", "first_stage_predictions", "second_stage_predictions")
STEPS = {0.5: COARSE_STEPS, 0.1: HORIZON_STEPS}  # poses of 4 s by the seconds between them


def read_submission(path: Path) -> dict[str, Array]:
    """Token of a scene's frame at now -> its plan (40, 3) at 10 Hz: x, y [m], heading [rad] in the ego frame there.

    Of longer plans the first 4 s. Raises BadClip that names file and token.
    """
    content = load_records(path.read_bytes(), str(path), (TRAJECTORY, SAMPLING))
    stages = content if isinstance(content, dict) else {}
    found = [stages[name] for name in STAGES if name in stages]
    if not found:
        raise BadClip(str(path), "pickle", f"no submission: none of {', '.join(STAGES)} in it")
    plans: dict[str, Array] = {}
    for stage in found:
        if not isinstance(stage, list) or len(stage) != 1 or not isinstance(stage[0], dict):
            raise BadClip(str(path), "predictions", "no list of one dictionary, as NAVSIM's script writes it")
        plans |= {str(token): _plan(path, token, one) for token, one in stage[0].items()}
    return plans


def _plan(path: Path, token: object, one: object) -> Array:
    fields: Mapping[str, Any] = one.state if isinstance(one, Record) else {}
    poses, sampling = fields.get("poses"), fields.get("trajectory_sampling")
    apart = sampling.state.get("interval_length") if isinstance(sampling, Record) else None
    if not isinstance(poses, np.ndarray) or poses.dtype.kind != "f" or not isinstance(apart, float):
        raise BadClip(str(path), f"token {token}", "no Trajectory of poses and their sampling")
    steps = next((steps for length, steps in STEPS.items() if abs(apart - length) < 1e-6), None)
    if steps is None or poses.ndim != 2 or poses.shape[1] != 3 or len(poses) < steps:
        problem = f"{poses.shape} poses {apart:g} s apart; 4 s of them, 0.5 or 0.1 s apart, are scored"
        raise BadClip(str(path), f"token {token}", problem)
    if not np.isfinite(poses[:steps]).all():
        raise BadClip(str(path), f"token {token}", "a pose is not finite")
    return np.asarray(at_ten_hz(poses[None, :steps].astype(np.float64))[0])
