"""A planner: one linear layer from the ego's status to a correction of going straight on.

    python -m planners train planner=custom planner.name=examples.linear_planner:LinearPlanner \
        data.real=[runs/demo] steps=200 device=cpu out=runs/linear
    python -m planners evaluate benchmark=runs/hard planner=runs/linear

Settings are changed with +planner.settings.history=true. What a batch holds: planners/data/batch.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from planners.data.batch import Batch, Needs
from planners.models.planner import FloatArray, Planner, constant_velocity_plan, evaluating, imitation_l1


@dataclass(frozen=True)
class LinearSettings:
    """What the layer sees beside command, velocity and acceleration."""

    history: bool = False  # the last 1.5 s of poses


class LinearPlanner(Planner):
    """Eight poses at 2 Hz."""

    name: ClassVar[str] = "linear"
    settings_type: ClassVar[type] = LinearSettings

    def __init__(self, settings: LinearSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        self.layer = nn.Linear(8 + (12 if settings.history else 0), 24)
        nn.init.zeros_(self.layer.weight)  # untrained it goes straight on
        nn.init.zeros_(self.layer.bias)

    @property
    def needs(self) -> Needs:
        """Nothing beyond status and history: no picture is decoded."""
        return Needs()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The mean absolute error of the plans."""
        return {"trajectory": imitation_l1(self._poses(batch), batch)}

    def plan(self, batch: Batch) -> Tensor:
        """(B, 8, 3) at 0.5 .. 4.0 s."""
        with evaluating(self):
            return self._poses(batch)

    def _poses(self, batch: Batch) -> Tensor:
        seen = [batch.status, batch.history.flatten(1)] if self.settings.history else [batch.status]
        return constant_velocity_plan(batch) + self.layer(torch.cat(seen, -1)).float().view(-1, 8, 3)
