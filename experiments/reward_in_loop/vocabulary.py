"""Use a: a vocabulary planner whose expected reward, the sum of p_k R_k, is exact: a policy gradient without sampling.

The vocabulary is of manoeuvres that begin at the ego's own speed: 7 accelerations, 7 curvatures of the first two
seconds, 7 of the last two. `imitation`: cross-entropy with GTRS's softmax(-d^2 / sigma^2); `labels`: and binary ones of
every entry's sub-scores, chosen by as GTRS-Dense does (`close`); `expected`: imitation, and the expected reward.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from experiments.reward_in_loop.rewards import TrunkSettings, scored
from planners.data.batch import COMMANDS, Batch
from planners.models.baselines import EgoMlpBev
from planners.models.gtrs_dense import IMITATION, SIGMA_M2, WEIGHTINGS, choose
from planners.models.planner import evaluating
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import FloatArray

ACCELERATIONS_MPS2 = (-4.0, -2.5, -1.2, 0.0, 0.8, 1.6, 2.5)
CURVATURES_1PM = (-0.12, -0.05, -0.015, 0.0, 0.015, 0.05, 0.12)
LATERAL_MPS2, MAX_MPS, STEP_S = 4.0, 25.0, 0.25


@dataclass(frozen=True)
class VocabularySettings(TrunkSettings):
    """What is learned beside imitation, and its weight."""

    objective: Literal["imitation", "labels", "expected"] = "imitation"
    weight: float = 1.0


def manoeuvres(batch: Batch) -> Tensor:
    """(B, 343, 8, 3) poses at 0.5 .. 4 s."""
    device = batch.status.device
    choices = [torch.tensor(values, device=device) for values in (ACCELERATIONS_MPS2, CURVATURES_1PM, CURVATURES_1PM)]
    acceleration, early, late = torch.cartesian_prod(*choices).T
    speed = batch.status[:, len(COMMANDS) : len(COMMANDS) + 2].norm(dim=-1, keepdim=True).expand(-1, len(early))
    x = y = heading = torch.zeros_like(speed)
    poses = []
    for step in range(round(4.0 / STEP_S)):
        after = (speed + acceleration * STEP_S).clamp(0.0, MAX_MPS)
        middle, speed = (speed + after) / 2, after
        most = LATERAL_MPS2 / middle.clamp_min(0.1) ** 2
        curvature = (early if step * STEP_S < 2.0 else late).expand_as(middle)
        turned = middle * curvature.minimum(most).maximum(-most) * STEP_S
        x = x + middle * STEP_S * (heading + turned / 2).cos()
        y = y + middle * STEP_S * (heading + turned / 2).sin()
        heading = heading + turned
        if step % 2:
            poses.append(torch.stack([x, y, heading], -1))
    return torch.stack(poses, 2)


class Vocabulary(EgoMlpBev):
    """One logit for each manoeuvre, or one for each of its sub-scores too."""

    name: ClassVar[str] = "vocabulary"
    settings_type: ClassVar[type] = VocabularySettings
    settings: VocabularySettings

    def __init__(self, settings: VocabularySettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        self.heads = (IMITATION, *(OF_ONE_PLAN if settings.objective == "labels" else ()))
        n = len(ACCELERATIONS_MPS2) * len(CURVATURES_1PM) ** 2
        self.layers[-1] = nn.Linear(settings.hidden[-1], n * len(self.heads))
        self._rewards: dict[str, tuple[Tensor, Tensor, Tensor]] = {}  # of samples seen: a manoeuvre's never changes

    def logits(self, batch: Batch) -> dict[str, Tensor]:
        """(B, 343) by head."""
        found = self.layers(self.features(batch)).float().unflatten(-1, (len(self.heads), -1))
        return dict(zip(self.heads, found.unbind(1)))

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        logits, plans = self.logits(batch), manoeuvres(batch)
        apart = (plans - batch.plan_2hz[:, None]).square().sum((2, 3))
        log_p = logits[IMITATION].log_softmax(-1)
        terms = {IMITATION: -((-apart / SIGMA_M2).softmax(-1) * log_p).sum(-1).mean()}
        if self.settings.objective == "imitation":
            return terms
        reward, subscores, there = self._scored(batch, plans)
        if self.settings.objective == "expected":
            lost = (reward.amax(-1) - (log_p.exp() * reward).sum(-1)) * there
            return terms | {"expected": self.settings.weight * lost.mean()}
        for i, name in enumerate(OF_ONE_PLAN):
            loss = F.binary_cross_entropy_with_logits(logits[name][there], subscores[there][..., i])
            terms[name] = self.settings.weight * loss
        return terms

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            logits = self.logits(batch)
            scores = {name: one.softmax(-1) if name == IMITATION else one.sigmoid() for name, one in logits.items()}
            best = choose(scores, WEIGHTINGS["close"]) if len(scores) > 1 else scores[IMITATION].argmax(-1)
            return manoeuvres(batch)[torch.arange(len(best)), best]

    def _scored(self, batch: Batch, plans: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if any(name not in self._rewards for name in batch.attempt_ids):
            self._rewards.update(zip(batch.attempt_ids, zip(*scored(self.settings, batch, plans))))
        score, subscores, there = (torch.stack(one) for one in zip(*(self._rewards[i] for i in batch.attempt_ids)))
        return score, subscores, there
