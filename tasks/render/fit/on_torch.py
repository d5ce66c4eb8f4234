"""The fit on a device of torch's: the state lies there, one photo an iteration goes there, and torch derives the loss.

Exposure, poses and boxes, a few numbers a photo, stay on the CPU, and so does density control: it is the same code and
the same draws, for which the state comes back. Sums on a GPU are added up in any order, so that no two fits are alike
to the last bit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from tasks.render.fit.backend import HIDDEN, Derivatives, OwnedGaussians, box_gradient, visible_parts
from tasks.render.fit.corrections import corrected_pose
from tasks.render.fit.losses import C1, C2, SIGMA, WINDOW
from tasks.render.fit.start import FitProblem
from tasks.render.fit.state import (
    BACKGROUND,
    BETA1,
    BETA2,
    CELL_M,
    EPSILON,
    LONGEST_M,
    SHAPES,
    SLACK_M,
    THICKNESS_M,
    AdamArray,
    FitState,
    Road,
)
from tasks.render.scene.movers import SHIFT_SIZE
from tasks.render.scene.on_device import sky_places
from tasks.render.scene.sky import COLUMNS
from tasks.render.settings import FitSettings
from tasks.render.splatting.gradient import Gradients
from tasks.render.splatting.tensors import Draw, Eye, SceneTensors, hamilton, moved
from tasks.world.arrays import F32, Array, Ints, ShortInts

# What the fit does to pictures and Gaussians, once more for tensors: each the twin of the numba or numpy function
# that it names, with torch's own derivatives.


class LearnedTensor:
    """`state.AdamArray`, on a device."""

    def __init__(self, values: Tensor, first: Tensor, second: Tensor, steps: Tensor) -> None:
        self.values, self.first, self.second, self.steps = values, first, second, steps

    def step(self, rows: Tensor, gradient: Tensor, rate: float, scale: Tensor | None = None) -> None:
        """`AdamArray.step`."""
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


def apply_exposure(rgb: Tensor, row: Tensor) -> Tensor:
    """`corrections.apply_exposure`."""
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
    mean_x, square_x, product = SelfAdjointBlur.apply(torch.cat([x, x * x, x * y], dim=-1)).split(3, dim=-1)
    mean_y, square_y = _blur(torch.cat([y, y * y], dim=-1)).split(3, dim=-1)
    cross, spread = product - mean_x * mean_y, square_x - mean_x**2 + square_y - mean_y**2
    return (2.0 * mean_x * mean_y + C1) * (2.0 * cross + C2) / ((mean_x**2 + mean_y**2 + C1) * (spread + C2))


class SelfAdjointBlur(torch.autograd.Function):
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


def composite_sky(
    rgb: Tensor, alpha: Tensor, cells: Tensor, intrinsics: Array, scene_from_camera: Array
) -> tuple[Tensor, Tensor]:
    """A picture (H, W, 3) with the sky behind it, and which of the `cells` (ROWS * COLUMNS, 3) that it asks for.

    As `sky.look_up_sky` has it, and `backend.backdrop_gradient`: what hides more than HIDDEN asks nothing.
    """
    lens, turn = (torch.as_tensor(of[None, :3, :3], device=alpha.device) for of in (intrinsics, scene_from_camera))
    (tops, lefts), rights, belows = sky_places(lens, turn, *alpha.shape)
    left, right, below = lefts[0], rights[0, ..., None].float(), belows[0, ..., None].float()
    at_left, at_right = tops[0] * COLUMNS + left, tops[0] * COLUMNS + (left + 1) % COLUMNS

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
    """`state.lay_flat`, in place."""
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


def limit_stretch(log_scales: Tensor, most: float) -> Tensor:
    """`state.limit_stretch`."""
    return torch.maximum(log_scales, log_scales.amax(dim=1, keepdim=True) - math.log(most))


def _upright(quats: Tensor, slope_x: Tensor, slope_y: Tensor) -> Tensor:
    """Quaternions (M, 4) turned the shortest way so that their third axes are along the road's normals."""
    w, x, y, s = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    axis = torch.stack([2.0 * (x * s + w * y), 2.0 * (y * s - w * x), 1.0 - 2.0 * (x * x + y * y)], dim=1)
    normal = torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)], dim=1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    normal = torch.where(((axis * normal).sum(1) < 0.0)[:, None], -normal, normal)  # the other face of the disc
    turn = torch.cat([1.0 + (axis * normal).sum(1, keepdim=True), torch.linalg.cross(axis, normal)], dim=1)
    return hamilton(turn / turn.norm(dim=1, keepdim=True), torch.stack([w, x, y, s], dim=1))


