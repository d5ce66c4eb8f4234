"""What planners that regress one plan share: its decoding, and the loss that imitates."""

import math
from typing import Literal

import torch
from torch import Tensor

from planners.data.batch import COMMANDS, Batch

PlanFrom = Literal["zero", "constant_velocity"]  # what regressed poses are added to


def bounded_heading(poses: Tensor) -> Tensor:
    """(..., 3) with the heading within -pi .. pi, as the public TransFuser does: tanh(h) pi."""
    return torch.cat([poses[..., :2], poses[..., 2:].tanh() * math.pi], -1)


def imitation_l1(plan: Tensor, batch: Batch) -> Tensor:
    """Mean absolute error of x, y [m] and heading [rad] of plans (B, 8, 3) against the labels.

    Samples without `batch.imitate` weigh nothing, the sum is divided by the whole batch (paper, eq. 5).
    """
    error = (plan.float() - batch.plan_2hz).abs().mean(dim=(1, 2))
    return torch.where(batch.imitate, error, 0.0).mean()


def planned_from(base: PlanFrom, regressed: Tensor, batch: Batch) -> Tensor:
    """The plans (B, 8, 3) of what was regressed."""
    return regressed + straight_on(batch) if base == "constant_velocity" else regressed


def straight_on(batch: Batch) -> Tensor:
    """(B, 8, 3) poses at 0.5 .. 4.0 s of an ego that keeps the speed of now and does not turn."""
    times_s = torch.arange(1, 9, device=batch.status.device) * 0.5
    ahead = batch.status[:, len(COMMANDS), None].float() * times_s
    return torch.stack([ahead, torch.zeros_like(ahead), torch.zeros_like(ahead)], -1)
