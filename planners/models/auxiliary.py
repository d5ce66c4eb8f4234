"""What a planner learns beside planning: where things are, as classes of cells and as boxes of vehicles.

Heads and losses of the public TransFuser for NAVSIM (TransfuserModel, transfuser_loss), whose constants these are.
"""

import math
from typing import Any

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn import functional as F

from planners.data.batch import Batch
from planners.data.bev import BevClass

N_CLASSES = 7  # background .. pedestrian, as published: a cell of the route counts as centre line
IN_VIEW_RAD = 4 * math.pi / 9  # to either side of ahead: the cameras do not show the vehicles beyond


class BevHead(nn.Module):
    """Features from above to scores of the classes of every cell."""

    def __init__(self, channels: int, shape: tuple[int, int]) -> None:
        super().__init__()
        self.shape = shape
        self.layers = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, N_CLASSES, 1)
        )

    def forward(self, bev: Tensor) -> Tensor:
        """(B, channels, n, n) to logits (B, N_CLASSES, rows, columns)."""
        return F.interpolate(self.layers(bev), self.shape, mode="bilinear")


def bev_loss(logits: Tensor, bev: Tensor) -> Tensor:
    """Cross-entropy of logits (B, N_CLASSES, rows, columns) against the newest of rasters (B, T, rows, columns)."""
    wanted = bev[:, -1].long()
    return F.cross_entropy(logits, torch.where(wanted == int(BevClass.ROUTE), int(BevClass.CENTERLINE), wanted))


class AgentHead(nn.Module):
    """One vehicle a query: its box, and how sure it is that there is one."""

    def __init__(self, width: int, hidden: int, reach_m: float) -> None:
        super().__init__()
        self.reach_m = reach_m
        self.box = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, 5))
        self.there = nn.Linear(width, 1)

    def forward(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Queries (B, N, width) to boxes (B, N, 5), centre x, y, heading, length, width, and logits (B, N)."""
        centre, heading, size = self.box(queries).float().split([2, 1, 2], dim=-1)
        boxes = torch.cat([centre.tanh() * self.reach_m, heading.tanh() * math.pi, size], -1)
        return boxes, self.there(queries)[..., 0].float()


def agent_losses(
    boxes: Tensor, logits: Tensor, agents: Tensor, valid: Tensor, class_weight: float, box_weight: float
) -> tuple[Tensor, Tensor]:
    """Cross-entropy of being there, and L1 of the boxes summed over their five numbers, a vehicle's mean; unweighted.

    boxes, agents (B, N, 5); logits, valid (B, N). Predictions and vehicles are matched one to one, at the least sum of
    both terms (of the boxes the centre alone) under their weights. Vehicles outside IN_VIEW_RAD do not count.
    """
    valid = valid & (torch.atan2(agents[..., 1], agents[..., 0]).abs() <= IN_VIEW_RAD)
    chosen = _matching(boxes, logits, agents, valid, class_weight, box_weight)
    agents = agents.gather(1, chosen[..., None].expand_as(agents))
    there = valid.gather(1, chosen).float()
    off = ((boxes - agents).abs().sum(-1) * there).sum() / there.sum().clamp(min=1.0)
    return F.binary_cross_entropy_with_logits(logits, there), off


@torch.no_grad()
def _matching(
    boxes: Tensor, logits: Tensor, agents: Tensor, valid: Tensor, class_weight: float, box_weight: float
) -> Tensor:
    """(B, N) int64: which vehicle, or which empty place, each prediction answers for."""
    there = valid[:, None, :].float().expand(-1, logits.shape[1], -1)  # (B, predictions, vehicles)
    unsure = F.binary_cross_entropy_with_logits(logits[:, :, None].expand_as(there), there, reduction="none")
    apart = (boxes[:, :, None, :2] - agents[:, None, :, :2]).abs().sum(-1) * there
    cost = (class_weight * unsure + box_weight * apart).cpu().numpy()
    columns = [torch.from_numpy(linear_sum_assignment(c)[1]) for c in cost]
    return torch.stack(columns).to(boxes.device)


def auxiliary_losses(settings: Any, batch: Batch, bev: Tensor, boxes: Tensor, logits: Tensor) -> dict[str, Tensor]:
    """The weighted terms of a planner whose settings name their weights, of the outputs of both heads."""
    if batch.bev is None or batch.agents is None or batch.agents_valid is None:
        raise ValueError("a batch without view from above or agents cannot be learned from")
    weights = settings.agent_class_weight, settings.agent_box_weight
    there, box = agent_losses(boxes, logits, batch.agents, batch.agents_valid, *weights)
    return {
        "agent_class": weights[0] * there,
        "agent_box": weights[1] * box,
        "bev": settings.bev_weight * bev_loss(bev, batch.bev),
    }
