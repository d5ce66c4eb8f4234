"""Latent TransFuser: regresses one plan from the picture ahead, with a scene seen from above learnt beside it.

Chitta et al. 2022 in the public form for NAVSIM without lidar; the defaults are its TransfuserConfig's, at the paper's
picture of 2048 x 512: 56 M parameters (SimScale, supplement, table 4).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from planners.data.batch import Batch, BevLayout, ImageLayout, Needs
from planners.models.layers import (
    AgentHead,
    BevHead,
    FusionSettings,
    LatentFusion,
    Start,
    auxiliary_losses,
    initialise_weights,
)
from planners.models.planner import (
    PlanFrom,
    Planner,
    Status,
    bounded_heading,
    evaluating,
    imitation_l1,
    planned_from,
    seen_status,
)
from tasks.settings import fixed
from tasks.world.arrays import FloatArray


@dataclass(frozen=True)
class LtfSettings:
    """Sizes and weights."""

    image: ImageLayout = field(default_factory=ImageLayout)
    bev: BevLayout = field(default_factory=BevLayout)
    fusion: FusionSettings = field(default_factory=FusionSettings)
    width: int = 256  # of the decoder
    hidden: int = 1024
    layers: int = 3
    heads: int = 8
    dropout: float = fixed(0.0)  # of the decoder; the public code has none
    plan_from: PlanFrom = "zero"  # what the regressed positions are added to
    status: Status = "all"  # what of the ego's own it sees; speed: no acceleration
    agents: int = 30
    trajectory_weight: float = fixed(10.0)  # the unit that the others are weighed against
    agent_class_weight: float = 10.0
    agent_box_weight: float = 1.0
    bev_weight: float = 10.0
    start: Start = "torch"  # whose draw the weights begin with


class Ltf(Planner):
    """Queries, one for the plan and one for each vehicle, attend to the fused view from above and the ego's status."""

    name: ClassVar[str] = "ltf"
    settings_type = LtfSettings

    def __init__(self, settings: LtfSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        width = settings.width
        self.fusion = LatentFusion(settings.fusion)
        n_tokens = (settings.fusion.latent_size // 32) ** 2
        self.reduce = nn.Conv2d(self.fusion.channels[-1], width, 1)
        self.status = nn.Linear(8, width)
        self.key_position = nn.Parameter(torch.randn(1, n_tokens + 1, width))
        self.queries = nn.Parameter(torch.randn(1, 1 + settings.agents, width))
        layer = nn.TransformerDecoderLayer(width, settings.heads, settings.hidden, settings.dropout, batch_first=True)
        self.decoder = nn.TransformerDecoder(layer, settings.layers)
        self.plan_head = nn.Sequential(nn.Linear(width, settings.hidden), nn.ReLU(), nn.Linear(settings.hidden, 24))
        self.agent_head = AgentHead(width, settings.hidden, max(settings.bev.ahead_m, settings.bev.side_m))
        self.bev_head = BevHead(settings.fusion.bev_channels, settings.bev.shape)
        initialise_weights(self, settings.start)

    @property
    def needs(self) -> Needs:
        return Needs(image=self.settings.image, bev=self.settings.bev, n_agents=self.settings.agents)

    @property
    def needs_to_plan(self) -> Needs:
        return Needs(image=self.settings.image)

    def decoded(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Plans (B, 8, 3), queries of agents (B, N, width), features from above (B, C, rows, columns)."""
        assert batch.image is not None
        fused = self.fusion(batch.image)
        cells = self.reduce(fused.latent).flatten(2).transpose(1, 2)
        keys = torch.cat([cells, self.status(seen_status(self.settings.status, batch))[:, None]], 1) + self.key_position
        queries = self.decoder(self.queries.expand(len(batch), -1, -1), keys)
        plan = bounded_heading(self.plan_head(queries[:, 0]).float().view(-1, 8, 3))
        return planned_from(self.settings.plan_from, plan, batch), queries[:, 1:], fused.bev

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        s = self.settings
        plan, queries, above = self.decoded(batch)
        auxiliary = auxiliary_losses(s, batch, self.bev_head(above), *self.agent_head(queries))
        return {"trajectory": s.trajectory_weight * imitation_l1(plan, batch), **auxiliary}

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            return self.decoded(batch)[0]
