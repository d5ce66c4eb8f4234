"""Use c: sixteen proposals, the nearest of which is regressed, and a head that judges them, as DrivoR (2601.05083).

The head learns which proposal is nearest to the log's drive, and the plan is the likeliest. With `reward` it learns the
sub-scores of the step's own proposals too, and the plan has the largest log score foreseen + prior * log likelihood.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from experiments.reward_in_loop.rewards import RewardSettings, TrunkSettings, scored
from planners.data.batch import Batch
from planners.models.baselines import EgoMlpBev
from planners.models.layers import auxiliary_losses
from planners.models.ltf import Ltf
from planners.models.planner import Planner, constant_velocity_plan, evaluating, visible_status
from planners.models.settings import LtfSettings
from tasks.subscores import MULTIPLIERS, OF_ONE_PLAN, TOTAL_WEIGHT, WEIGHTS
from tasks.world.arrays import FloatArray

N, QUERY, METRES = 16, 32, 10.0  # proposals, numbers that each is asked for by, unit of poses that the judge reads
STATUS = 8


@dataclass(frozen=True)
class JudgeSettings(RewardSettings):
    """What the judge learns."""

    reward: bool = False
    prior: float = 0.3  # 0: as DrivoR, chosen by the reward alone


def linear_layers(widths: tuple[int, ...]) -> nn.Sequential:
    """With ReLUs between them."""
    layers = [layer for a, b in pairwise(widths[:-1]) for layer in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))


class Judged(Planner):
    """Proposals and the judge see the same features (B, seen); proposals learn nothing from the judge."""

    settings: Any  # JudgeSettings, and widths of `hidden` layers
    features: Callable[[Batch], Tensor]

    def add_heads(self, seen: int) -> None:
        """The last of a planner's parts to be drawn."""
        hidden = self.settings.hidden
        self.queries_of_plans = nn.Parameter(torch.randn(N, QUERY))
        self.layers = linear_layers((seen + QUERY, *hidden, 24))
        self.judge = linear_layers((seen + 24, *hidden, 1 + len(OF_ONE_PLAN)))

    def proposals(self, features: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Plans (B, N, 8, 3) and the judge's logits (B, N, 1 + 8), the first of being the nearest."""
        features = features[:, None].expand(-1, N, -1)
        queries = self.queries_of_plans.expand(len(features), -1, -1)
        offsets = self.layers(torch.cat([features, queries], -1)).float().unflatten(-1, (8, 3))
        plans = constant_velocity_plan(batch)[:, None] + offsets
        return plans, self.judge(torch.cat([features, plans.detach().flatten(2) / METRES], -1)).float()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        return self.terms(self.features(batch), batch)

    def terms(self, features: Tensor, batch: Batch) -> dict[str, Tensor]:
        """The losses of proposals and judge."""
        plans, logits = self.proposals(features, batch)
        apart = (plans - batch.plan_2hz[:, None]).abs().mean((2, 3))
        nearest, which = apart.min(-1)
        terms = {"trajectory": nearest.mean(), "likelihood": F.cross_entropy(logits[..., 0], which)}
        if self.settings.reward:
            _, subscores, there = scored(self.settings, batch, plans)
            terms["judge"] = F.binary_cross_entropy_with_logits(logits[there][..., 1:], subscores[there])
        return terms

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            plans, logits = self.proposals(self.features(batch), batch)
            worth = logits[..., 0].log_softmax(-1)
            if self.settings.reward:
                foreseen = dict(zip(OF_ONE_PLAN, logits[..., 1:].sigmoid().unbind(-1)))
                mean = sum(weight * foreseen[name] for name, weight in WEIGHTS.items()) / TOTAL_WEIGHT
                score = torch.stack([mean, *(foreseen[name] for name in MULTIPLIERS)]).prod(0)
                worth = score.clamp_min(1e-9).log() + self.settings.prior * worth
            return plans[torch.arange(len(plans)), worth.argmax(-1)]


@dataclass(frozen=True)
class ProposalsSettings(JudgeSettings, TrunkSettings):
    """Over the raster."""


class Proposals(Judged, EgoMlpBev):
    """Sees the labelled world from above."""

    name: ClassVar[str] = "proposals"
    settings_type: ClassVar[type] = ProposalsSettings

    def __init__(self, settings: ProposalsSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        self.add_heads(settings.features + STATUS)


@dataclass(frozen=True)
class PictureSettings(JudgeSettings, LtfSettings):
    """Over the picture."""

    hidden: tuple[int, ...] = (128, 128)


class PictureProposals(Judged, Ltf):
    """Sees the front camera, by the query that LTF's plan is made of; cells and agents are learned beside, as there."""

    name: ClassVar[str] = "picture_proposals"
    settings_type: ClassVar[type] = PictureSettings

    def __init__(self, settings: PictureSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        del self.plan_head
        self.add_heads(settings.network.width + STATUS)

    def features(self, batch: Batch) -> Tensor:
        return self._of(self.seen(batch)[0], batch)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        s, (queries, above) = self.settings, self.seen(batch)
        terms = self.terms(self._of(queries, batch), batch)
        beside = auxiliary_losses(s, batch, self.bev_head(above), *self.agent_head(queries[:, 1:]))
        return {name: s.trajectory_weight * term for name, term in terms.items()} | beside

    def _of(self, queries: Tensor, batch: Batch) -> Tensor:
        return torch.cat([queries[:, 0], visible_status(self.settings.status, batch.status)], -1)
