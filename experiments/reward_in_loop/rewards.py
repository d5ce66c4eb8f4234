"""What the planners of this folder have in common: the raster's settings, and the bank by the ids of a batch."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from planners.data.batch import Batch, BevLayout
from planners.data.index import DataSettings, open_data
from planners.models.settings import EgoMlpBevSettings
from planners.training.validation import open_bank
from tasks.bank import SceneBank
from tasks.bank_tensors import score_tensors
from tasks.subscores import OF_ONE_PLAN


@dataclass(frozen=True)
class RewardSettings:
    """Where the reward is."""

    table: str = ""  # whose real samples are trained on; several, with commas
    bank: str = ""  # folder of their scenes, written where it is not there


@dataclass(frozen=True)
class TrunkSettings(RewardSettings, EgoMlpBevSettings):
    """Those of conf/planner/ego_mlp_bev_small.yaml."""

    hidden: tuple[int, ...] = (128, 128)
    features: int = 128
    plan_from: str = "constant_velocity"
    status: str = "speed"
    bev: BevLayout = field(
        default_factory=lambda: BevLayout(ahead_m=40.0, behind_m=8.0, side_m=24.0, cell_m=1.0, times_s=(-1.0, 0.0))
    )


@cache
def _opened(table: str, bank: str) -> tuple[SceneBank, dict[str, str]]:
    dataset = open_data(DataSettings(real=tuple(table.split(","))))
    rows = dataset.rows
    return open_bank(Path(bank), dataset), dict(zip(rows.attempt_id.tolist(), rows.clip_id.tolist()))


def scored(settings: RewardSettings, batch: Batch, plans: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of plans (B, P, 8, 3): scores (B, P), sub-scores (B, P, 8), and (B,) whether the sample's scene can be scored.

    Zeros where it cannot; a moved sample (jitter) would be scored from the wrong place, so there are none here.
    """
    bank, clips = _opened(settings.table, settings.bank)
    there = torch.tensor([clips[name] in bank.clip_ids for name in batch.attempt_ids])
    known = [clips[name] for name, known in zip(batch.attempt_ids, there) if known]
    scores, subscores = plans.new_zeros(plans.shape[:2]), plans.new_zeros((*plans.shape[:2], len(OF_ONE_PLAN)))
    subscores[there], scores[there] = score_tensors(bank, known, plans[there], threads=1)
    return scores, subscores, there
