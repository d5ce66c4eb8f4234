"""The rasteriser's slow, obvious twin: every Gaussian on every pixel in plain torch, which knows its own gradients."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tasks.render.splatting.gaussians import Gaussians, rotations_of
from tasks.render.splatting.project import BESIDE, FITTED, MIN_ALPHA, NEAR_M, ScreenFilter
from tasks.render.splatting.raster import MAX_ALPHA


@dataclass
class SlowGaussians:
    """As `Gaussians`, as tensors; opacities as logits, `sides` (N, 3, 3) turning a direction into its node's frame."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    colours: Tensor
    sh_rest: Tensor
    sides: Tensor

    def leaves(self) -> list[Tensor]:
        return [self.means, self.quats, self.log_scales, self.logits, self.colours]


def slow(gaussians: Gaussians, dtype: torch.dtype = torch.float64, grad: bool = True) -> SlowGaussians:
    """Leaves to differentiate by."""
    opacities = torch.tensor(gaussians.opacities, dtype=torch.float64)
    arrays = (gaussians.means, gaussians.quats, gaussians.log_scales, torch.logit(opacities))
    leaves = [torch.as_tensor(a).to(dtype) for a in (*arrays, gaussians.colours, gaussians.sh_rest)]
    leaves = [leaf.clone().requires_grad_(grad) for leaf in leaves]
    return SlowGaussians(*leaves, sides=torch.eye(3, dtype=dtype).expand(len(gaussians), 3, 3))


def slow_moved(gaussians: SlowGaussians, target_from_source: NDArray[np.float64]) -> SlowGaussians:
    """In another frame; the side it is seen from is looked up in its own."""
    pose = torch.tensor(target_from_source)
    axes = pose[:3, :3] @ rotations(gaussians.quats)
    return SlowGaussians(
        gaussians.means @ pose[:3, :3].T + pose[:3, 3],
        _quats(axes),
        gaussians.log_scales,
        gaussians.logits,
        gaussians.colours,
        gaussians.sh_rest,
        gaussians.sides @ pose[:3, :3].T,
    )


def slow_concatenate(parts: list[SlowGaussians]) -> SlowGaussians:
    names = SlowGaussians.__dataclass_fields__
    return SlowGaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def rotations(quats: Tensor) -> Tensor:
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def _quats(axes: Tensor) -> Tensor:
    """Of rotations (N, 3, 3) that turn by less than half a turn."""
    w = 0.5 * (1 + axes[:, 0, 0] + axes[:, 1, 1] + axes[:, 2, 2]).sqrt()
    x, y, z = axes[:, 2, 1] - axes[:, 1, 2], axes[:, 0, 2] - axes[:, 2, 0], axes[:, 1, 0] - axes[:, 0, 1]
    return torch.stack([w, x / (4 * w), y / (4 * w), z / (4 * w)], 1)


def sh_basis(directions: Tensor) -> Tensor:
    """(N, 15) real spherical harmonics of degrees 1 to 3 as 3-D Gaussian splatting numbers and signs them."""
    x, y, z = directions.unbind(1)
    pi = np.pi
    columns = [
        -np.sqrt(3 / (4 * pi)) * y,
        np.sqrt(3 / (4 * pi)) * z,
        -np.sqrt(3 / (4 * pi)) * x,
        np.sqrt(15 / (4 * pi)) * x * y,
        -np.sqrt(15 / (4 * pi)) * y * z,
        np.sqrt(5 / (16 * pi)) * (3 * z * z - 1),
        -np.sqrt(15 / (4 * pi)) * x * z,
        np.sqrt(15 / (16 * pi)) * (x * x - y * y),
        -np.sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y),
        np.sqrt(105 / (4 * pi)) * x * y * z,
        -np.sqrt(21 / (32 * pi)) * y * (5 * z * z - 1),
        np.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
        -np.sqrt(21 / (32 * pi)) * x * (5 * z * z - 1),
        np.sqrt(105 / (16 * pi)) * z * (x * x - y * y),
        -np.sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y),
    ]
    return torch.stack(columns, 1)


