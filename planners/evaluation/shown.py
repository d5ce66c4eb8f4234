"""What an evaluated planner is shown of a sample: everything up to now, nothing that only comes later.

label_*, proposal_10hz                      zeros (the drive that followed)
stage1_*, stage2_*, label_subscores, ...    None (scores)
agent_boxes, agent_velocities, ...          NaN, and agent_valid False, after now
light_states                                0, unknown, after now
parent_states                               the logged state at T+H is NaN in frames at or before T
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factory.store.reader import Sample
from factory.store.schema import LABEL_COLUMNS, NOW_INDEX, SCHEMA
from planners.data.batch import Batch, BevLayout, ImageLayout, Needs
from planners.data.bev import bev_raster
from planners.data.decode import BatchBuffer, StoredRows
from planners.data.images import stitched
from planners.data.index import BEV_COLUMNS
from planners.evaluation.frames import LOGGED_KINDS
from tasks.world.arrays import Bytes

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


class _StoredSample(StoredRows):
    """A sample as the loader's rows are read; zeros for the plans, which are not shown."""

    def __init__(self, sample: Mapping[str, Any]) -> None:
        self._sample = sample

    def value(self, column: str, row: int) -> Any:
        return 0.0 if column.startswith("label_") else self._sample[column]

    def values(self, columns: Sequence[str], row: int) -> Any:
        return self._sample

    def raster(self, row: int, layout: BevLayout) -> Bytes:
        return bev_raster(self._sample, layout)

    def picture(self, row: int, layout: ImageLayout, out: Bytes, keep: bool = False) -> None:
        out[:] = stitched(self._sample, layout)


def batch_of(samples: Sequence[Mapping[str, Any]], needs: Needs) -> Batch:
    """The batch that a planner plans for. Raises ValueError, naming the sample, where it lacks what `needs` asks."""
    buffer = BatchBuffer(len(samples), replace(needs, labels=None), 0)
    for i, sample in enumerate(samples):
        try:
            buffer.fill(i, _StoredSample(sample), 0)
        except ValueError as error:
            raise ValueError(f"sample {sample['attempt_id']}: {error}") from error
    simulated = np.array([sample["expert"] not in LOGGED_KINDS for sample in samples])
    return buffer.batch([str(sample["attempt_id"]) for sample in samples], simulated, np.zeros_like(simulated))
