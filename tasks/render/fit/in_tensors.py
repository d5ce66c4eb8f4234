"""What the fit does to pictures and Gaussians, once more for tensors: each the twin of the numba or numpy function that
it names, with torch's own derivatives."""

import math
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from tasks.render.fit.adam import BETA1, BETA2, EPSILON
from tasks.render.fit.backdrop import HIDDEN
from tasks.render.fit.losses import C1, C2, SIGMA, WINDOW
from tasks.render.fit.road import CELL_M, LONGEST_M, SLACK_M, THICKNESS_M, Road
from tasks.render.scene.sky import COLUMNS, ROWS
from tasks.world.arrays import Array


class LearnedTensor:
    """`adam.Learned`, on a device."""

    def __init__(self, values: Tensor, first: Tensor, second: Tensor, steps: Tensor) -> None:
        self.values, self.first, self.second, self.steps = values, first, second, steps

    def step(self, rows: Tensor, gradient: Tensor, rate: float, scale: Tensor | None = None) -> None:
        """`Learned.step`."""
        self.steps[rows] += 1
        counts = self.steps[rows].double()[:, None]
        first = BETA1 * self.first[rows] + (1.0 - BETA1) * gradient
        second = BETA2 * self.second[rows] + (1.0 - BETA2) * gradient * gradient
        self.first[rows], self.second[rows] = first, second
        size = rate / (1.0 - BETA1**counts)
        if scale is not None:
            size = size * scale[:, None]
        spread = (second / (1.0 - BETA2**counts)).sqrt() + EPSILON
        self.values[rows] -= (size * first / spread).float()


def exposed(rgb: Tensor, row: Tensor) -> Tensor:
    """`corrections.exposed`."""
    matrix = torch.eye(3, dtype=row.dtype, device=row.device) + row[:9].view(3, 3)
    return rgb @ matrix.T + row[9:]


def photo_loss(rgb: Tensor, photo: Tensor, weight: Tensor, ssim_weight: float) -> Tensor:
    """`losses.photo_loss` of a picture (H, W, 3) against a photo; `weight` (H, W) of its pixels."""
    share = weight[..., None] / (3.0 * weight.sum().clamp(min=1.0))
    loss = (1.0 - ssim_weight) * (share * (rgb - photo).abs()).sum()
    if ssim_weight > 0.0:
        loss = loss + ssim_weight * (1.0 - (share * _similarity(rgb, photo)).sum())
    return loss


def _similarity(x: Tensor, y: Tensor) -> Tensor:
    """(H, W, 3) SSIM of each pixel and channel; `y` is not derived by."""
    mean_x, square_x, product = Blurred.apply(torch.cat([x, x * x, x * y], dim=-1)).split(3, dim=-1)
    mean_y, square_y = _blur(torch.cat([y, y * y], dim=-1)).split(3, dim=-1)
    cross, spread = product - mean_x * mean_y, square_x - mean_x**2 + square_y - mean_y**2
    return (2.0 * mean_x * mean_y + C1) * (2.0 * cross + C2) / ((mean_x**2 + mean_y**2 + C1) * (spread + C2))


