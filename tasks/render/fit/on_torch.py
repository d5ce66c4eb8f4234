"""The fit on a device of torch's: state, road and photos lie there, and torch derives the loss.

Exposure, poses and boxes, a few numbers a photo, stay on the CPU. Where Gaussians go is drawn there as well, by the
same code and the same draws, for which opacities and what was wanted come back, and nothing else of the state. Sums on
a GPU are added up in any order, so that no two fits are alike to the last bit.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import accumulate
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from tasks.render.fit.backend import HIDDEN, Derivatives, OwnedGaussians, box_gradient, visible_parts
from tasks.render.fit.corrections import corrected_pose
from tasks.render.fit.losses import C1, C2, SIGMA, WINDOW
from tasks.render.fit.start import FitPhoto, FitProblem
from tasks.render.fit.state import (
    BACKGROUND,
    BETA1,
    BETA2,
    CELL_M,
    EPSILON,
    JITTER,
    LONGEST_M,
    SHAPES,
    SLACK_M,
    THICKNESS_M,
    WORLD,
    AdamArray,
    Copies,
    FitState,
    Road,
)
from tasks.render.scene.body import BEFORE_M, NEAREST_M, BodyView
from tasks.render.scene.movers import SHIFT_SIZE
from tasks.render.scene.on_device import sky_places
from tasks.render.scene.sky import COLUMNS, LEAST_LIGHT
from tasks.render.settings import FitSettings
from tasks.render.splatting.gradient import Gradients
from tasks.render.splatting.tensors import Draw, Eye, SceneTensors, hamilton, moved
from tasks.world.arrays import F32, Array, Ints, ShortInts

# What the fit does to pictures and Gaussians, once more for tensors: each the twin of the numba or numpy function
# that it names, with torch's own derivatives.


class LearnedTensor:
    """`state.AdamArray`, on a device; of `steps` each column (N, C) has its own."""

    def __init__(self, values: Tensor, first: Tensor, second: Tensor, steps: Tensor) -> None:
        self.values, self.first, self.second, self.steps = values, first, second, steps

    def step(self, rows: Tensor, gradient: Tensor, rate: float | Tensor, scale: Tensor | None = None) -> None:
        """`AdamArray.step`; columns may have a `rate` each (C,) and a `scale` each (M, C)."""
        steps = self.steps[rows] + 1
        counts = steps.double()
        first = BETA1 * self.first[rows] + (1.0 - BETA1) * gradient
        second = BETA2 * self.second[rows] + (1.0 - BETA2) * gradient * gradient
        self.steps[rows], self.first[rows], self.second[rows] = steps, first, second
        size = rate / (1.0 - BETA1**counts)
        if scale is not None:
            size = size * scale
        spread = (second / (1.0 - BETA2**counts)).sqrt() + EPSILON
        self.values[rows] -= (size * first / spread).float()

    def take(self, rows: Tensor) -> "LearnedTensor":
        """`AdamArray.take`."""
        return LearnedTensor(self.values[rows], self.first[rows], self.second[rows], self.steps[rows])

    def forget(self, rows: Ints | Tensor) -> None:
        """`AdamArray.forget`."""
        for of in (self.first, self.second, self.steps):
            of[rows] = 0

    def columns(self, first: int, last: int) -> "LearnedTensor":
        """Some of them, which are stepped with all."""
        return LearnedTensor(*(of[:, first:last] for of in (self.values, self.first, self.second, self.steps)))


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
    """`losses`' windowed mean (H, W, C), a pass an axis. cuDNN would keep ten bits (TF32), and variances need more."""
    taps = torch.as_tensor(cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F), device=image.device)
    planes, n = image.permute(2, 0, 1)[None].contiguous(), image.shape[-1]
    with torch.backends.cudnn.flags(enabled=False):
        for shape, padding in (((n, 1, WINDOW, 1), (WINDOW // 2, 0)), ((n, 1, 1, WINDOW), (0, WINDOW // 2))):
            planes = conv2d(planes, taps.view(1, *shape[1:]).expand(shape), padding=padding, groups=n)
    return planes[0].permute(1, 2, 0)


def opaque_loss(alpha: Tensor, ground: Tensor, weight: float) -> Tensor:
    """`losses.opaque_loss`."""
    return weight / alpha.numel() * ((1.0 - alpha) * ground).sum()


def composite_sky(
    rgb: Tensor, alpha: Tensor, cells: Tensor, intrinsics: Array, scene_from_camera: Array
) -> tuple[Tensor, Tensor]:
    """A picture (H, W, 3) with the sky behind it, and which of the `cells` (ROWS * COLUMNS, 3) that it asks for.

    As `sky.put_sky_behind` has it, and `backend.backdrop_gradient`: what hides more than HIDDEN asks nothing.
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
    light = 1.0 - alpha
    return rgb + torch.where(light > LEAST_LIGHT, light, 0.0)[..., None] * behind, asked.nonzero()[:, 0]


def lay_flat(means: Tensor, quats: Tensor, log_scales: Tensor, rows: Tensor, surface: Tensor, corner: Array) -> None:
    """`state.lay_flat`, in place; `surface` (X, Y, 3): the road's heights and slopes, from its `corner` on."""
    x, y, z = means[rows].double().unbind(1)
    u, v = (x - float(corner[0])) / CELL_M, (y - float(corner[1])) / CELL_M
    i, j = u.floor().long(), v.floor().long()
    on = (i >= 0) & (j >= 0) & (i + 1 < surface.shape[0]) & (j + 1 < surface.shape[1])
    rows, x, y, z, u, v, i, j = (t[on] for t in (rows, x, y, z, u, v, i, j))
    a, b = (u - i)[:, None], (v - j)[:, None]
    here = (1 - a) * ((1 - b) * surface[i, j] + b * surface[i, j + 1]) + a * (
        (1 - b) * surface[i + 1, j] + b * surface[i + 1, j + 1]
    )
    known = here[:, 0].isfinite()
    rows, z, here = rows[known], z[known], here[known]
    height, slope_x, slope_y = here.unbind(1)
    means[rows, 2] = torch.minimum(torch.maximum(z, height - SLACK_M), height + SLACK_M).float()
    log_scales[rows, 2] = log_scales[rows, 2].clamp(max=math.log(THICKNESS_M))
    log_scales[rows, :2] = log_scales[rows, :2].clamp(max=math.log(LONGEST_M))
    quats[rows] = _upright(quats[rows].double(), slope_x, slope_y).float()


def limit_stretch(log_scales: Tensor, most: float) -> Tensor:
    """What `state.FitState.keep_round` does to logarithms (M, 3) of sizes, all of one kind."""
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


def distance_before_bodies(points: Tensor, view: BodyView) -> tuple[Tensor, Tensor]:
    """`body.distance_before_bodies`."""
    camera_from_scene, intrinsics, eye = (
        torch.as_tensor(of, device=points.device) for of in (view.camera_from_scene, view.intrinsics, view.eye)
    )
    at = points @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]
    u, v = (intrinsics[k, k] * at[:, k] / at[:, 2] + intrinsics[k, 2] for k in (0, 1))
    seen = (at[:, 2] > NEAREST_M) & (u >= 0.0) & (u < view.width) & (v >= 0.0) & (v < view.height)
    rows = seen.nonzero()[:, 0]
    rays = points[rows] - eye
    along, drives = torch.full_like(rays[:, 0], math.inf), torch.zeros(len(rows), dtype=torch.bool, device=rays.device)
    for body, driving in zip(view.bodies, view.drives):
        cosine, sine, half = math.cos(body[3]), math.sin(body[3]), torch.as_tensor(0.5 * body[4:], device=rays.device)
        turn = torch.as_tensor(
            np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]), device=eye.device
        )
        start, step = turn @ (eye - torch.as_tensor(body[:3], device=eye.device)), rays @ turn.T
        sides = torch.stack([(-half - start) / step, (half - start) / step])
        enter, leave = sides.amin(0).amax(1), sides.amax(0).amin(1)
        first = (enter > 0.0) & (enter <= leave) & (enter < along)
        along, drives = torch.where(first, enter, along), torch.where(first, bool(driving), drives)
    before_m = torch.full_like(at[:, 2], math.nan)
    before_m[rows] = torch.where(drives, (along - 1.0) * rays.norm(dim=1), math.nan)
    return before_m, at[:, 2]


