"""DiffusionDrive's decoder: noisy plans look at the scene where they go and become plans with a confidence each.

Shapes, activations and what is normalised where are those of the public code (hustvl/DiffusionDrive, also OpenDriveLab/
SimScale 04cda10, navsim/agents/diffusiondrive: transfuser_model_v2.py, modules/blocks.py): the feed-forward has no
shortcut, every layer starts from the same feature of the noisy plan, and a layer's plans lie where the layer before
put them. Different here: a point reads the cell of the raster from above that it lies in (`BevLayout`); the public code
reads a raster supervised for 0 .. 32 m ahead as if it reached from -32 to 32 m.
"""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from planners.data.batch import BevLayout
from planners.models.anchors import WAYPOINTS
from planners.models.attention import Attention

POINT_FEATURES = 64  # of a point: sines and cosines of its two coordinates
RARE = 0.01  # confidence that the classifiers start from


def waves(x: Tensor, count: int, per_unit: float = 1.0) -> Tensor:
    """`count` sines and cosines of (...,), their frequencies from per_unit to 1e-4 per_unit rad: (..., count)."""
    half = count // 2
    rates = per_unit * 10000.0 ** (-torch.arange(half, device=x.device, dtype=torch.float32) / half)
    angles = x[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def mlp(*widths: int, normalise: bool = False) -> nn.Sequential:
    """Linear layers with a ReLU between each two, followed by a layer norm where asked."""
    layers: list[nn.Module] = []
    for entering, leaving in pairwise(widths[:-1]):
        layers += [nn.Linear(entering, leaving), nn.ReLU()]
        layers += [nn.LayerNorm(leaving)] if normalise else []
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))


class AlongTrajectory(nn.Module):
    """Attention to a map from above at a plan's own points; the plan's feature says how much each point counts."""

    def __init__(self, width: int, dropout: float, layout: BevLayout) -> None:
        super().__init__()
        self.layout = layout
        self.weights = nn.Linear(width, WAYPOINTS)
        self.value = nn.Sequential(nn.Conv2d(width, width, 3, padding=1), nn.ReLU())
        self.out = nn.Linear(width, width)
        self.drop = nn.Dropout(dropout)
        nn.init.zeros_(self.weights.weight)
        nn.init.zeros_(self.weights.bias)
        nn.init.xavier_uniform_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, feature: Tensor, points: Tensor, above: Tensor) -> Tensor:
        """Features (B, A, width), points (B, A, 8, 2) in m, map (B, width, rows, columns); outside of it is zero."""
        grid = on_map(points, self.layout)
        seen = F.grid_sample(self.value(above).float(), grid, align_corners=False)  # (B, width, A, 8)
        seen = torch.einsum("bcap,bap->bac", seen, self.weights(feature).float().softmax(dim=-1))
        return feature + self.drop(self.out(seen))


def on_map(points: Tensor, layout: BevLayout) -> Tensor:
    """Points (..., 2), x ahead and y left in m, as column and row in -1 .. 1 over a raster from above."""
    x, y = points.float().unbind(dim=-1)
    reach = layout.ahead_m + layout.behind_m
    return torch.stack([-y / layout.side_m, 2.0 * (layout.ahead_m - x) / reach - 1.0], dim=-1)


class DiffusionLayer(nn.Module):
    """One refinement: the map under the plan, agents, ego, feed-forward, scaled and shifted by the noise step."""

    def __init__(self, width: int, heads: int, hidden: int, dropout: float, layout: BevLayout) -> None:
        super().__init__()
        self.along = AlongTrajectory(width, dropout, layout)
        self.agents, self.ego = Attention(width, heads), Attention(width, heads)
        self.agents_norm, self.ego_norm, self.norm = (nn.LayerNorm(width) for _ in range(3))
        self.feedforward = mlp(width, hidden, width)
        self.modulation = nn.Sequential(nn.Mish(), nn.Linear(width, 2 * width))
        self.confidence = mlp(width, width, width, 1, normalise=True)
        self.offsets = mlp(width, width, width, 3 * WAYPOINTS)
        self.drop = nn.Dropout(dropout)
        last = self.confidence[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.bias, math.log(RARE / (1.0 - RARE)))

    def forward(
        self, feature: Tensor, points: Tensor, base: Tensor, above: Tensor, agents: Tensor, ego: Tensor, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Features (B, A, width) of points (B, A, 8, 2), map, agents (B, N, width), ego (B, 1, width), step (B, width).

        Gives float32 plans (B, A, 8, 3), as offsets from the base (B, A, 8, 2), and logits (B, A).
        """
        feature = self.along(feature, points, above)
        feature = self.agents_norm(feature + self.drop(self.agents(feature, agents)))
        feature = self.ego_norm(feature + self.drop(self.ego(feature, ego)))
        feature = self.norm(self.feedforward(feature))
        scale, shift = self.modulation(step)[:, None].chunk(2, dim=-1)
        feature = feature * (1.0 + scale) + shift
        moved = self.offsets(feature).float().unflatten(-1, (WAYPOINTS, 3))
        plans = torch.cat([base + moved[..., :2], math.pi * moved[..., 2:].tanh()], dim=-1)
        return plans, self.confidence(feature).squeeze(-1).float()


class DiffusionDecoder(nn.Module):
    """Noisy positions of every anchor to plans, in a cascade of layers."""

    def __init__(self, width: int, heads: int, hidden: int, layers: int, dropout: float, layout: BevLayout) -> None:
        super().__init__()
        self.width = width
        self.feature = nn.Sequential(
            nn.Linear(WAYPOINTS * POINT_FEATURES, width), nn.ReLU(), nn.LayerNorm(width), nn.Linear(width, width)
        )
        self.step = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.layers = nn.ModuleList(DiffusionLayer(width, heads, hidden, dropout, layout) for _ in range(layers))

    def forward(
        self, points: Tensor, base: Tensor, step: Tensor, above: Tensor, agents: Tensor, ego: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Points (B, A, 8, 2) in m at noise step (B,): plans (B, A, 8, 3) and logits (B, A) of every layer.

        The first layer's plans are offsets from `base`, which is the points themselves or what the noise was added to.
        """
        feature = self.feature(waves(points, POINT_FEATURES // 2, 2.0 * math.pi).flatten(2))
        noise = self.step(waves(step, self.width))
        results = []
        for layer in self.layers:
            plans, logits = layer(feature, points, base, above, agents, ego, noise)
            results.append((plans, logits))
            points = base = plans[..., :2].detach()
        return results
