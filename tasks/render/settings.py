"""What is rendered, and how large."""

import math
from dataclasses import dataclass, field
from enum import StrEnum

from tasks.render.fit.settings import FitSettings
from tasks.render.gate import GateSettings
from tasks.render.scene.build import AssetSettings
from tasks.render.scene.engine import Backend


class RenderMode(StrEnum):
    AUTO = "auto"  # from the block's scene where its sensors allow one, else no images
    MAP = "map"  # lanes, paint and boxes on plain ground; marked as such
    NONE = "none"


class SceneFrom(StrEnum):
    """How photos become a block's scene."""

    DISCS = "discs"  # built from depth in one go: seconds a block
    FIT = "fit"  # the same, then fitted to the photos: render.fit says how long


class PsnrGate(StrEnum):
    REJECT = "reject"  # before perturb work is spent on the block
    MARK = "mark"  # samples are kept, tagged low_psnr


class ImageSource(StrEnum):
    """Where a sample's images come from."""

    PHOTO = "photo"
    RENDER = "render"
    MAP = "map"
    NONE = "none"


class Frames(StrEnum):
    ALL = "all"
    HISTORY = "history"
    NOW = "now"


# Steps of 0.1 s relative to the sample's now, at 2 Hz.
STEPS_OF = {
    Frames.ALL: tuple(range(-15, 41, 5)),
    Frames.HISTORY: tuple(range(-15, 1, 5)),
    Frames.NOW: (0,),
}


@dataclass(frozen=True)
class RenderSettings:
    """The render stage's settings."""

    mode: RenderMode = RenderMode.AUTO
    backend: Backend = Backend.CPU
    frames: Frames = Frames.HISTORY
    cameras: tuple[str, ...] = ()  # by name; empty: every camera of the rig
    width: int = 320  # pixels
    height: int = 180
    jpeg_quality: int = 90
    psnr_min: float = 27.0  # [dB] what a block's held-out photos must come out with; 0: anything
    psnr_gate: PsnrGate = PsnrGate.REJECT  # what becomes of a block below psnr_min
    gate: GateSettings = field(default_factory=GateSettings)  # what every rendered picture of a drive must come up to
    lidar_only_reach_m: float = 15.0  # without photos: images only this close to where a sweep was taken; 0: none
    map_rig: str = "three_front"  # cameras of a clip without a rig of its own, for mode=map
    scene: SceneFrom = SceneFrom.FIT
    asset: AssetSettings = field(default_factory=AssetSettings)
    fit: FitSettings = field(default_factory=FitSettings)

    def __post_init__(self) -> None:
        bounds = {
            "width": (16, math.inf),
            "height": (16, math.inf),
            "jpeg_quality": (1, 100),
            "psnr_min": (0.0, math.inf),
            "lidar_only_reach_m": (0.0, math.inf),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                wanted = f"from {low:g} to {high:g}" if high < math.inf else f"finite and at least {low:g}"
                raise ValueError(f"render {name} must be {wanted}, not {value}")

    @property
    def refuses_blocks(self) -> bool:
        """Whether a block can be too poor for any of its clips to be perturbed."""
        return self.mode is RenderMode.AUTO and self.psnr_min > 0.0 and self.psnr_gate is PsnrGate.REJECT
