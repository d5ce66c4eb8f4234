"""gsplat beside our rasteriser, without a GPU: its projection, colours and compositing run in torch as it ships them.

Its compositing asks nerfacc for two sums and its CUDA part for a list of what meets what: both are written out here,
the latter by the rules of its kernel (RasterizeToPixels3DGSFwd.cu of gsplat 1.5.3).

    python -m tests.bench.peer_gsplat                compares, and prints the table of docs/gpu.md
    python -m tests.bench.peer_gsplat <file.npz>     writes what gsplat says, for tests where it is not installed

Needs gsplat 1.5.3: `pip install gsplat==1.5.3` (pure Python; nothing of it is compiled here).
"""

import importlib
import inspect
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tasks.render.scene.on_device import Device, gaussians_on, rasterized, repeated
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import FITTED
from tasks.render.splatting.raster import View, forward
from tasks.render.splatting.tensors import Draw, Eye, SceneTensors, splatted
from tasks.world.clip import Pinhole
from tests.bench.by_kernels import by_kernels, instant_by_instant

WIDTH, HEIGHT = 33, 25  # no multiples of a tile
FAINTEST, MOST_OPAQUE, DARK = 1.0 / 255.0, 0.999, 1e-4  # of its kernel: skipped below, capped at, and nothing behind
LEARNED = ("means", "quats", "log_scales", "logits", "colours")
CENTRED = ((28.0, 0.0, 16.5), (0.0, 29.0, 12.5), (0.0, 0.0, 1.0))
ASIDE = ((28.0, 0.0, 6.0), (0.0, 29.0, 20.5), (0.0, 0.0, 1.0))
Arrays = dict[str, NDArray[Any]]


@instant_by_instant
def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    rasterize_mode: str,
    sh_degree: int | None,
    packed: bool,
    render_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """`gsplat.rasterization` from its own parts, on the CPU and of any precision; the last entry for one camera.

    Camera after camera: whether they are `packed` is a matter of memory on a device.
    """
    assert render_mode == "RGB+ED"
    scene = (means, quats, scales, opacities, colors)
    how = (width, height, near_plane, eps2d, rasterize_mode == "antialiased", sh_degree)
    drawn, alpha, meta = zip(*(_seen_by(scene, viewmats[c : c + 1], Ks[c : c + 1], *how) for c in range(len(Ks))))
    return torch.cat(drawn), torch.cat(alpha), meta[0]


