"""Noise and its removal (DDPM, Ho et al. 2020; DDIM with eta = 0, Song et al. 2021), cut to the first steps.

    x_t = sqrt(A_t) x_0 + sqrt(1 - A_t) e,   A_t = prod_{s <= t} (1 - beta_s)

beta rises as the square of a line from sqrt(1e-4) to sqrt(0.02) over 1,000 steps: "scaled linear", the defaults of the
scheduler in diffusers that DiffusionDrive builds with `beta_schedule="scaled_linear", prediction_type="sample"`.
"""

import torch
from torch import Tensor

STEPS = 1000
BETA_FIRST, BETA_LAST = 1e-4, 0.02


def kept() -> Tensor:
    """A_t for t = 0 .. 999, float32 (1000,)."""
    betas = torch.linspace(BETA_FIRST**0.5, BETA_LAST**0.5, STEPS, dtype=torch.float64) ** 2
    return (1.0 - betas).cumprod(0).float()


def noised(x0: Tensor, noise: Tensor, kept_at: Tensor) -> Tensor:
    """x_t from x_0 and e of one shape; kept_at is A_t, broadcast against them."""
    return kept_at.sqrt() * x0 + (1.0 - kept_at).sqrt() * noise


def stepped(x_t: Tensor, x0: Tensor, kept_at: Tensor, kept_before: Tensor) -> Tensor:
    """x at an earlier step from x_t and a prediction of x_0, which is clipped to -1 .. 1 for where it leads.

    The noise direction comes from the prediction as it is, as in diffusers (`use_clipped_model_output=False`).
    """
    noise = (x_t - kept_at.sqrt() * x0) / (1.0 - kept_at).sqrt()
    return noised(x0.clamp(-1.0, 1.0), noise, kept_before)
