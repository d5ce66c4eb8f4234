"""Use b: group-relative policy optimisation (GRPO, 2402.03300) of DiffusionDrive from its own samples.

A sample is drawn as the public code plans: noise to start from, denoised in two steps. Of its anchors one is drawn by
the softmax of their confidences, and a plan from the Gaussian about that anchor's, along the smooth manoeuvres of
`regression.py`. Sixteen of a scene are scored; plan and confidence move, through both steps, towards those above the
group's mean. It imitates all the while, and where it is further than `bound` from the log's own policy (the nearest
anchor, the same Gaussian about the log's drive), it imitates alone.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from experiments.reward_in_loop.regression import GROUP, SPREAD_M, manoeuvres_about
from experiments.reward_in_loop.rewards import RewardSettings, scored
from planners.data.batch import Batch
from planners.models.diffusiondrive import DiffusionDrive
from planners.models.settings import DiffusionDriveSettings

NOISES = 4  # to start from, of a scene's samples


@dataclass(frozen=True)
class DiffusionSettings(RewardSettings, DiffusionDriveSettings):
    """0: no reward."""

    weight: float = 0.0
    bound: float = 8.0  # Kullback-Leibler divergence [nat]


class Diffusion(DiffusionDrive):
    """The loss beside imitation has the policy gradient as its gradient; every sample is of the present policy."""

    name: ClassVar[str] = "diffusion"
    settings_type: ClassVar[type] = DiffusionSettings
    settings: DiffusionSettings

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        scene = self.scene(batch)
        terms = self.losses_seeing(scene, batch)
        if self.settings.weight == 0.0:
            return terms
        n, anchors = len(batch), self.get_buffer("anchors")
        plans, logits = self.denoised_from(torch.randn(n, NOISES * len(anchors), *anchors.shape[1:]), scene)
        plans = plans.unflatten(1, (NOISES, -1)).repeat(1, GROUP // NOISES, 1, 1, 1)
        log_p = logits.unflatten(1, (NOISES, -1)).log_softmax(-1).repeat(1, GROUP // NOISES, 1)
        drawn = torch.distributions.Categorical(logits=log_p.detach()).sample()
        chosen = of_anchor(plans, drawn)
        basis = manoeuvres_about(chosen.detach().flatten(0, 1)).unflatten(0, (n, GROUP))
        z = torch.randn(n, GROUP, len(SPREAD_M))
        samples = chosen.detach() + torch.einsum("bgdm,bgm->bgd", basis, z).unflatten(2, (8, 3))
        reward, _, there = scored(self.settings, batch, samples)
        advantage = (reward - reward.mean(-1, keepdim=True)) / (reward.std(-1, keepdim=True) + 0.05)
        nearest = self.nearest_anchor(batch.plan_2hz)[:, None].expand(-1, GROUP)
        away = place_of(of_anchor(plans.detach(), nearest), batch.plan_2hz[:, None])
        apart = 0.5 * away.square().sum(-1) - of_anchor(log_p.detach(), nearest)
        within = there & (apart.mean(-1) < self.settings.bound)
        log_density = (z * place_of(chosen, chosen.detach())).sum(-1)  # its gradient, for the mean is where z is 0
        gain = (advantage * (of_anchor(log_p, drawn) + log_density)).mean(-1)
        return terms | {"reward": -self.settings.weight * (gain * within).mean()}


def of_anchor(values: Tensor, which: Tensor) -> Tensor:
    """(B, G, ...) of values (B, G, A, ...) by which (B, G)."""
    rows, draws = torch.arange(len(values))[:, None], torch.arange(values.shape[1])
    return values[rows, draws, which]


def place_of(plans: Tensor, others: Tensor) -> Tensor:
    """(B, G, 4): how many of each manoeuvre plans (B, G, 8, 3) lie from others."""
    basis = manoeuvres_about(plans.detach().flatten(0, 1)).unflatten(0, plans.shape[:2])
    return torch.einsum("bgmd,bgd->bgm", torch.linalg.pinv(basis), (plans - others).flatten(2))
