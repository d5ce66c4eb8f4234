"""How a training steps: budget, optimiser, schedule."""

import math
from dataclasses import dataclass
from typing import Literal

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
    gradient_clip: float | None = None  # largest norm of the gradient; None: any

    def __post_init__(self) -> None:
        for name, low in (("epochs", 1), ("batch_size", 1), ("warmup_steps", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least {low}")
        if not 0.0 < self.learning_rate < math.inf:
            raise ValueError(f"learning_rate={self.learning_rate}: must be positive and finite")
        if self.gradient_clip is not None and not self.gradient_clip > 0.0:
            raise ValueError(f"gradient_clip={self.gradient_clip}: must be positive, or null for none")


def learning_rate(settings: TrainingSettings, step: int, steps: int) -> float:
    """The rate of step 0 .. steps - 1: warm-up, then constant, or a cosine that falls to nothing after the last."""
    rate = settings.learning_rate
    if step < settings.warmup_steps:
        return rate * (step + 1) / settings.warmup_steps
    if settings.schedule == "constant":
        return rate
    share = (step - settings.warmup_steps) / max(steps - settings.warmup_steps, 1)
    return rate * 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))


def build_optimiser(settings: TrainingSettings, model: nn.Module) -> torch.optim.Optimizer:
    """Adam or AdamW over everything that learns, in one kernel for all parameters."""
    kind = torch.optim.Adam if settings.optimiser == "adam" else torch.optim.AdamW
    learns = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return kind(learns, lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True)
