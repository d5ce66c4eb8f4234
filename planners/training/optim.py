"""What a training steps by: its settings, the rate of every step, the optimiser."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import torch
    from torch import nn


@dataclass(frozen=True)
class TrainingSettings:
    """What stands under `training` in conf/planner/*.yaml; the paper's values for its sizes (supplement, table 4)."""

    epochs: int
    batch_size: int  # of all processes and accumulated parts together
    learning_rate: float
    schedule: Literal["constant", "cosine"] = "constant"
    optimiser: Literal["adam", "adamw"] = "adam"
    weight_decay: float = 0.0
    warmup_steps: int = 0  # over which the rate rises linearly
    warmup_epochs: float = 0.0  # the same in epochs, instead of warmup_steps
    by_epoch: bool = False  # the rate changes where an epoch begins, as in the public code, and not at every step
    lowest_rate: float = 0.0  # that a cosine falls to
    backbone_rate: float = 1.0  # factor of the rate for backbones over pictures
    backbone_decay: float | None = None  # their weight decay; None: weight_decay
    gradient_clip: float | None = None  # largest norm of the gradient; None: any

    def __post_init__(self) -> None:
        for name, low in (("epochs", 1), ("batch_size", 1), ("warmup_steps", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least {low}")
        if not 0.0 < self.learning_rate < math.inf:
            raise ValueError(f"learning_rate={self.learning_rate}: must be positive and finite")
        if not 0.0 <= self.warmup_epochs < math.inf or (self.warmup_epochs and self.warmup_steps):
            raise ValueError(f"warmup_epochs={self.warmup_epochs}: give these, not negative, or warmup_steps, not both")
        if not 0.0 <= self.lowest_rate <= self.learning_rate:
            raise ValueError(f"lowest_rate={self.lowest_rate}: must be within 0 .. learning_rate={self.learning_rate}")
        if not 0.0 < self.backbone_rate < math.inf:
            raise ValueError(f"backbone_rate={self.backbone_rate}: must be a positive factor; 1 for no other rate")
        for name in ("weight_decay", "backbone_decay"):
            if not 0.0 <= (getattr(self, name) or 0.0) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)}: must be a finite share, 0 for none")
        if self.gradient_clip is not None and not self.gradient_clip > 0.0:
            raise ValueError(f"gradient_clip={self.gradient_clip}: must be positive, or null for none")


def learning_rate(settings: TrainingSettings, step: int, steps: int, epoch_steps: int = 1) -> float:
    """The rate of step 0 .. steps - 1: warm-up, then constant, or a cosine that falls to the lowest after the last.

    By epoch it is WarmupCosLR's (navsim/agents/gtrs_dense/gtrs_agent.py, OpenDriveLab/SimScale @ f51ad64).
    """
    unit = epoch_steps if settings.by_epoch else 1
    at, end = step // unit, steps / unit
    warm = (settings.warmup_steps + settings.warmup_epochs * epoch_steps) / unit
    rate, lowest = settings.learning_rate, settings.lowest_rate
    if at < warm:
        return rate * min(at + 1, warm) / warm
    if settings.schedule == "constant":
        return rate
    share = (at - warm) / max(end - warm, 1)
    return lowest + (rate - lowest) * 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))


FACTOR = "rate_factor"  # of an optimiser's group


def build_optimiser(settings: TrainingSettings, model: nn.Module) -> torch.optim.Optimizer:
    """Adam or AdamW over everything that learns, in one kernel for all parameters of a rate."""
    import torch

    from planners.models.backbones import Backbone

    kind = torch.optim.Adam if settings.optimiser == "adam" else torch.optim.AdamW
    groups: list[dict[str, Any]] = [{"params": [p for p in model.parameters() if p.requires_grad]}]
    decay = settings.weight_decay if settings.backbone_decay is None else settings.backbone_decay
    if settings.backbone_rate != 1.0 or decay != settings.weight_decay:
        over_pictures = [m for m in model.modules() if isinstance(m, Backbone) and m.over_pictures]
        if not over_pictures:
            asked = f"backbone_rate={settings.backbone_rate} backbone_decay={settings.backbone_decay}"
            raise ValueError(f"{asked}, but the planner has no backbone over pictures")
        slow = {id(parameter) for module in over_pictures for parameter in module.parameters()}
        learns = groups[0]["params"]
        groups = [
            {"params": [p for p in learns if id(p) not in slow]},
            {"params": [p for p in learns if id(p) in slow], FACTOR: settings.backbone_rate, "weight_decay": decay},
        ]
    return kind(groups, lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True)


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """The rate of the next step, times the factor of each group."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group.get(FACTOR, 1.0)