class Blurred(torch.autograd.Function):
    """`_blur`, which is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        return _blur(image)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        return _blur(upstream[0])


def _blur(image: Tensor) -> Tensor:
    """`losses._blur`, (H, W, C). Tap by tap: convolutions on a GPU keep ten bits (TF32), and variances need more."""
    reach, taps = WINDOW // 2, cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)[:, 0]
    for axis, beyond in enumerate(((0, 0, 0, 0, reach, reach), (0, 0, reach, reach))):
        padded, n = pad(image, beyond), image.shape[axis]
        image = padded.narrow(axis, 0, n) * float(taps[0])
        for k in range(1, WINDOW):
            image.add_(padded.narrow(axis, k, n), alpha=float(taps[k]))
    return image


def opaque_loss(alpha: Tensor, ground: Tensor, weight: float) -> Tensor:
    """`losses.opaque_loss`."""
    return weight / alpha.numel() * ((1.0 - alpha) * ground).sum()


def before_sky(
    rgb: Tensor, alpha: Tensor, cells: Tensor, intrinsics: Array, scene_from_camera: Array
) -> tuple[Tensor, Tensor]:
    """A picture (H, W, 3) with the sky behind it, and which of the `cells` (ROWS * COLUMNS, 3) that it asks for.

    As `backdrop.backdrop` has it, and `backdrop.backdrop_gradient`: what hides more than HIDDEN asks nothing.
    """
    height, width = alpha.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=alpha.device).double() + 0.5,
        torch.arange(width, device=alpha.device).double() + 0.5,
        indexing="ij",
    )
    across, down = (u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]
    x, y, z = (float(t[0]) * across + float(t[1]) * down + float(t[2]) for t in scene_from_camera[:3, :3])
    row = (0.5 - torch.atan2(z, torch.hypot(x, y)) / math.pi) * ROWS - 0.5
    column = (torch.atan2(y, x) / (2.0 * math.pi) + 0.5) * COLUMNS - 0.5
    top, left = row.floor().clamp(0, ROWS - 2), column.floor()
    below, right = (row - top).clamp(0.0, 1.0)[..., None].float(), (column - left)[..., None].float()
    corner = (top * COLUMNS).long()
    at_left, at_right = corner + left.long() % COLUMNS, corner + (left.long() + 1) % COLUMNS

    behind = torch.zeros_like(rgb)
    open_to_it = alpha.detach() <= HIDDEN
    asked = torch.zeros(len(cells), dtype=torch.bool, device=cells.device)
    for cell, share in (
        (at_left, (1.0 - right) * (1.0 - below)),
        (at_right, right * (1.0 - below)),
        (at_left + COLUMNS, (1.0 - right) * below),
        (at_right + COLUMNS, right * below),
    ):
        looked_up = cells[cell]
        behind = behind + share * torch.where(open_to_it[..., None], looked_up, looked_up.detach())
        asked[cell[open_to_it]] = True
    return rgb + (1.0 - alpha)[..., None] * behind, asked.nonzero()[:, 0]


def lay_flat(means: Tensor, quats: Tensor, log_scales: Tensor, rows: Tensor, road: Road) -> None:
    """`road.lay_flat`, in place."""
    field = torch.tensor(np.dstack([road.heights, road.slopes]), device=means.device)
    x, y, z = means[rows].double().unbind(1)
    u, v = (x - float(road.corner[0])) / CELL_M, (y - float(road.corner[1])) / CELL_M
    i, j = u.floor().long(), v.floor().long()
    on = (i >= 0) & (j >= 0) & (i + 1 < field.shape[0]) & (j + 1 < field.shape[1])
    rows, x, y, z, u, v, i, j = (t[on] for t in (rows, x, y, z, u, v, i, j))
    a, b = (u - i)[:, None], (v - j)[:, None]
    here = (1 - a) * ((1 - b) * field[i, j] + b * field[i, j + 1]) + a * (
        (1 - b) * field[i + 1, j] + b * field[i + 1, j + 1]
    )
    known = here[:, 0].isfinite()
    rows, z, here = rows[known], z[known], here[known]
    height, slope_x, slope_y = here.unbind(1)
    means[rows, 2] = torch.minimum(torch.maximum(z, height - SLACK_M), height + SLACK_M).float()
    log_scales[rows, 2] = log_scales[rows, 2].clamp(max=math.log(THICKNESS_M))
    log_scales[rows, :2] = log_scales[rows, :2].clamp(max=math.log(LONGEST_M))
    quats[rows] = _upright(quats[rows].double(), slope_x, slope_y).float()


def rounded(log_scales: Tensor, most: float) -> Tensor:
    """`state.rounded`."""
    return torch.maximum(log_scales, log_scales.amax(dim=1, keepdim=True) - math.log(most))


def _upright(quats: Tensor, slope_x: Tensor, slope_y: Tensor) -> Tensor:
    """Quaternions (M, 4) turned the shortest way so that their third axes are along the road's normals."""
    w, x, y, s = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    axis = torch.stack([2.0 * (x * s + w * y), 2.0 * (y * s - w * x), 1.0 - 2.0 * (x * x + y * y)], dim=1)
    normal = torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)], dim=1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    normal = torch.where(((axis * normal).sum(1) < 0.0)[:, None], -normal, normal)  # the other face of the disc
    turn = torch.cat([1.0 + (axis * normal).sum(1, keepdim=True), torch.linalg.cross(axis, normal)], dim=1)
    tw, tx, ty, tz = (turn / turn.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            tw * w - tx * x - ty * y - tz * s,
            tw * x + tx * w + ty * s - tz * y,
            tw * y - tx * s + ty * w + tz * x,
            tw * s + tx * y - ty * x + tz * w,
        ],
        dim=1,
    )
