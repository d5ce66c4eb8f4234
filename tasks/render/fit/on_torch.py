"""The fit on a device of torch's: the state lies there, one photo an iteration goes there, and torch derives the loss.

Exposure, poses and boxes, a few numbers a photo, stay on the CPU, and so does density control: it is the same code and
the same draws, for which the state comes back. Sums on a GPU are added up in any order, so that no two fits are alike
to the last bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tasks.render.fit.adam import Learned
from tasks.render.fit.backend import Derivatives
from tasks.render.fit.composition import OwnedGaussians, by_box, parts_of
from tasks.render.fit.corrections import corrected
from tasks.render.fit.in_tensors import LearnedTensor, before_sky, exposed, lay_flat, opaque_loss, photo_loss, rounded
from tasks.render.fit.road import Road
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem
from tasks.render.fit.state import BACKGROUND, SHAPES, FitState
from tasks.render.scene.movers import SHIFT_SIZE
from tasks.render.splatting.gradient import Gradients
from tasks.render.splatting.tensors import Draw, Eye, SceneTensors, moved
from tasks.world.arrays import F32, Ints, ShortInts

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

    def seen(self, rows: Tensor, depths: Tensor, screen: Tensor) -> Tensor:
        """`FitState.seen`."""
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
                log_scales[mine] = rounded(log_scales[mine], most)


@dataclass(frozen=True)
class OnTorch:
    """Draws with `draw`, on `device`."""

    draw: Draw
    device: str

    def __post_init__(self) -> None:
        # In this process: containers that set TORCH_ALLOW_TF32_CUBLAS_OVERRIDE multiply by ten bits, poses need more.
        torch.set_float32_matmul_precision("highest")

    def take(self, state: FitState) -> StateTensors:
        """A copy of it, on the device."""
        learned: dict[str, Any] = dict(state.learned)
        for name in DEVICE_SIDE:
            here = state.learned[name]
            learned[name] = LearnedTensor(*(self._sent(getattr(here, each.name)) for each in fields(Learned)))
        others = (self._sent(array) for array in (state.road, state.nearest, state.wanted))
        return StateTensors(state.iteration, learned, state.owner, *others)

    def give_back(self, held: StateTensors, state: FitState) -> None:
        """Exposure, poses and boxes never left."""
        state.iteration = held.iteration
        for name in DEVICE_SIDE:
            there = held.learned[name]
            state.learned[name] = Learned(*(getattr(there, each.name).cpu().numpy() for each in fields(Learned)))
        state.nearest, state.wanted = held.nearest.cpu().numpy(), held.wanted.cpu().numpy()

    def derivatives(self, problem: Problem, held: StateTensors, row: int, settings: FitSettings) -> Derivatives:
        """As `FitBackend` has it."""
        shot = problem.train[row]
        compared = shot.compared
        leaves = [held.learned[name].values.detach().requires_grad_() for name in DEVICE_SIDE]
        exposure = self._sent(held.learned["exposure"].values[row]).requires_grad_()
        height, width = shot.photo.rgb.shape[:2]
        camera = corrected(shot.photo.world_from_camera, held.learned["poses"].values[row])
        eye = Eye(shot.photo.intrinsics, camera, width, height, torch.zeros(6, device=self.device, requires_grad=True))
        parts = parts_of(problem, held.owner, held.learned["boxes"].values, shot.photo)
        seen = self.draw(_composed(leaves[:-1], parts), eye)

        rgb, cells = before_sky(seen.rgb, seen.alpha, leaves[-1], eye.intrinsics, camera)
        picture, photo = exposed(rgb, exposure), self._sent(shot.photo.rgb).float() / 255.0
        loss = photo_loss(picture, photo, self._sent(compared.target.weight), settings.ssim_weight)
        if settings.opaque_weight > 0.0:
            loss = loss + opaque_loss(seen.alpha, self._sent(compared.ground), settings.opaque_weight)

        asked = [*leaves, exposure, eye.motion, seen.screen]
        by = torch.autograd.grad(loss, asked, materialize_grads=True)
        means, quats, log_scales, logits, colours, sh_rest, sky, d_exposure, d_camera, screen = by
        spans = [torch.arange(span.start, span.stop, device=self.device) for span in map(_span, parts)]
        rows = torch.cat(spans)[seen.index]
        tracks, boxes = _of_boxes(parts, leaves[0].detach(), leaves[1].detach(), means, quats)
        shapes = {"means": means, "quats": quats, "log_scales": log_scales, "logits": logits[:, 0], "colours": colours}
        back: dict[str, Any] = {name: tensor[rows] for name, tensor in shapes.items()}
        back |= {"index": rows, "sh_rest": sh_rest[rows].view(len(rows), -1, 3), "screen": screen}
        back["camera"] = d_camera.double().cpu().numpy()
        error = torch.mean((picture.detach().clamp(0.0, 1.0) - photo).double() ** 2)
        score = float(-10.0 * torch.log10(error))
        shown = (cells, sky[cells], rows, Gradients(**back), seen.depths, tracks, boxes)
        return Derivatives(float(loss.detach()), score, d_exposure.cpu().numpy(), back["camera"], *shown)

    def _sent(self, array: object) -> Tensor:
        return torch.as_tensor(array, device=self.device).clone()


def _composed(leaves: Sequence[Tensor], parts: Sequence[OwnedGaussians]) -> SceneTensors:
    """The scene of `parts`, of which a photo shows some; `leaves` as of SHAPES."""
    means, quats, log_scales, logits, colours, sh_rest = leaves
    every = SceneTensors(means, quats, log_scales, logits[:, 0], colours, sh_rest.view(len(means), -1, 3))
    scenes = []
    for part in parts:
        mine = SceneTensors(*(tensor[_span(part)] for tensor in every.parts()))
        scenes.append(mine if part.scene_from_owner is None else moved(mine, part.scene_from_owner))
    return SceneTensors(*(torch.cat(tensors) for tensors in zip(*(scene.parts() for scene in scenes))))


def _of_boxes(
    parts: Sequence[OwnedGaussians], means: Tensor, quats: Tensor, d_means: Tensor, d_quats: Tensor
) -> tuple[Ints, F32]:
    """Tracks (B,), and derivatives (B, SHIFT_SIZE) by what their boxes are off by; the tensors are the state's."""
    mine = [part for part in parts if part.track is not None]
    found = [
        torch.cat([shift, turn[None]])
        for part in mine
        for shift, turn in [by_box(part, *(one[_span(part)].double() for one in (means, quats, d_means, d_quats)))]
    ]
    together = torch.stack(found).float().cpu().numpy() if found else np.zeros((0, SHIFT_SIZE), np.float32)
    return np.array([part.track for part in mine], np.int64), together


def _span(part: OwnedGaussians) -> slice:
    """Its rows of the state."""
    return slice(int(part.rows[0]), int(part.rows[-1]) + 1) if len(part.rows) else slice(0, 0)
