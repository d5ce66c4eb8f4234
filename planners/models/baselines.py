"""Planners without eyes: one that goes straight on, one that knows its own speed and command, one that sees from above.

The second is the public EgoStatusMLP of NAVSIM, whose defaults these are: what it scores is what a sample's ego status
gives away. The third sees a raster of the labelled world and is named after it, so that nobody takes it for the second.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from planners.data.batch import Batch, Needs
from planners.data.bev import BevClass
from planners.models.planner import (
    Planner,
    add_base_plan,
    constant_velocity_plan,
    evaluating,
    imitation_l1,
    visible_status,
)
from planners.models.settings import ConstantVelocitySettings, EgoMlpBevSettings, EgoMlpSettings
from tasks.world.arrays import FloatArray

CREEP_MPS = 1.0


class ConstantVelocity(Planner):
    """Speed stays, the heading does not turn; learns nothing: the least that a planner may do."""

    name: ClassVar[str] = "constant_velocity"
    settings_type = ConstantVelocitySettings

    @property
    def needs(self) -> Needs:
        return Needs()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Raises ValueError: there is nothing to train."""
        raise ValueError("constant_velocity has nothing to train: evaluate it as it is")

    def plan(self, batch: Batch) -> Tensor:
        return constant_velocity_plan(batch)


class GoStraight(ConstantVelocity):
    """The same, never slower than `CREEP_MPS`: a constant velocity that stands never drives again.

    What AlpaSim's driver of SimScale's planners does without a plan (NVlabs/alpasim).
    """

    name: ClassVar[str] = "planners.models.baselines:GoStraight"

    def plan(self, batch: Batch) -> Tensor:
        steady = constant_velocity_plan(batch)
        slowest = torch.arange(1, 9, device=steady.device) * 0.5 * CREEP_MPS
        return torch.stack([steady[..., 0].maximum(slowest), steady[..., 1], steady[..., 2]], -1)


class EgoMlp(Planner):
    """Command, velocity and acceleration through a few linear layers to eight poses."""

    name: ClassVar[str] = "ego_mlp"
    settings_type: ClassVar[type] = EgoMlpSettings

    def __init__(self, settings: EgoMlpSettings, arrays: Mapping[str, FloatArray], seen: int = 0) -> None:
        """seen: features beside the eight of the ego's status."""
        super().__init__(settings, arrays)
        widths = (8 + seen, *settings.hidden)
        layers = [layer for a, b in pairwise(widths) for layer in (nn.Linear(a, b), nn.ReLU())]
        self.layers = nn.Sequential(*layers, nn.Linear(widths[-1], 24))

    @property
    def needs(self) -> Needs:
        return Needs(command=self.settings.command)

    def features(self, batch: Batch) -> Tensor:
        """(B, 8 + seen) that the layers take."""
        return visible_status(self.settings.status, batch.status)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        return {"trajectory": imitation_l1(self._poses(batch), batch)}

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            return self._poses(batch)

    def _poses(self, batch: Batch) -> Tensor:
        poses = self.layers(self.features(batch)).float().view(-1, 8, 3)
        return add_base_plan(self.settings.plan_from, poses, batch)


class EgoMlpBev(EgoMlp):
    """The same, with the map, the route and the agents as a raster beside its status."""

    name: ClassVar[str] = "ego_mlp_bev"
    settings_type: ClassVar[type] = EgoMlpBevSettings

    def __init__(self, settings: EgoMlpBevSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays, settings.features)
        self.classes = nn.Embedding(len(BevClass), settings.classes)
        widths = (settings.classes * len(settings.bev.times_s), *settings.channels)
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(widths))
        rows, columns = settings.bev.shape
        for _ in settings.channels:
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
        self.fold = nn.Linear(widths[-1] * rows * columns, settings.features)

    @property
    def needs(self) -> Needs:
        return Needs(bev=self.settings.bev, command=self.settings.command)

    def features(self, batch: Batch) -> Tensor:
        assert batch.bev is not None
        x = self._seen(batch.bev)
        for convolve in self.convolutions[1:]:
            x = F.relu(convolve(x))
        return torch.cat([visible_status(self.settings.status, batch.status), F.relu(self.fold(x.flatten(1)))], -1)

    def _seen(self, bev: Tensor) -> Tensor:
        """The first convolution of the classes' vectors (B, T, rows, columns), its weights multiplied by these.

        One-hot classes need no gradient then, which for vectors at every cell would be half of a step's time.
        """
        first = self.convolutions[0]
        assert isinstance(first, nn.Conv2d)
        by_time = first.weight.unflatten(1, (bev.shape[1], -1))
        weights = torch.einsum("otcij,kc->otkij", by_time, self.classes.weight).flatten(1, 2)
        hot = bev.new_zeros((*bev.shape[:2], len(BevClass), *bev.shape[2:]), dtype=weights.dtype)
        hot.scatter_(2, bev.long().unsqueeze(2), 1.0)
        return F.relu(F.conv2d(hot.flatten(1, 2), weights, first.bias, stride=2, padding=1))