DEVICE_SIDE = (*SHAPES, "sky")
WIDTHS = (3, 4, 3, 1, 3)  # of SHAPES
OF_GAUSSIANS = ("road", "nearest", "wanted")
KEPT_BYTES = 4e9  # of photos on the device; 16 MB each at 1920 x 1080


@dataclass
class StateTensors:
    """`FitState`, of which the Gaussians and the sky lie on a device.

    What is learned of a Gaussian is one row there, so that all of it is gathered, stepped and moved at once.
    """

    iteration: int
    shapes: LearnedTensor  # SHAPES side by side
    world: dict[str, Any]  # sky: LearnedTensor; exposure, poses and boxes: AdamArray
    owner: ShortInts  # (N,) on the CPU
    road: Tensor
    nearest: Tensor
    wanted: Tensor
    averages: dict[str, Any]  # of the kinds of `learned`
    noted: int
    learned: dict[str, Any] = field(init=False)
    _surface: tuple[Road, Tensor] | None = None  # the road that was last asked for, and what `lay_flat` takes of it

    def __post_init__(self) -> None:
        self._hold(self.shapes)

    def _hold(self, shapes: LearnedTensor) -> None:
        """`learned` is `FitState`'s: of Gaussians these columns."""
        mine = {name: shapes.columns(end - n, end) for name, n, end in zip(SHAPES, WIDTHS, accumulate(WIDTHS))}
        self.shapes, self.learned = shapes, mine | self.world

    def step_gaussians(self, rows: Tensor, gradients: Gradients, rates: Mapping[str, float], depths: Tensor) -> None:
        """`FitState.step_gaussians`."""
        by = torch.cat([getattr(gradients, name).view(len(rows), -1) for name in SHAPES], dim=1)
        each = [rates[name] for name, width in zip(SHAPES, WIDTHS) for _ in range(width)]
        scale = torch.ones_like(by)
        scale[:, : WIDTHS[0]] = depths[:, None]
        self.shapes.step(rows, by, torch.tensor(each, dtype=torch.float64, device=by.device), scale)

    def record_view(self, rows: Tensor, depths: Tensor, screen: Tensor) -> Tensor:
        """`FitState.record_view`."""
        self.nearest[rows] = torch.minimum(self.nearest[rows], depths)
        self.wanted[rows] += torch.hypot(screen[:, 0], screen[:, 1])
        return self.nearest[rows]

    def lay_flat(self, rows: Tensor, road: Road) -> None:
        """`FitState.lay_flat`."""
        means, quats, log_scales = (self.learned[name].values for name in ("means", "quats", "log_scales"))
        if self._surface is None or self._surface[0] is not road:
            self._surface = road, torch.tensor(np.dstack([road.heights, road.slopes]), device=means.device)
        lay_flat(means, quats, log_scales, rows[self.road[rows]], self._surface[1], road.corner)

    def keep_round(self, rows: Tensor, background: float, boxes: float) -> None:
        """`FitState.keep_round`."""
        log_scales, owned = self.learned["log_scales"].values, rows >= int((self.owner == BACKGROUND).sum())
        for most, mine in ((background, rows[~owned & ~self.road[rows]]), (boxes, rows[owned])):
            if most > 0.0:
                log_scales[mine] = limit_stretch(log_scales[mine], most)

    def to_host(self, array: Tensor) -> Any:
        """`FitState.to_host`."""
        return array.cpu().numpy()

    def street_before_bodies(self, views: Sequence[BodyView], least_opacity: float) -> tuple[Ints, Array, F32, Array]:
        """`FitState.street_before_bodies`."""
        n = int(np.searchsorted(self.owner, BACKGROUND + 1))
        loose = ~self.road[:n] & (self.learned["logits"].values[:n, 0].sigmoid() > least_opacity)
        rows = loose.nonzero()[:, 0]
        means = self.learned["means"].values[rows].double()
        least_m = torch.full_like(means[:, 0], math.inf)
        for view in views:
            before_m, depth_m = distance_before_bodies(means, view)
            least_m = torch.where(before_m > BEFORE_M, torch.minimum(least_m, depth_m), least_m)
        found = least_m.isfinite()
        colours = self.learned["colours"].values[rows[found]]
        told = [tensor.cpu().numpy() for tensor in (rows[found], means[found], colours, least_m[found])]
        return told[0], told[1], told[2], told[3]

    def put_copies(self, copies: Copies) -> None:
        """`FitState.put_copies`."""
        named, targets, rows, order = (
            torch.as_tensor(of, device=self.road.device)
            for of in (copies.named, copies.targets, copies.rows, copies.order)
        )
        normals, logits, log_shrink = (
            torch.as_tensor(of, device=self.road.device) for of in (copies.normals, copies.logits, copies.log_shrink)
        )
        self.learned["logits"].values[named, 0] = logits
        self.learned["log_scales"].values[named] += log_shrink[:, None]
        self._keep_rows(rows)
        quats = self.learned["quats"].values[targets].double()
        axis, w = quats[:, 1:] / quats.norm(dim=1, keepdim=True), quats[:, :1] / quats.norm(dim=1, keepdim=True)
        local = normals * self.learned["log_scales"].values[targets].exp()
        across = 2.0 * torch.linalg.cross(axis, local)
        turned = local + w * across + torch.linalg.cross(axis, across)
        self.learned["means"].values[targets] += JITTER * turned.float()
        self.shapes.forget(torch.cat([named, targets]))
        self._keep_rows(order)
        self.owner = self.owner[copies.rows][copies.order]

    def _keep_rows(self, rows: Tensor) -> None:
        """`FitState.keep_rows`, but for the owners."""
        self._hold(self.shapes.take(rows))
        for name in OF_GAUSSIANS:
            setattr(self, name, getattr(self, name)[rows])


