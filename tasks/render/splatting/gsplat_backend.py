"""gsplat (1.5.3) and torch: whether they are here, and what both drawing and fitting tell `gsplat.rasterization`.

They are loaded by the first call, nowhere else; gsplat compiles its CUDA sources then, once per machine.
"""

import importlib
from typing import Any

from tasks.render.splatting import sh
from tasks.render.splatting.project import FITTED, NEAR_M, ScreenFilter

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