def slow_render(
    gaussians: SlowGaussians,
    intrinsics: NDArray[np.float64],
    scene_from_camera: NDArray[np.float64],
    background: Tensor,
    motion: Tensor | None = None,
    window: tuple[int, int, int, int] | None = None,
    screen: ScreenFilter = FITTED,
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb (H, W, 3), depth, alpha (H, W) over `background` (H, W, 3).

    `motion` (6,) moves the camera by a small x' = x + v + w cross x in its own coordinates; `window` x0, y0, x1, y1
    leaves only these pixels of the picture.
    """
    dtype = gaussians.means.dtype
    height, width = background.shape[:2]
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    camera = torch.tensor(np.linalg.inv(scene_from_camera), dtype=dtype)
    turn, shift = camera[:3, :3], camera[:3, 3]
    if motion is not None:
        v, w = motion[:3], motion[3:]
        turn = turn + torch.linalg.cross(w[:, None].expand(3, 3), turn, dim=0)
        shift = shift + v + torch.linalg.cross(w, shift)

    points = gaussians.means @ turn.T + shift
    x, y, z = points.unbind(1)
    opacities = torch.sigmoid(gaussians.logits)
    rows = torch.nonzero((z >= NEAR_M) & (opacities > MIN_ALPHA))[:, 0]
    rows = rows[torch.argsort(z[rows], stable=True)]
    x, y, z, opacities = x[rows], y[rows], z[rows], opacities[rows]

    tx = (x / z).clamp(-(cx + BESIDE * width) / fx, (width - cx + BESIDE * width) / fx)
    ty = (y / z).clamp(-(cy + BESIDE * height) / fy, (height - cy + BESIDE * height) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx / z * tx], 1), torch.stack([zero, fy / z, -fy / z * ty], 1)], 1
    )
    axes = jacobian @ turn @ (rotations(gaussians.quats) * gaussians.log_scales.exp()[:, None, :])[rows]
    sharp = axes @ axes.transpose(1, 2)
    wider = sharp + screen.dilation_px2 * torch.eye(2, dtype=dtype)
    conic = torch.linalg.inv(wider)
    if screen.keeps_light:
        opacities = opacities * (torch.linalg.det(sharp) / torch.linalg.det(wider)).sqrt()

    center = -turn.T @ shift
    directions = gaussians.means - center
    directions = directions / directions.norm(dim=1, keepdim=True)
    directions = (gaussians.sides @ directions[:, :, None])[:, :, 0]
    count = gaussians.sh_rest.shape[1]
    light = torch.einsum("nm,nmc->nc", sh_basis(directions)[:, :count], gaussians.sh_rest)
    colours = (gaussians.colours + light).clamp(min=0.0)[rows]

    x0, y0, x1, y1 = window or (0, 0, width, height)
    v, u = torch.meshgrid(torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij")
    du = u.to(dtype) - (fx * x / z + cx)[:, None, None]
    dv = v.to(dtype) - (fy * y / z + cy)[:, None, None]
    a, b, c = (conic[:, k, m, None, None] for k, m in ((0, 0), (0, 1), (1, 1)))
    alpha = opacities[:, None, None] * torch.exp(-0.5 * (a * du * du + 2 * b * du * dv + c * dv * dv))
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), torch.zeros_like(alpha))
    passing = torch.cumprod(1 - alpha, dim=0)
    weight = alpha * torch.cat([torch.ones_like(passing[:1]), passing[:-1]])
    covered = weight.sum(0)
    rgb = torch.einsum("nhw,nc->hwc", weight, colours) + (1 - covered)[..., None] * background[y0:y1, x0:x1]
    depth = torch.einsum("nhw,n->hw", weight, z) / torch.where(covered > 0, covered, torch.ones_like(covered))
    return rgb, depth, covered


def covariances_of(gaussians: Gaussians) -> NDArray[np.float64]:
    """(N, 3, 3) covariance matrices [m^2]."""
    axes = rotations_of(gaussians.quats) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    return np.asarray(axes @ np.swapaxes(axes, 1, 2))
