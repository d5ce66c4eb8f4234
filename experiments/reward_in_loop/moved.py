"""The vocabulary planner's reward from where nobody drove: the ego shifted and turned as `mix.jitter` does it.

Labels of jitter are the log's way bent back; the reward needs none. A bank holds each clip five times: as logged, and
from four places beside, PDM-Closed's progress from there. The raster is moved cell by cell, the nearest class in each.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from experiments.reward_in_loop.vocabulary import Vocabulary, VocabularySettings
from factory.setup.bank import write_clips
from factory.store.location import Location
from factory.store.samples import Store
from factory.views.scene_files import prepared_clip
from planners.data.batch import Batch, BevLayout
from planners.data.index import DataSettings, open_data
from planners.data.jitter import JitterSettings, Offset, draw_offset
from tasks.bank import SceneBank
from tasks.bank_tensors import score_tensors
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import Bytes
from tasks.world.clip import NOW, Clip
from tasks.world.frames import to_local, to_world

PLACES, JITTER = 4, JitterSettings(share=1.0)


@dataclass(frozen=True)
class MovedSettings(VocabularySettings):
    """How much of a batch is moved."""

    share: float = 0.5


def offset_of(clip_id: str, place: int) -> Offset:
    """Of one of the places 1 .. 4."""
    found = draw_offset(JITTER, 0, place, clip_id)
    assert found is not None
    return found


def moved_clip(clip: Clip, place: int) -> Clip:
    """The clip with the ego's way to T moved as a whole; place 0: where it is."""
    if place == 0:
        return clip
    offset, states = offset_of(clip.clip_id, place), clip.ego_states.copy()
    now = states[NOW, :3].copy()
    there = to_world(now, np.array([0.0, offset.lateral_m, offset.heading_rad]))
    states[: NOW + 1, :3] = to_world(there, to_local(now, states[: NOW + 1, :3]))
    return replace(clip, ego_states=states)


@cache
def opened(table: str, folder: str) -> tuple[SceneBank, dict[str, str]]:
    """The bank of `<clip>@<place>`, written where it is not there, and attempt id -> clip."""
    rows, store = open_data(DataSettings(real=(table,))).rows, Store(Location.parse(table))
    digest = store.runs()[-1]["prepare_digest"]
    clips = dict(zip(rows.attempt_id.tolist(), rows.clip_id.tolist()))

    def read(wanted: tuple[str, int]) -> Clip:
        clip = prepared_clip(store, wanted[0], digest)
        assert clip is not None, f"{table} keeps clip {wanted[0]} no more"
        return moved_clip(clip, wanted[1])

    write_clips(folder, read, {f"{one}@{k}": (one, k) for one in sorted(clips.values()) for k in range(PLACES + 1)})
    return SceneBank(Path(folder)), clips


def moved_raster(raster: Bytes, offset: Offset, layout: BevLayout) -> Bytes:
    """(T, rows, columns) as seen from there; background beyond its edge."""
    rows, columns = layout.shape
    ahead = layout.ahead_m - (np.arange(rows) + 0.5) * layout.cell_m
    left = layout.side_m - (np.arange(columns) + 0.5) * layout.cell_m
    x, y = np.meshgrid(ahead, left, indexing="ij")
    cos, sin = np.cos(offset.heading_rad), np.sin(offset.heading_rad)
    from_row = np.floor((layout.ahead_m - (cos * x - sin * y)) / layout.cell_m).astype(int)
    from_column = np.floor((layout.side_m - (sin * x + cos * y + offset.lateral_m)) / layout.cell_m).astype(int)
    inside = (from_row >= 0) & (from_row < rows) & (from_column >= 0) & (from_column < columns)
    return np.where(inside, raster[:, from_row.clip(0, rows - 1), from_column.clip(0, columns - 1)], 0)


class MovedVocabulary(Vocabulary):
    """Half of each batch is moved, in every arm alike."""

    name: ClassVar[str] = "moved_vocabulary"
    settings_type: ClassVar[type] = MovedSettings
    settings: MovedSettings

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        _, clips = opened(self.settings.table, self.settings.bank)
        moves = torch.rand(len(batch)) < self.settings.share
        places = (torch.randint(1, PLACES + 1, (len(batch),)) * moves).tolist()
        names = [clips[name] for name in batch.attempt_ids]
        assert batch.bev is not None
        bev, plans = batch.bev.clone(), batch.plan_2hz.clone()
        for i, (name, place) in enumerate(zip(names, places)):
            if place:
                offset = offset_of(name, place)
                bev[i] = torch.from_numpy(moved_raster(batch.bev[i].numpy(), offset, self.settings.bev))
                plans[i] = torch.from_numpy(offset.bent_back(batch.plan_10hz[i].numpy())[4::5])
        ids = tuple(f"{name}@{place}" for name, place in zip(names, places))
        return super().losses(replace(batch, attempt_ids=ids, bev=bev, plan_2hz=plans))

    def _scored(self, batch: Batch, plans: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        bank, _ = opened(self.settings.table, self.settings.bank)
        known = set(bank.clip_ids)
        new = [i for i, name in enumerate(batch.attempt_ids) if name in known and name not in self._rewards]
        if new:
            found = score_tensors(bank, [batch.attempt_ids[i] for i in new], plans[new], threads=1)
            for i, subscores, score in zip(new, *found):
                self._rewards[batch.attempt_ids[i]] = (score, subscores, torch.tensor(True))
        nothing = (
            plans.new_zeros(plans.shape[1]),
            plans.new_zeros(plans.shape[1], len(OF_ONE_PLAN)),
            torch.tensor(False),
        )
        score, subscores, there = zip(*(self._rewards.get(name, nothing) for name in batch.attempt_ids))
        return torch.stack(score), torch.stack(subscores), torch.stack(there)
