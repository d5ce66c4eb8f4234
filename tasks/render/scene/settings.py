"""How a scene is built, and what draws it."""

from dataclasses import dataclass
from enum import StrEnum


class Backend(StrEnum):
    CPU = "cpu"
    GSPLAT = "gsplat"


@dataclass(frozen=True)
class AssetSettings:
    """How a scene is built."""

    hold_out_every: int = 8  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    stereo_photos: int = 4  # neighbours compared where lidar does not reach