def _seen_by(
    scene: tuple[Tensor, ...],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    antialiased: bool,
    sh_degree: int | None,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    means, quats, scales, opacities, colors = scene
    twin = importlib.import_module("gsplat.cuda._torch_impl")
    covariances, _ = twin._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, left = twin._fully_fused_projection(
        means, covariances, viewmats, Ks, width, height, eps2d, near_plane, calc_compensations=antialiased
    )
    if antialiased:
        opacities = opacities * left[0]
    index = ((radii[0] > 0).all(dim=1) & (opacities >= FAINTEST)).nonzero()[:, 0]
    centres, conics, depths, opacities = means2d[0, index], conics[0, index], depths[0, index], opacities[index]
    if sh_degree is None:
        seen = colors[index]
    else:
        directions = means[index] - torch.inverse(viewmats)[0, :3, 3]
        seen = (twin._spherical_harmonics(sh_degree, directions, colors[index]) + 0.5).clamp(min=0.0)
    seen = torch.cat([seen, depths[:, None]], dim=1)
    gaussian_ids, pixel_ids = _met(centres, conics, depths, opacities, width, height)
    given = (centres[None], conics[None], opacities[None], seen[None])
    with _nerfacc():
        drawn, alpha = twin.accumulate(*given, gaussian_ids, pixel_ids, torch.zeros_like(pixel_ids), width, height)
    drawn = torch.cat([drawn[..., :-1], drawn[..., -1:] / alpha.clamp(min=1e-10)], dim=-1)
    return drawn, alpha, {"gaussian_ids": index, "means2d": centres, "depths": depths}


@torch.no_grad()
def _met(
    centres: Tensor, conics: Tensor, depths: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Gaussians and pixels that are blended, pixel by pixel, nearest first."""
    order = torch.argsort(depths, stable=True)
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    du, dv = (p.reshape(1, -1) - centres[order, k, None] for k, p in ((0, u), (1, v)))
    a, b, c = (conics[order, k, None] for k in range(3))
    sigma = 0.5 * (a * du * du + c * dv * dv) + b * du * dv
    alpha = (opacities[order, None] * torch.exp(-sigma)).clamp(max=MOST_OPAQUE)
    alpha = torch.where((sigma >= 0.0) & (alpha >= FAINTEST), alpha, 0.0)
    light = torch.cumprod(1.0 - alpha, dim=0)
    pixel_ids, ranks = ((alpha > 0.0) & (light > DARK)).T.nonzero(as_tuple=True)
    return order[ranks], pixel_ids


@contextmanager
def _nerfacc() -> Iterator[None]:
    """The two functions that gsplat's compositing imports, by their definition; samples of a ray lie side by side."""

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        passed = torch.cumsum(torch.log1p(-alphas), dim=0) - torch.log1p(-alphas)
        first = torch.searchsorted(ray_indices, torch.arange(n_rays))[ray_indices]
        light = torch.exp(passed - passed[first])
        return alphas * light, light

    def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
        rows = weights[:, None] if values is None else weights[:, None] * values
        return torch.zeros(n_rays, rows.shape[1], dtype=rows.dtype).index_add(0, ray_indices, rows)

    stand_in = ModuleType("nerfacc")
    stand_in.__dict__.update(vars(SimpleNamespace(**locals())))
    before = sys.modules.get("nerfacc")
    sys.modules["nerfacc"] = stand_in
    yield
    del sys.modules["nerfacc"]
    if before is not None:
        sys.modules["nerfacc"] = before


def cloud(seed: int, n: int, count: int, least: float, most: float, opaque: float) -> Gaussians:
    """n Gaussians before the camera and beside the picture, colours from `least` to `most`."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 12.0, n)
    means = np.stack([rng.uniform(-1.2, 1.2, n) * depth, rng.uniform(-0.9, 0.9, n) * depth, depth], 1)
    return Gaussians(
        means.astype(np.float32),
        (rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, (n, 1))).astype(np.float32),  # of any length
        np.log(rng.uniform(0.05, 0.6, (n, 3))).astype(np.float32),
        rng.uniform(0.05, opaque, n).astype(np.float32),
        rng.uniform(least, most, (n, 3)).astype(np.float32),
        rng.normal(0.0, 0.1, (n, count, 3)).astype(np.float32),
    )


SCENES = {  # what is looked at, and by which camera
    "translucent": (cloud(0, 70, 0, 0.1, 1.0, 0.6), CENTRED),
    "colours below zero": (cloud(1, 70, 0, -0.5, 0.8, 0.6), CENTRED),
    "degree 1": (cloud(2, 70, 3, 0.1, 1.0, 0.6), CENTRED),
    "degree 3": (cloud(3, 70, 15, 0.0, 1.0, 0.6), CENTRED),
    "principal point aside": (cloud(4, 70, 3, 0.1, 1.0, 0.6), ASIDE),
    "nearly opaque": (cloud(5, 120, 0, 0.1, 1.0, 1.0), CENTRED),
    "a wall, others behind it": (cloud(6, 600, 0, 0.1, 1.0, 1.0), CENTRED),
}


def pose() -> NDArray[np.float64]:
    """(4, 4) scene from camera: turned and shifted."""
    out = np.eye(4)
    for axis, angle in enumerate((0.05, -0.1, 0.2)):
        across = [(axis + 1) % 3, (axis + 2) % 3]
        turn = np.eye(3)
        turn[np.ix_(across, across)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        out[:3, :3] = out[:3, :3] @ turn
    out[:3, 3] = 0.2, -0.1, -0.4
    return out


def answers(draw: Draw, scene: Gaussians, intrinsics: Any, dtype: torch.dtype, device: str = "cpu") -> Arrays:
    """Pictures, and the derivatives of one scalar of them by all that is learned, by the camera and by the places."""
    logits = torch.logit(torch.tensor(scene.opacities, dtype=torch.float64))
    arrays = (scene.means, scene.quats, scene.log_scales, logits, scene.colours)
    leaves = [torch.as_tensor(array).to(device, dtype).clone().requires_grad_() for array in arrays]
    motion = torch.zeros(6, dtype=dtype, device=device, requires_grad=True)
    seen = draw(SceneTensors(*leaves), Eye(np.array(intrinsics), pose(), WIDTH, HEIGHT, motion))
    v, u = np.mgrid[:HEIGHT, :WIDTH] / 10.0  # a smooth upstream: derivatives are not of single pixels
    ups = [np.sin(u + k) * np.cos(v - 2 * k) for k in range(5)]
    pictures = [*seen.rgb.unbind(-1), seen.depth * (seen.alpha.detach() > 0.05), seen.alpha]
    total = sum((torch.as_tensor(up).to(device, dtype) * picture).sum() for up, picture in zip(ups, pictures))
    by = torch.autograd.grad(total, [*leaves, motion, seen.screen], materialize_grads=True)
    out = {"rgb": seen.rgb, "depth": seen.depth, "alpha": seen.alpha, "index": seen.index}
    out |= dict(zip((*(f"d {name}" for name in LEARNED), "d camera", "d screen"), by))
    return {name: tensor.detach().cpu().numpy() for name, tensor in out.items()}


def drawn_on(device: Device, scene: Gaussians, intrinsics: Any) -> View:
    """What a device makes of a scene, before black."""
    eye = Pinhole(np.array(intrinsics), pose(), WIDTH, HEIGHT)
    found = rasterized(device, repeated(gaussians_on(device, scene), 1), [[eye]], FITTED)
    return View(*(device.fetch(picture[0]) for picture in found))


def pictures_of(view: View, index: NDArray[Any]) -> Arrays:
    """As of `answers`, without derivatives."""
    return {"rgb": view.rgb, "depth": view.depth, "alpha": view.alpha, "index": index}


def of_gsplat(scene: Gaussians, intrinsics: Any) -> Arrays:
    """What gsplat says, in float64; pictures alone where light depends on the side, which no fit learns."""
    if scene.sh_rest.shape[1]:
        index: list[NDArray[Any]] = []

        def exact(**given: Any) -> Any:
            drawn = rasterization(**{k: v.double() if isinstance(v, Tensor) else v for k, v in given.items()})
            index.append(drawn[-1]["gaussian_ids"].numpy())
            return drawn

        view = drawn_on(Device("cpu", exact), scene, intrinsics)
        return pictures_of(view, index[0])
    return answers(lambda tensors, eye: splatted(rasterization, tensors, eye), scene, intrinsics, torch.float64)


def of_kernels(scene: Gaussians, intrinsics: Any) -> Arrays:
    """What this package's kernels say, in float32."""
    if scene.sh_rest.shape[1]:
        seen = forward(scene, np.array(intrinsics), pose(), WIDTH, HEIGHT, np.zeros(3, np.float32))
        return pictures_of(seen.view, seen.splats.index)
    return answers(by_kernels, scene, intrinsics, torch.float32)


def read(path: Path, name: str) -> tuple[Gaussians, NDArray[np.float64], Arrays]:
    """A scene of the file that `written` made, its camera, and what gsplat said."""
    with np.load(path) as file:
        whole = {what.removeprefix(f"{name}/"): file[what] for what in file.files if what.startswith(f"{name}/")}
    scene = Gaussians(**{each.name: whole.pop(each.name) for each in fields(Gaussians)})
    return scene, whole.pop("intrinsics"), whole


def apart(ours: Arrays, theirs: Arrays) -> dict[str, float]:
    """By how much of its length each array differs. What is in view is told by the Gaussians: one that reaches no pixel
    is in one list and not in the other, and has no derivatives."""
    out = {}
    for name, expected in theirs.items():
        if name == "index" or name not in ours:
            continue
        found = ours[name]
        if name == "d screen":
            expected, found = (_spread(arrays) for arrays in (theirs, ours))
        out[name] = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    return out


def _spread(arrays: Arrays) -> NDArray[Any]:
    whole = np.zeros((len(arrays["d means"]), 2))
    whole[arrays["index"]] = arrays["d screen"]
    return whole


def written(path: Path) -> None:
    """What gsplat says of all scenes, and its signature, into a file; float32, which is finer than the comparison."""
    gsplat = importlib.import_module("gsplat")
    out: Arrays = {"version": np.array(gsplat.__version__), "signature": np.array(signature(gsplat.rasterization))}
    for name, (scene, intrinsics) in SCENES.items():
        out |= {f"{name}/{each.name}": getattr(scene, each.name) for each in fields(Gaussians)}
        out[f"{name}/intrinsics"] = np.array(intrinsics)
        for what, array in of_gsplat(scene, intrinsics).items():
            out[f"{name}/{what}"] = array.astype(np.int32 if what == "index" else np.float32)
    np.savez_compressed(path, **out)


def signature(rasterization: Any) -> list[str]:
    """Its arguments, "name=default" where there is one."""
    return [
        name if each.default is inspect.Parameter.empty else f"{name}={each.default!r}"
        for name, each in inspect.signature(rasterization).parameters.items()
    ]


def main() -> None:
    if len(sys.argv) > 1:
        written(Path(sys.argv[1]))
        return
    names: list[str] = []
    for name, (scene, intrinsics) in SCENES.items():
        found = apart(of_kernels(scene, intrinsics), of_gsplat(scene, intrinsics))
        if not names:
            names = [*found]
            print("| scene | " + " | ".join(names) + " |\n" + "|---" * (len(names) + 1) + "|")
        print(f"| {name} | " + " | ".join(f"{found[what]:.0e}" if what in found else "" for what in names) + " |")


if __name__ == "__main__":
    main()