DEVICE_SIDE = (*SHAPES, "sky")


@dataclass
class StateTensors:
    """`FitState`, of which the Gaussians and the sky lie on a device."""

    iteration: int
    learned: dict[str, Any]  # LearnedTensor; exposure, poses and boxes: Learned
    owner: ShortInts  # (N,) on the CPU
    road: Tensor
    nearest: Tensor
    wanted: Tensor

    def record_view(self, rows: Tensor, depths: Tensor, screen: Tensor) -> Tensor:
        """`FitState.record_view`."""
        self.nearest[rows] = torch.minimum(self.nearest[rows], depths)
        self.wanted[rows] += torch.hypot(screen[:, 0], screen[:, 1])
        return self.nearest[rows]

    def lay_flat(self, rows: Tensor, road: Road) -> None:
        """`FitState.lay_flat`."""
        means, quats, log_scales = (self.learned[name].values for name in ("means", "quats", "log_scales"))
        lay_flat(means, quats, log_scales, rows[self.road[rows]], road)

    def keep_round(self, rows: Tensor, background: float, boxes: float) -> None:
        """`FitState.keep_round`."""
        log_scales, owned = self.learned["log_scales"].values, rows >= int((self.owner == BACKGROUND).sum())
        for most, mine in ((background, rows[~owned & ~self.road[rows]]), (boxes, rows[owned])):
            if most > 0.0:
                log_scales[mine] = limit_stretch(log_scales[mine], most)


