"""Latent TransFuser: regresses one plan from the picture ahead, with a scene seen from above learnt beside it.

Chitta et al. 2022 in the public form for NAVSIM without lidar; the defaults are its TransfuserConfig's, at the paper's
picture of 2048 x 512: 56 M parameters (SimScale, supplement, table 4).
"""

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from planners.data.batch import Batch, Needs
from planners.models.layers import AgentHead, BevHead, LatentFusion, auxiliary_losses, initialise_as_public
from planners.models.planner import Planner, add_base_plan, evaluating, imitation_l1, visible_status
from planners.models.settings import LtfSettings
from tasks.world.arrays import FloatArray


class Ltf(Planner):
    """Queries, one for the plan and one for each vehicle, attend to the fused view from above and the ego's status."""

    name: ClassVar[str] = "ltf"
    settings_type = LtfSettings

    def __init__(self, settings: LtfSettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        sizes, fusion = settings.network, settings.fusion
        width = sizes.width
        self.fusion = LatentFusion(fusion)
        n_tokens = (fusion.latent_size // 32) ** 2
        self.reduce = nn.Conv2d(self.fusion.channels[-1], width, 1)
        self.status = nn.Linear(8, width)
        self.key_position = nn.Parameter(torch.randn(1, n_tokens + 1, width))
        self.queries = nn.Parameter(torch.randn(1, 1 + sizes.agents, width))
        layer = nn.TransformerDecoderLayer(width, sizes.heads, sizes.hidden, dropout=0.0, batch_first=True)
        self.decoder = nn.TransformerDecoder(layer, sizes.layers)
        self.plan_head = nn.Sequential(nn.Linear(width, sizes.hidden), nn.ReLU(), nn.Linear(sizes.hidden, 24))
        self.agent_head = AgentHead(width, sizes.hidden, max(settings.bev.ahead_m, settings.bev.side_m))
        self.bev_head = BevHead(fusion.bev_channels, settings.bev.shape)
        if settings.is_public:
            initialise_as_public(self)

    @property
    def needs(self) -> Needs:
        s = self.settings
        return Needs(s.picture, s.bev, s.network.agents, command=s.command)

    @property
    def needs_to_plan(self) -> Needs:
        return Needs(image=self.settings.picture, command=self.settings.command)

    def seen(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Queries (B, 1 + N, width) of plan and agents, features from above (B, C, rows, columns)."""
        assert batch.image is not None
        fused = self.fusion(batch.image)
        cells = self.reduce(fused.latent).flatten(2).transpose(1, 2)
        keys = (
            torch.cat([cells, self.status(visible_status(self.settings.status, batch.status))[:, None]], 1)
            + self.key_position
        )
        return self.decoder(self.queries.expand(len(batch), -1, -1), keys), fused.bev

    def decoded(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Plans (B, 8, 3), queries of agents (B, N, width), features from above (B, C, rows, columns)."""
        queries, above = self.seen(batch)
        raw = self.plan_head(queries[:, 0]).float().view(-1, 8, 3)
        plan = torch.cat([raw[..., :2], raw[..., 2:].tanh() * math.pi], -1)  # the heading as the public code bounds it
        return add_base_plan(self.settings.plan_from, plan, batch), queries[:, 1:], above

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        s = self.settings
        plan, queries, above = self.decoded(batch)
        auxiliary = auxiliary_losses(s, batch, self.bev_head(above), *self.agent_head(queries))
        return {"trajectory": s.trajectory_weight * imitation_l1(plan, batch), **auxiliary}

    def plan(self, batch: Batch) -> Tensor:
        with evaluating(self):
            return self.decoded(batch)[0]
