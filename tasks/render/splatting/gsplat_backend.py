"""The CUDA backend: the same Gaussians through `gsplat.rasterization` (gsplat 1.5.3), all cameras of a size at once.

Its conventions are those of the CPU rasteriser: quaternions w first, world-to-camera matrices with z forward, the
centre of pixel (0, 0) at (0.5, 0.5), contributions cut off at 1/255 and capped at 0.999 (later versions cap at 0.99).
What differs is passed on (near plane, the screen's filter) or below 8 bits (no more than 1e-4 of the light is dropped
instead of 1e-3). Pictures and derivatives are held against gsplat's own reference by tests.bench.peer_gsplat.
torch and gsplat are loaded by the first call, nowhere else; gsplat compiles its CUDA sources then, once per machine.
"""

import importlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import FITTED, NEAR_M, ScreenFilter
from tasks.render.splatting.raster import View
from tasks.world.arrays import F32
from tasks.world.clip import Pinhole

HOW_TO_FIX = 'pip install "driving-data-factory[gpu]", in a checkout -e ".[gpu]", or draw with render.backend=cpu'


class BackendMissing(RuntimeError):
    """This machine lacks what the backend needs."""


def require() -> tuple[Any, Any]:
    """The modules torch and gsplat. Raises BackendMissing where one is absent or there is no CUDA device."""
    found = []
    for name in ("torch", "gsplat"):
        try:
            found.append(importlib.import_module(name))
        except ImportError as error:
            raise BackendMissing(f"render.backend=gsplat needs torch and gsplat ({error}): {HOW_TO_FIX}") from error
    torch, gsplat = found
    if not torch.cuda.is_available():
        raise BackendMissing(
            f"render.backend=gsplat needs a CUDA device; torch {torch.__version__} sees none: "
            "run where there is one, or draw with render.backend=cpu"
        )
    return torch, gsplat


def arguments(
    scene: Gaussians, cameras: Sequence[Pinhole], screen: ScreenFilter = FITTED, packed: bool = True
) -> dict[str, Any]:
    """What `gsplat.rasterization` is called with: arrays float32 by its names, and plain settings.

    means (N, 3), quats (N, 4), scales (N, 3), opacities (N,), colors (N, 3) or, with sh_degree, coefficients (N, K, 3),
    viewmats (C, 4, 4) camera from scene, Ks (C, 3, 3). All cameras are of one size.
    """
    count = scene.sh_rest.shape[1]
    colours = np.maximum(scene.colours, 0.0)  # as the kernels do; gsplat does it for higher degrees alone
    if count:
        base = (scene.colours - 0.5) / sh.C0  # gsplat adds the half again
        colours = np.concatenate([base[:, None], scene.sh_rest], axis=1)
    arrays = {
        "means": scene.means,
        "quats": scene.quats,
        "scales": np.exp(scene.log_scales),
        "opacities": scene.opacities,
        "colors": colours,
        "viewmats": np.stack([np.linalg.inv(camera.world_from_camera) for camera in cameras]),
        "Ks": np.stack([camera.intrinsics for camera in cameras]),
    }
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
    return arrays | plain_arguments(cameras[0].width, cameras[0].height, count, screen, packed)


def plain_arguments(
    width: int, height: int, count: int, screen: ScreenFilter = FITTED, packed: bool = True
) -> dict[str, Any]:
    """The arguments that are no arrays; `count` of the coefficients beyond degree 0."""
    return {
        "width": width,
        "height": height,
        "near_plane": NEAR_M,
        "eps2d": screen.dilation_px2,
        "rasterize_mode": "antialiased" if screen.keeps_light else "classic",
        "sh_degree": sh.COUNTS.index(count) or None,
        "render_mode": "RGB+ED",  # the last channel is the depth, a mean by weight
        "packed": packed,  # memory follows what is seen, not cameras x Gaussians
    }


def view_of(colours_and_depth: F32, alpha: F32) -> View:
    """One camera's (H, W, 4) and (H, W, 1), before black."""
    rgb, covered = (np.ascontiguousarray(of, np.float32) for of in (colours_and_depth[..., :3], alpha[..., 0]))
    return View(rgb, np.where(covered > 0.0, colours_and_depth[..., 3], np.float32(0.0)), covered)


def rasterize_all(
    scene: Gaussians,
    cameras: Sequence[Pinhole],
    screen: ScreenFilter = FITTED,
    packed: bool = True,
) -> list[View]:
    """What `tasks.render.scene.engine.render` draws with on CUDA: one view a camera. Raises BackendMissing."""
    torch, gsplat = require()

    def draw(given: dict[str, Any]) -> tuple[F32, F32]:
        on_device = {k: torch.from_numpy(v).cuda() if isinstance(v, np.ndarray) else v for k, v in given.items()}
        with torch.inference_mode():
            drawn, covered, _ = gsplat.rasterization(**on_device)
        return drawn.cpu().numpy(), covered.cpu().numpy()

    return drawn_by(draw, scene, cameras, screen, packed)


def drawn_by(
    draw: Callable[[dict[str, Any]], tuple[F32, F32]],
    scene: Gaussians,
    cameras: Sequence[Pinhole],
    screen: ScreenFilter = FITTED,
    packed: bool = True,
) -> list[View]:
    """One view a camera, all of a size at once; `draw` takes `arguments` and gives (C, H, W, 4) and (C, H, W, 1)."""
    by_size: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, camera in enumerate(cameras):
        by_size[camera.width, camera.height].append(i)
    views: dict[int, View] = {}
    for (width, height), rows in by_size.items():
        pictures = np.zeros((len(rows), height, width, 4), np.float32)
        alphas = np.zeros((len(rows), height, width, 1), np.float32)
        if len(scene):
            pictures, alphas = draw(arguments(scene, [cameras[i] for i in rows], screen, packed))
        for i, picture, alpha in zip(rows, pictures, alphas):
            views[i] = view_of(picture, alpha)
    return [views[i] for i in range(len(cameras))]