@dataclass(frozen=True)
class TorchBackend:
    """Draws with `draw`, on `device`."""

    draw: Draw
    device: str

    def __post_init__(self) -> None:
        # In this process: containers that set TORCH_ALLOW_TF32_CUBLAS_OVERRIDE multiply by ten bits, poses need more.
        torch.set_float32_matmul_precision("highest")

    def load(self, state: FitState) -> StateTensors:
        """A copy of it, on the device."""
        learned: dict[str, Any] = dict(state.learned)
        for name in DEVICE_SIDE:
            here = state.learned[name]
            learned[name] = LearnedTensor(*(self._sent(getattr(here, each.name)) for each in fields(AdamArray)))
        others = (self._sent(array) for array in (state.road, state.nearest, state.wanted))
        return StateTensors(state.iteration, learned, state.owner, *others)

    def store(self, held: StateTensors, state: FitState) -> None:
        """Exposure, poses and boxes never left."""
        state.iteration = held.iteration
        for name in DEVICE_SIDE:
            there = held.learned[name]
            state.learned[name] = AdamArray(*(getattr(there, each.name).cpu().numpy() for each in fields(AdamArray)))
        state.nearest, state.wanted = held.nearest.cpu().numpy(), held.wanted.cpu().numpy()

    def derivatives(self, problem: FitProblem, held: StateTensors, row: int, settings: FitSettings) -> Derivatives:
        """As `FitBackend` has it."""
        shot = problem.train[row]
        compared = shot.compared
        leaves = [held.learned[name].values.detach().requires_grad_() for name in DEVICE_SIDE]
        exposure = self._sent(held.learned["exposure"].values[row]).requires_grad_()
        height, width = shot.photo.rgb.shape[:2]
        camera = corrected_pose(shot.photo.world_from_camera, held.learned["poses"].values[row])
        eye = Eye(shot.photo.intrinsics, camera, width, height, torch.zeros(6, device=self.device, requires_grad=True))
        parts = visible_parts(problem, held.owner, held.learned["boxes"].values, shot.photo)
        seen = self.draw(_compose_scene(leaves[:-1], parts), eye)

        rgb, cells = composite_sky(seen.rgb, seen.alpha, leaves[-1], eye.intrinsics, camera)
        picture, photo = apply_exposure(rgb, exposure), self._sent(shot.photo.rgb).float() / 255.0
        loss = photo_loss(picture, photo, self._sent(compared.target.weight), settings.ssim_weight)
        if settings.opaque_weight > 0.0:
            loss = loss + opaque_loss(seen.alpha, self._sent(compared.ground), settings.opaque_weight)

        asked = [*leaves, exposure, eye.motion, seen.screen]
        by = torch.autograd.grad(loss, asked, materialize_grads=True)
        means, quats, log_scales, logits, colours, sky, d_exposure, d_camera, screen = by
        spans = [torch.arange(span.start, span.stop, device=self.device) for span in map(_row_slice, parts)]
        rows = torch.cat(spans)[seen.index]
        tracks, boxes = _box_gradients(parts, leaves[0].detach(), leaves[1].detach(), means, quats)
        shapes = {"means": means, "quats": quats, "log_scales": log_scales, "logits": logits[:, 0], "colours": colours}
        back: dict[str, Any] = {name: tensor[rows] for name, tensor in shapes.items()}
        back |= {"index": rows, "screen": screen}
        back["camera"] = d_camera.double().cpu().numpy()
        error = torch.mean((picture.detach().clamp(0.0, 1.0) - photo).double() ** 2)
        score = float(-10.0 * torch.log10(error))
        shown = (cells, sky[cells], rows, Gradients(**back), seen.depths, tracks, boxes)
        return Derivatives(float(loss.detach()), score, d_exposure.cpu().numpy(), back["camera"], *shown)

    def _sent(self, array: object) -> Tensor:
        return torch.as_tensor(array, device=self.device).clone()


def _compose_scene(leaves: Sequence[Tensor], parts: Sequence[OwnedGaussians]) -> SceneTensors:
    """The scene of `parts`, of which a photo shows some; `leaves` as of SHAPES."""
    means, quats, log_scales, logits, colours = leaves
    every = SceneTensors(means, quats, log_scales, logits[:, 0], colours)
    scenes = []
    for part in parts:
        mine = SceneTensors(*(tensor[_row_slice(part)] for tensor in every.parts()))
        scenes.append(mine if part.scene_from_owner is None else moved(mine, part.scene_from_owner))
    return SceneTensors(*(torch.cat(tensors) for tensors in zip(*(scene.parts() for scene in scenes))))


def _box_gradients(
    parts: Sequence[OwnedGaussians], means: Tensor, quats: Tensor, d_means: Tensor, d_quats: Tensor
) -> tuple[Ints, F32]:
    """Tracks (B,), and derivatives (B, SHIFT_SIZE) by what their boxes are off by; the tensors are the state's."""
    mine = [part for part in parts if part.track is not None]
    found = [
        torch.cat([shift, turn[None]])
        for part in mine
        for shift, turn in [
            box_gradient(part, *(one[_row_slice(part)].double() for one in (means, quats, d_means, d_quats)))
        ]
    ]
    together = torch.stack(found).float().cpu().numpy() if found else np.zeros((0, SHIFT_SIZE), np.float32)
    return np.array([part.track for part in mine], np.int64), together


def _row_slice(part: OwnedGaussians) -> slice:
    """Its rows of the state."""
    return slice(int(part.rows[0]), int(part.rows[-1]) + 1) if len(part.rows) else slice(0, 0)
