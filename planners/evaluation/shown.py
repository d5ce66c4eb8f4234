"""What an evaluated planner is shown of a sample: everything up to now, nothing that only comes later.

label_*, proposal_10hz                      zeros (the drive that followed)
stage1_*, stage2_*, label_subscores, ...    None (scores)
agent_boxes, agent_velocities, ...          NaN, and agent_valid False, after now
light_states                                0, unknown, after now
parent_states                               the logged state at T+H is NaN in frames at or before T
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from factory.store.reader import LABEL_COLUMNS, Sample
from factory.store.schema import NOW_INDEX, SCHEMA
from planners.data.batch import COMMANDS, Batch, Needs
from planners.data.bev import bev_raster, nearest_agents
from planners.data.feed import BEV_COLUMNS
from planners.data.images import stitched
from planners.evaluation.frames import LOGGED_KINDS

SCORES = ("stage1_", "stage2_", *LABEL_COLUMNS)
LATER_NAN = ("agent_boxes", "agent_velocities", "agent_center_z")
LATER_ZERO = ("agent_valid", "light_states")
EGO_COLUMNS = ("attempt_id", "expert", "command", "ego_status", "ego_history_2hz")


def as_shown(sample: Mapping[str, Any]) -> Sample:
    """A copy of a sample, or of some of its columns, without what comes after now."""
    shown: Sample = {name: value for name, value in sample.items() if not name.startswith(SCORES)}
    for name in ("label_10hz", "label_2hz", "proposal_10hz"):
        if shown.get(name) is not None:
            shown[name] = np.zeros_like(shown[name])
    for names, unknown in ((LATER_NAN, np.nan), (LATER_ZERO, 0)):
        for name in shown.keys() & set(names):
            shown[name] = np.array(sample[name])
            if len(shown[name]):
                shown[name][:, NOW_INDEX + 1 :] = unknown
    if "parent_states" in shown and sample["expert"] in LOGGED_KINDS:
        shown["parent_states"] = np.array(sample["parent_states"])
        shown["parent_states"][1] = np.nan
    return shown


def columns_shown(needs: Needs | None) -> list[str]:
    """The columns that have to be read of a sample for a batch with these needs; None: all that may be shown."""
    if needs is None:
        return [name for name in SCHEMA.names if not name.startswith(SCORES)]
    bev = BEV_COLUMNS if needs.bev is not None else ()
    return [*EGO_COLUMNS, *bev, *(("cameras", "images") if needs.image is not None else ())]


def batch_of(samples: Sequence[Mapping[str, Any]], needs: Needs) -> Batch:
    """The batch that a planner plans for. Raises ValueError, naming the sample, where it lacks what `needs` asks."""
    rasters, boxes, valid, pictures = [], [], [], []
    for sample in samples:
        try:
            if needs.image is not None:
                pictures.append(stitched(sample, needs.image).transpose(2, 0, 1))
            if needs.bev is not None:
                rasters.append(bev_raster(sample, needs.bev))
                nearest = nearest_agents(sample, needs.bev, needs.n_agents)
                boxes.append(nearest[0])
                valid.append(nearest[1])
        except ValueError as error:
            raise ValueError(f"sample {sample['attempt_id']}: {error}") from error
    n = len(samples)
    return Batch(
        attempt_ids=tuple(str(sample["attempt_id"]) for sample in samples),
        status=torch.from_numpy(np.stack([_status(sample) for sample in samples])),
        history=torch.from_numpy(np.stack([np.asarray(s["ego_history_2hz"], np.float32) for s in samples])),
        plan_2hz=torch.zeros(n, 8, 3),
        plan_10hz=torch.zeros(n, 40, 3),
        simulated=torch.tensor([sample["expert"] not in LOGGED_KINDS for sample in samples]),
        imitate=torch.zeros(n, dtype=torch.bool),
        image=torch.from_numpy(np.ascontiguousarray(np.stack(pictures))) if pictures else None,
        bev=torch.from_numpy(np.stack(rasters)) if rasters else None,
        agents=torch.from_numpy(np.stack(boxes)) if needs.n_agents else None,
        agents_valid=torch.from_numpy(np.stack(valid)) if needs.n_agents else None,
    )


def _status(sample: Mapping[str, Any]) -> np.ndarray:
    """(8,) float32: the command one-hot, then the ego's velocity and acceleration."""
    command = [float(sample["command"] == name) for name in COMMANDS]
    return np.array([*command, *sample["ego_status"]], dtype=np.float32)
