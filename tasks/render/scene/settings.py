"""How a scene is built, and what draws it."""

from dataclasses import dataclass
from enum import StrEnum


class Backend(StrEnum):
    CPU = "cpu"
    GSPLAT = "gsplat"


@dataclass(frozen=True)
class AssetSettings:
    """How a scene is built. Pixels are those of the photos handed in."""

    max_gap_px: tuple[int, int] = (12, 24)  # columns, rows that are interpolated between lidar returns
    refit_sweeps: int = 1  # a second one gains 0.02 .. 0.08 dB for a third of the time
    hold_out_every: int = 8  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    stereo_photos: int = 4  # neighbours compared where lidar does not reach
