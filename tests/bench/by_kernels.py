"""The loop over tensors without a GPU: this package's kernels as a function that torch can derive."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gradient import backward
from tasks.render.splatting.project import DEPTH, NEAR_M, ScreenFilter
from tasks.render.splatting.raster import ForwardPass, forward
from tasks.render.splatting.tensors import Eye, SceneTensors, Splatted


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
        n, rows = len(ctx.gaussians), (by.means, by.quats, by.log_scales, by.logits, by.colours)
        whole = [np.zeros((n, *part.shape[1:]), np.float32) for part in rows]
        for everyone, part in zip(whole, rows):
            everyone[by.index] = part
        tensors = [torch.from_numpy(part) for part in (*whole, by.camera.astype(np.float32), by.screen)]
        return None, None, None, *tensors


def instant_by_instant(one: Callable[..., Any]) -> Callable[..., Any]:
    """A rasterisation of one scene, of several (F, N, ...) as well, as gsplat's is; the last entry is the first's."""

    @wraps(one)
    def of_any(**given: Any) -> Any:
        if given["means"].dim() == 2:
            return one(**given)
        tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}
        each = [one(**given | {name: v[f] for name, v in tensors.items()}) for f in range(len(given["means"]))]
        drawn, alpha, meta = zip(*each)
        return torch.stack(drawn), torch.stack(alpha), meta[0]

    return of_any


@instant_by_instant
def rasterization(**given: Any) -> tuple[Tensor, Tensor, None]:
    """What stands for `gsplat.rasterization` on the CPU: its arguments drawn by `raster.forward`."""
    assert given["near_plane"] == NEAR_M and given["render_mode"] == "RGB+ED"
    colours, rest = given["colors"], torch.zeros(len(given["means"]), 0, 3)
    if given["sh_degree"] is not None:
        colours, rest = colours[:, 0] * sh.C0 + 0.5, colours[:, 1:]
    shapes = given["means"], given["quats"], given["scales"].log(), given["opacities"]
    scene = Gaussians(*(part.numpy() for part in (*shapes, colours, rest)))
    screen = ScreenFilter(given["eps2d"], given["rasterize_mode"] == "antialiased")
    size, black = (given["width"], given["height"]), np.zeros(3, np.float32)
    eyes = zip(given["Ks"].double().numpy(), torch.inverse(given["viewmats"].double()).numpy())
    seen = [forward(scene, k, pose, *size, black, 1, screen).view for k, pose in eyes]
    drawn = torch.from_numpy(np.stack([np.dstack([view.rgb, view.depth]) for view in seen]))
    return drawn, torch.from_numpy(np.stack([view.alpha for view in seen]))[..., None], None
