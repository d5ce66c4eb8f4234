"""Use c: sixteen proposals, the nearest of which is regressed, and a head that judges them, as DrivoR (2601.05083).

The head learns which proposal is nearest to the log's drive, and the plan is the likeliest. With `reward` it learns the
sub-scores of the step's own proposals too, and the plan has the largest log score foreseen + prior * log likelihood.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from experiments.reward_in_loop.rewards import TrunkSettings, scored
from planners.data.batch import Batch
from planners.models.baselines import EgoMlpBev
from planners.models.planner import constant_velocity_plan, evaluating
from tasks.subscores import MULTIPLIERS, OF_ONE_PLAN, TOTAL_WEIGHT, WEIGHTS
from tasks.world.arrays import FloatArray

N, QUERY, METRES = 16, 32, 10.0  # proposals, numbers that each is asked for by, unit of poses that the judge reads


@dataclass(frozen=True)
class ProposalsSettings(TrunkSettings):
    """What the judge learns."""

    reward: bool = False
    prior: float = 0.3  # 0: as DrivoR, chosen by the reward alone


def linear_layers(widths: tuple[int, ...]) -> nn.Sequential:
    """With ReLUs between them."""
    layers = [layer for a, b in pairwise(widths[:-1]) for layer in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))


class Proposals(EgoMlpBev):
    """Proposals and the judge see the same features; proposals learn nothing from the judge."""

    name: ClassVar[str] = "proposals"
    settings_type: ClassVar[type] = ProposalsSettings
    settings: ProposalsSettings

    def __init__(self, settings: ProposalsSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        seen = settings.features + 8
        self.queries = nn.Parameter(torch.randn(N, QUERY))
        self.layers = linear_layers((seen + QUERY, *settings.hidden, 24))
        self.judge = linear_layers((seen + 24, *settings.hidden, 1 + len(OF_ONE_PLAN)))

    def proposals(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Plans (B, N, 8, 3) and the judge's logits (B, N, 1 + 8), the first of being the nearest."""
        features = self.features(batch)[:, None].expand(-1, N, -1)
        queries = self.queries.expand(len(features), -1, -1)
        offsets = self.layers(torch.cat([features, queries], -1)).float().unflatten(-1, (8, 3))
        plans = constant_velocity_plan(batch)[:, None] + offsets
        return plans, self.judge(torch.cat([features, plans.detach().flatten(2) / METRES], -1)).float()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        plans, logits = self.proposals(batch)
        apart = (plans - batch.plan_2hz[:, None]).abs().mean((2, 3))
        nearest, which = apart.min(-1)
        terms = {"trajectory": nearest.mean(), "likelihood": F.cross_entropy(logits[..., 0], which)}
        if self.settings.reward:
            _, subscores, there = scored(self.settings, batch, plans)
            terms["judge"] = F.binary_cross_entropy_with_logits(logits[there][..., 1:], subscores[there])
        return terms

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            plans, logits = self.proposals(batch)
            worth = logits[..., 0].log_softmax(-1)
            if self.settings.reward:
                foreseen = dict(zip(OF_ONE_PLAN, logits[..., 1:].sigmoid().unbind(-1)))
                mean = sum(weight * foreseen[name] for name, weight in WEIGHTS.items()) / TOTAL_WEIGHT
                score = torch.stack([mean, *(foreseen[name] for name in MULTIPLIERS)]).prod(0)
                worth = score.clamp_min(1e-9).log() + self.settings.prior * worth
            return plans[torch.arange(len(plans)), worth.argmax(-1)]