@dataclass(frozen=True)
class TorchBackend:
    """Draws with `draw`, on `device`."""

    draw: Draw
    device: str
    _photos: dict[int, tuple[FitPhoto, tuple[Tensor, Tensor, Tensor]]] = field(default_factory=dict)  # by their ids

    def __post_init__(self) -> None:
        # In this process: containers that set TORCH_ALLOW_TF32_CUBLAS_OVERRIDE multiply by ten bits, poses need more.
        torch.set_float32_matmul_precision("highest")

    def load(self, state: FitState) -> StateTensors:
        """A copy of it, on the device."""
        shapes = self._learned([state.learned[name] for name in SHAPES])
        world = {name: state.learned[name] for name in WORLD} | {"sky": self._learned([state.learned["sky"]])}
        averages = {name: self._sent(of) if name in DEVICE_SIDE else of for name, of in state.averages.items()}
        road, nearest, wanted = (self._sent(getattr(state, name)) for name in OF_GAUSSIANS)
        return StateTensors(state.iteration, shapes, world, state.owner, road, nearest, wanted, averages, state.noted)

    def store(self, held: StateTensors, state: FitState) -> None:
        """Exposure, poses and boxes never left."""
        state.iteration, state.noted, state.owner = held.iteration, held.noted, held.owner
        for name in DEVICE_SIDE:
            there = held.learned[name]
            values, first, second, steps = (held.to_host(getattr(there, each.name)) for each in fields(AdamArray))
            state.learned[name] = AdamArray(values, first, second, steps[:, 0].copy())
        state.averages = {name: held.to_host(of) if name in DEVICE_SIDE else of for name, of in held.averages.items()}
        for name in OF_GAUSSIANS:
            setattr(state, name, held.to_host(getattr(held, name)))

    def derivatives(self, problem: FitProblem, held: StateTensors, row: int, settings: FitSettings) -> Derivatives:
        """As `FitBackend` has it."""
        shot = problem.train[row]
        shapes, cells_of = (of.values.detach().requires_grad_() for of in (held.shapes, held.world["sky"]))
        exposure = self._sent(held.learned["exposure"].values[row]).requires_grad_()
        height, width = shot.photo.rgb.shape[:2]
        camera = corrected_pose(shot.photo.world_from_camera, held.learned["poses"].values[row])
        eye = Eye(shot.photo.intrinsics, camera, width, height, torch.zeros(6, device=self.device, requires_grad=True))
        parts = visible_parts(problem, held.owner, held.learned["boxes"].values, shot.photo)
        seen = self.draw(_compose_scene(shapes.split(WIDTHS, dim=1), parts), eye)

        rgb, cells = composite_sky(seen.rgb, seen.alpha, cells_of, eye.intrinsics, camera)
        light, weight, ground = self._photo(shot)
        picture, photo = apply_exposure(rgb, exposure), light.float() / 255.0
        loss = photo_loss(picture, photo, weight, settings.ssim_weight)
        if settings.opaque_weight > 0.0:
            loss = loss + opaque_loss(seen.alpha, ground, settings.opaque_weight)

        asked = [shapes, cells_of, exposure, eye.motion, seen.screen]
        d_shapes, sky, d_exposure, d_camera, screen = torch.autograd.grad(loss, asked, materialize_grads=True)
        spans = [torch.arange(span.start, span.stop, device=self.device) for span in map(_row_slice, parts)]
        rows = torch.cat(spans)[seen.index]
        moving = parts if held.iteration >= settings.pose_from else []  # before it no box is asked
        tracks, boxes = _box_gradients(moving, shapes.detach(), d_shapes)
        back: dict[str, Any] = dict(zip(SHAPES, d_shapes[rows].split(WIDTHS, dim=1)))
        back |= {"logits": back["logits"][:, 0], "index": rows, "screen": screen}
        back["camera"] = d_camera.double().cpu().numpy()
        error = torch.mean((picture.detach().clamp(0.0, 1.0) - photo).double() ** 2)
        score = float(-10.0 * torch.log10(error))
        shown = (cells, sky[cells], rows, Gradients(**back), seen.depths, tracks, boxes)
        return Derivatives(float(loss.detach()), score, d_exposure.cpu().numpy(), back["camera"], *shown)

    def _photo(self, shot: FitPhoto) -> tuple[Tensor, Tensor, Tensor]:
        """A photo, the weight of its pixels and which of them look at the ground; kept while there is room."""
        if id(shot) in self._photos:
            return self._photos[id(shot)][1]
        compared = shot.compared
        weight = compared.target.counted.astype(np.float32)
        sent = self._sent(shot.photo.rgb), self._sent(weight), self._sent(compared.ground)
        if sum(tensor.nbytes for _, kept in self._photos.values() for tensor in kept) < KEPT_BYTES:
            self._photos[id(shot)] = shot, sent
        return sent

    def release(self) -> None:
        """Photos leave the device, and what torch keeps of its memory is any process's again."""
        self._photos.clear()
        torch.cuda.empty_cache()

    def _learned(self, arrays: Sequence[AdamArray]) -> LearnedTensor:
        """Arrays of the same rows, side by side."""
        each = [(of.values, of.first, of.second, of.steps[:, None].repeat(of.values.shape[1], 1)) for of in arrays]
        return LearnedTensor(*(torch.cat([self._sent(part) for part in kind], dim=1) for kind in zip(*each)))

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


def _box_gradients(parts: Sequence[OwnedGaussians], shapes: Tensor, d_shapes: Tensor) -> tuple[Ints, F32]:
    """Tracks (B,), and derivatives (B, SHIFT_SIZE) by what their boxes are off by; the tensors are the state's."""
    mine, found = [part for part in parts if part.track is not None], []
    for part in mine:
        (means, quats), (d_means, d_quats) = (
            of[_row_slice(part), : sum(WIDTHS[:2])].double().split(WIDTHS[:2], dim=1) for of in (shapes, d_shapes)
        )
        shift, turn = box_gradient(part, means, quats, d_means, d_quats)
        found.append(torch.cat([shift, turn[None]]))
    together = torch.stack(found).float().cpu().numpy() if found else np.zeros((0, SHIFT_SIZE), np.float32)
    return np.array([part.track for part in mine], np.int64), together


def _row_slice(part: OwnedGaussians) -> slice:
    """Its rows of the state."""
    return slice(int(part.rows[0]), int(part.rows[-1]) + 1) if len(part.rows) else slice(0, 0)
