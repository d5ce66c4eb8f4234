"""A scene as tensors, drawn so that torch knows the derivatives: by gsplat on CUDA, or by this package's kernels.

Both take what is learned (log-scales, logits), keep to one camera, and leave the background to whoever calls. torch is
imported here and in `tasks.render.fit.on_torch` alone; nothing but render.backend=gsplat loads either.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, quats_of
from tasks.render.splatting.gradient import backward
from tasks.render.splatting.gsplat_backend import plain_arguments
from tasks.render.splatting.project import DEPTH
from tasks.render.splatting.raster import ForwardPass, forward
from tasks.world.arrays import Array


@dataclass(frozen=True)
class SceneTensors:
    """N Gaussians in one frame, as they are learned."""

    means: Tensor  # (N, 3) [m]
    quats: Tensor  # (N, 4) w, x, y, z of any length
    log_scales: Tensor  # (N, 3)
    logits: Tensor  # (N,)
    colours: Tensor  # (N, 3)
    sh_rest: Tensor  # (N, count, 3)

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
    w, x, y, z = quats_of(rotation[None])[0]
    product = _tensor(np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]), like)
    means = scene.means @ _tensor(rotation.T, like) + _tensor(target_from_source[:3, 3], like)
    turn = _tensor(sh.turning(rotation, scene.sh_rest.shape[1]), like)
    sh_rest = torch.einsum("ab,nbc->nac", turn, scene.sh_rest)
    return SceneTensors(means, scene.quats @ product.T, scene.log_scales, scene.logits, scene.colours, sh_rest)


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
    count, like = scene.sh_rest.shape[1], scene.means
    colours = scene.colours.clamp(min=0.0)  # as the kernels do; gsplat does it for higher degrees alone
    if count:
        colours = torch.cat([((scene.colours - 0.5) / sh.C0)[:, None], scene.sh_rest], dim=1)
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
        "colors": colours,
        "viewmats": (still + change @ still)[None],
        "Ks": _tensor(eye.intrinsics, like)[None],
    } | plain_arguments(eye.width, eye.height, count)


def by_kernels(scene: SceneTensors, eye: Eye, threads: int = 1) -> Splatted:
    """On the CPU, by `raster.forward` and `gradient.backward`: the loop over tensors without a GPU."""
    arrays = [part.detach().numpy() for part in scene.parts()]
    arrays[3] = scene.logits.detach().sigmoid().numpy()
    gaussians = Gaussians(*arrays)
    nothing = np.zeros(3, np.float32)
    seen = forward(gaussians, eye.intrinsics, eye.scene_from_camera, eye.width, eye.height, nothing, threads)
    index = torch.from_numpy(seen.splats.index)
    screen = torch.zeros(len(index), 2, requires_grad=True)
    rgb, depth, alpha = _Blended.apply(seen, gaussians, threads, *scene.parts(), eye.motion, screen)
    return Splatted(rgb, depth, alpha, index, torch.from_numpy(seen.splats.projected[:, DEPTH].copy()), screen)


class _Blended(torch.autograd.Function):
    """A traced view, whose derivatives are those of the kernels."""

    @staticmethod
    def forward(ctx: Any, seen: ForwardPass, gaussians: Gaussians, threads: int, *inputs: Tensor) -> Any:
        ctx.seen, ctx.gaussians, ctx.threads = seen, gaussians, threads
        return tuple(torch.from_numpy(picture) for picture in (seen.view.rgb, seen.view.depth, seen.view.alpha))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Any:
        d_rgb, d_depth, d_alpha = (up.numpy() for up in upstream)
        by = backward(ctx.seen, ctx.gaussians, d_rgb, d_depth, d_alpha, ctx.threads)
        n, rows = len(ctx.gaussians), (by.means, by.quats, by.log_scales, by.logits, by.colours, by.sh_rest)
        whole = [np.zeros((n, *part.shape[1:]), np.float32) for part in rows]
        for everyone, part in zip(whole, rows):
            everyone[by.index] = part
        tensors = [torch.from_numpy(part) for part in (*whole, by.camera.astype(np.float32), by.screen)]
        return None, None, None, *tensors
