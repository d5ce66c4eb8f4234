"""What the fit asks of whoever draws: the loop of `reconstruct` is written once, over this.

A backend says of one photo how its loss changes with all that is learned, and keeps the arrays where it works
meanwhile: in place on the CPU, on a device elsewhere. Which photo, which step sizes, when Gaussians are moved and when
poses are is the loop's, and the same with every backend.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from tasks.render.fit.road import Road
from tasks.render.fit.settings import FitSettings
from tasks.render.fit.start import Problem
from tasks.render.fit.state import FitState
from tasks.render.splatting.gradient import Gradients
from tasks.world.arrays import F32, Array, Ints


@dataclass(frozen=True)
class Derivatives:
    """What one photo says of all that is learned; arrays of Gaussians and sky are of the kind that a backend holds."""

    loss: float
    psnr_db: float
    exposure: F32  # (12,) by the photo's row
    camera: Array  # (6,) as of `Gradients`
    cells: Any  # (K,) of the sky, that shine into the photo
    sky: Any  # (K, 3) by them
    rows: Any  # (M,) of the state, ascending, that are in view
    gaussians: Gradients  # by those, in the frames of their owners
    depths: Any  # (M,) [m] of those
    tracks: Ints  # (B,) of which the photo may show some
    boxes: F32  # (B, SHIFT_SIZE) by what their boxes are off by at its time


class Stepped(Protocol):
    """As `Learned`: an array that steps against a gradient."""

    @property
    def values(self) -> Any: ...

    def step(self, rows: Any, gradient: Any, rate: float, scale: Any = None) -> None: ...


class Held(Protocol):
    """As `FitState`: all that is learned, wherever it lies; exposure, poses and boxes lie on the CPU."""

    iteration: int

    @property
    def learned(self) -> Mapping[str, Stepped]: ...

    def seen(self, rows: Any, depths: Any, screen: Any) -> Any: ...

    def lay_flat(self, rows: Any, road: Road) -> None: ...

    def keep_round(self, rows: Any, background: float, boxes: float) -> None: ...


class FitBackend(Protocol):
    """Draws and differentiates."""

    def take(self, state: FitState) -> Any:
        """The state as a `Held`, where this backend works."""

    def give_back(self, held: Any, state: FitState) -> None:
        """What became of a taken state, into `state`."""

    def derivatives(self, problem: Problem, held: Any, row: int, settings: FitSettings) -> Derivatives:
        """Of the photo `row` of those trained on, as `held` is now."""
