"""What planners that regress one plan share: its decoding, and the loss that imitates."""

import math

import torch
from torch import Tensor

from planners.batch import Batch


def bounded_heading(poses: Tensor) -> Tensor:
    """(..., 3) with the heading within -pi .. pi, as the public TransFuser does: tanh(h) pi."""
    return torch.cat([poses[..., :2], poses[..., 2:].tanh() * math.pi], -1)


def imitation_l1(plan: Tensor, batch: Batch) -> Tensor:
    """Mean absolute error of x, y [m] and heading [rad] of plans (B, 8, 3) against the labels.

    Samples without `batch.imitate` weigh nothing, the sum is divided by the whole batch (paper, eq. 5).
    """
    error = (plan.float() - batch.plan_2hz).abs().mean(dim=(1, 2))
    return torch.where(batch.imitate, error, 0.0).mean()
