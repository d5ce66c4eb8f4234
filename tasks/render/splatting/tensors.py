"""A scene as tensors, drawn by gsplat on CUDA so that torch knows the derivatives.

It takes what is learned (log-scales, logits), keeps to one camera, and leaves the background to whoever calls. Nothing
but render.backend=gsplat loads it, `tasks.render.fit.on_torch` and `tasks.render.scene.on_device`, and torch with them.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tasks.render.splatting.gaussians import quats_of
from tasks.render.splatting.gsplat_backend import plain_arguments
from tasks.world.arrays import Array


@dataclass(frozen=True)
class SceneTensors:
    """N Gaussians in one frame, as they are learned."""

    means: Tensor  # (N, 3) [m]
    quats: Tensor  # (N, 4) w, x, y, z of any length
    log_scales: Tensor  # (N, 3)
    logits: Tensor  # (N,)
    colours: Tensor  # (N, 3)

    def parts(self) -> list[Tensor]:
        """The tensors, in this order."""
        return [getattr(self, each.name) for each in fields(self)]


@dataclass(frozen=True)
class Eye:
    """A pinhole that looks at a scene."""

    intrinsics: Array  # (3, 3) [px]
    scene_from_camera: Array  # (4, 4)
    width: int
    height: int
    motion: Tensor  # (6,) zeros that are derived by: x' = x + v + w cross x in camera coordinates


@dataclass(frozen=True)
class Splatted:
    """What an eye sees of the scene alone, black where nothing is."""

    rgb: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) [m] mean by weight; 0 where nothing is
    alpha: Tensor  # (H, W)
    index: Tensor  # (M,) rows in the scene, ascending, that are in view
    depths: Tensor  # (M,) [m] of those
    screen: Tensor  # (M, 2) to be derived by: their places on the picture [px]


Draw = Callable[[SceneTensors, Eye], Splatted]


def moved(scene: SceneTensors, target_from_source: Array) -> SceneTensors:
    """As `gaussians.moved`."""
    rotation, like = target_from_source[:3, :3], scene.means
    means = scene.means @ _tensor(rotation.T, like) + _tensor(target_from_source[:3, 3], like)
    quats = hamilton(_tensor(quats_of(rotation[None]), like), scene.quats)
    return SceneTensors(means, quats, scene.log_scales, scene.logits, scene.colours)


def hamilton(left: Tensor, right: Tensor) -> Tensor:
    """Products left * right (N, 4) of quaternions w, x, y, z: who is turned by `right` and then by `left`."""
    lw, lx, ly, lz = left.unbind(1)
    rw, rx, ry, rz = right.unbind(1)
    return torch.stack(
        [
            lw * rw - lx * rx - ly * ry - lz * rz,
            lw * rx + lx * rw + ly * rz - lz * ry,
            lw * ry - lx * rz + ly * rw + lz * rx,
            lw * rz + lx * ry - ly * rx + lz * rw,
        ],
        dim=1,
    )


def _tensor(array: Any, like: Tensor) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=like.dtype, device=like.device)


def by_gsplat(scene: SceneTensors, eye: Eye) -> Splatted:
    """On the device that the scene lies on. gsplat compiles its CUDA sources at the first call, once per machine."""
    import gsplat

    return splatted(gsplat.rasterization, scene, eye)


def splatted(rasterization: Callable[..., Any], scene: SceneTensors, eye: Eye) -> Splatted:
    """By `gsplat.rasterization`, or by what stands for it."""
    drawn, alpha, meta = rasterization(**learned_arguments(scene, eye))
    index, screen, depths = meta["gaussian_ids"], meta["means2d"], meta["depths"]
    covered = alpha[0, ..., 0]
    depth = torch.where(covered > 0.0, drawn[0, ..., 3], 0.0)
    return Splatted(drawn[0, ..., :3], depth, covered, index, depths.detach(), screen)


def learned_arguments(scene: SceneTensors, eye: Eye) -> dict[str, Any]:
    """What `gsplat.rasterization` is called with for one eye: as `gsplat_backend.arguments`, but to be derived by."""
    like = scene.means
    still = _tensor(np.linalg.inv(eye.scene_from_camera), like)
    zero = torch.zeros((), dtype=like.dtype, device=like.device)
    shift, (a, b, c) = eye.motion[:3], eye.motion[3:]
    turn = torch.stack([torch.stack(row) for row in ((zero, -c, b), (c, zero, -a), (-b, a, zero))])
    change = torch.cat([torch.cat([turn, shift[:, None]], dim=1), torch.zeros_like(still[:1])])
    return {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.log_scales.exp(),
        "opacities": scene.logits.sigmoid(),
        "colors": scene.colours.clamp(min=0.0),  # as the kernels do
        "viewmats": (still + change @ still)[None],
        "Ks": _tensor(eye.intrinsics, like)[None],
    } | plain_arguments(eye.width, eye.height, 0)
