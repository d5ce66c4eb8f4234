"""How a scene is built, and what draws it."""

from dataclasses import dataclass
from enum import StrEnum


class Backend(StrEnum):
    """Who draws scenes, and fits them."""

    CPU = "cpu"
    GSPLAT = "gsplat"  # packed: memory follows what the cameras see
    GSPLAT_DENSE = "gsplat_dense"  # memory for every Gaussian and camera; fits as the other does

    @property
    def on_gpu(self) -> bool:
        """Whether it needs torch, gsplat and a CUDA device."""
        return self is not Backend.CPU


class SceneDtype(StrEnum):
    """What a scene's file holds Gaussians in; drawn they are float32 everywhere."""

    FLOAT32 = "float32"
    FLOAT16 = "float16"  # all but their places


@dataclass(frozen=True)
class AssetSettings:
    """How a scene is built."""

    hold_out_every: int = 8  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    stereo_photos: int = 4  # neighbours compared where lidar does not reach
