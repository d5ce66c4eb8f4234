"""gsplat (1.5.3) and torch: whether they are here, and what both drawing and fitting tell `gsplat.rasterization`.

They are loaded by the first call, nowhere else; gsplat compiles its CUDA sources then, once per machine.
"""

import fcntl
import importlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, TextIO

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


def take_gpu() -> int:
    """This process draws on its own of the machine's GPUs from here on, which is returned. Raises BackendMissing."""
    torch, _ = require()
    gpu = own_place() % int(torch.cuda.device_count())
    torch.cuda.set_device(gpu)
    return gpu


@cache
def own_place() -> int:
    """The first number that no other process of this user holds here, for as long as this one lives: so GPUs are shared
    evenly. Ray deals shares out one GPU after the other, and a process each task another, where CUDA stays with the
    first."""
    for place in count():
        if (file := _hold(_folder() / str(place))) is not None:
            _HELD.append(file)
            break
    return place


def _folder() -> Path:
    folder = Path(tempfile.gettempdir()) / f"driving-data-factory-gpu-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


FITS_AT_ONCE = 2  # on a GPU: while the host works for one it draws for the other
LOOK_S = 0.5  # between two looks whether a turn is free


@contextmanager
def fit_turn(gpu: int, stopped: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """One of a GPU's places for fits, of all processes of this user here: waited for, given back at the end.

    More fits would need more memory and share the same hours. Once `stopped` nothing is waited for.
    """
    file = None
    while file is None and not stopped():
        for place in range(FITS_AT_ONCE):
            file = file or _hold(_folder() / f"fit-{gpu}-{place}")
        if file is None:
            time.sleep(LOOK_S)
    try:
        yield
    finally:
        if file is not None:
            file.close()


def _hold(path: Path) -> TextIO | None:
    """The file, which nobody else holds as long as it is open; None where somebody does."""
    file = path.open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


_HELD: list[TextIO] = []  # of places: they end with this process


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
