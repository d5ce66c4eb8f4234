"""Use b: group-relative policy optimisation (GRPO, 2402.03300) of `ego_mlp_bev` from its own samples.

The policy is a Gaussian about the regressed plan, along four smooth manoeuvres; sixteen samples a scene are scored, and
their plan is moved towards those above the group's mean. It imitates all the while, and where it is further than
`bound` (a Kullback-Leibler divergence) from the same Gaussian about the log's drive, it imitates alone.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from experiments.reward_in_loop.rewards import TrunkSettings, scored
from planners.data.batch import Batch
from planners.models.baselines import EgoMlpBev
from planners.models.planner import imitation_l1

GROUP = 16
SPREAD_M = (1.0, 1.5, 0.4, 0.4)  # after 4 s: along as t and t^2, across as t^2 and t^3
SLOWEST_MPS = 2.0  # by which a shift across turns the heading


@dataclass(frozen=True)
class RegressionSettings(TrunkSettings):
    """0: no reward."""

    weight: float = 0.0
    bound: float = 8.0


def manoeuvres_about(plans: Tensor) -> Tensor:
    """What a unit of each manoeuvre adds to plans (B, 8, 3): (B, 24, 4)."""
    t = torch.arange(1, 9, device=plans.device) / 8.0
    along = torch.stack([t, t**2, 0 * t, 0 * t], -1) * plans.new_tensor(SPREAD_M)
    across = torch.stack([0 * t, 0 * t, t**2, t**3], -1) * plans.new_tensor(SPREAD_M)
    rate = torch.stack([0 * t, 0 * t, 2 * t, 3 * t**2], -1) * plans.new_tensor(SPREAD_M) / 4.0  # [m/s]
    speed = (plans[:, -1, :2].norm(dim=-1) / 4.0).clamp_min(SLOWEST_MPS)[:, None, None]
    cos, sin = plans[..., 2:].cos(), plans[..., 2:].sin()
    return torch.stack([cos * along - sin * across, sin * along + cos * across, rate / speed], 2).flatten(1, 2)


class Regression(EgoMlpBev):
    """The loss beside imitation has the policy gradient as its gradient; every sample is of the present policy."""

    name: ClassVar[str] = "regression"
    settings_type: ClassVar[type] = RegressionSettings
    settings: RegressionSettings

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        plans = self._poses(batch)
        terms = {"trajectory": imitation_l1(plans, batch)}
        if self.settings.weight == 0.0:
            return terms
        mean = plans.detach()
        basis = manoeuvres_about(mean)
        z = torch.randn(len(mean), GROUP, len(SPREAD_M))
        reward, _, there = scored(
            self.settings, batch, mean[:, None] + torch.einsum("bdm,bgm->bgd", basis, z).unflatten(2, (8, 3))
        )
        advantage = (reward - reward.mean(-1, keepdim=True)) / (reward.std(-1, keepdim=True) + 0.05)
        inverse = torch.linalg.pinv(basis)  # (B, 4, 24): a plan's place along the manoeuvres
        away = torch.einsum("bmd,bd->bm", inverse, (mean - batch.plan_2hz).flatten(1))
        within = there & (0.5 * away.square().sum(-1) < self.settings.bound)
        place = torch.einsum("bmd,bd->bm", inverse, plans.flatten(1))
        gain = (advantage[..., None] * z).mean(1)
        return terms | {"reward": -self.settings.weight * ((gain * place).sum(-1) * within).mean()}
