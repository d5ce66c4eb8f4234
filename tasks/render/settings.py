"""What is rendered, and how large."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from tasks.render.fit.settings import FitSettings
from tasks.render.rig.settings import RigSettings
from tasks.render.scene.settings import AssetSettings, Backend, SceneDtype

Chroma = Literal["420", "444"]


class RenderMode(StrEnum):
    AUTO = "auto"  # from the block's scene where its sensors allow one, else no images
    MAP = "map"  # lanes, paint and boxes on plain ground; marked as such
    PAINTER = "painter"  # what a camera would have taken: of the synthetic town alone, by the painter of its photos
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
    PAINTER = "painter"
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


def _check(what: str, settings: object, bounds: Mapping[str, tuple[float, float]]) -> None:
    for name, (low, high) in bounds.items():
        value = getattr(settings, name)
        if not (math.isfinite(value) and low <= value <= high):
            wanted = f"from {low:g} to {high:g}" if high < math.inf else f"finite and at least {low:g}"
            raise ValueError(f"{what} {name} must be {wanted}, not {value}")


@dataclass(frozen=True)
class GateSettings:
    """What every picture must come up to. What the looks at vehicles catch and lose: docs/reconstruction.md."""

    enabled: bool = True  # whether pictures are looked at
    width: int = 160  # pixels of the pictures that are looked at, where those to be stored are no smaller
    reach_m: float = 30.0  # of the scene that is looked at
    contrast_min: float = 0.02  # standard deviation of the grey picture in [0, 1]: five grey levels
    vehicle_min: float = 0.75  # likeness to its photos to be expected of a large vehicle; 0: no look at vehicles
    beside_min: float = 0.75  # likeness that it must have beside a photo from near, place by place; 0: no such look
    vehicle_share: float = 0.02  # of a picture, from which on a vehicle is large

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("contrast_min", "vehicle_min", "beside_min", "vehicle_share"), (0.0, 1.0))
        _check("render gate", self, {"width": (16, math.inf), "reach_m": (0.0, math.inf), **shares})


@dataclass(frozen=True)
class RenderSettings:
    """The render stage's settings."""

    mode: RenderMode = RenderMode.AUTO  # auto: clips with cameras or lidar; map: lanes, boxes; painter: the town
    backend: Backend = Backend.CPU  # gsplat: CUDA, needs the extra [gpu]
    frames: Frames = Frames.HISTORY  # at 2 Hz; all: T-1.5 s .. the end, history: a planner's input
    cameras: tuple[str, ...] = ()  # by name; empty: every camera of the rig
    width: int = 320  # pixels
    height: int = 180  # pixels
    jpeg_quality: int = 90  # 1 to 100
    jpeg_chroma: Chroma = "420"  # colours at half the size each way; 444: whole
    psnr_min: float = 27.0  # [dB] what a block's held-out photos must come out with; 0: anything
    camera_psnr_min: float = 20.0  # [dB] and those of each of its cameras; 0: anything
    psnr_gate: PsnrGate = PsnrGate.REJECT  # what becomes of a block below psnr_min
    lpips: tuple[
        str, ...
    ] = ()  # files of weights: held-out photos are measured by LPIPS as well, which decides nothing
    gate: GateSettings = field(default_factory=GateSettings)  # what every rendered picture of a drive must come up to
    lidar_only_reach_m: float = 15.0  # without photos: images only this close to where a sweep was taken; 0: none
    map_rig: Literal["front", "three_front", "ring_six"] = "three_front"  # for mode=map without a rig
    scene: SceneFrom = SceneFrom.FIT  # discs: built in one go, seconds a block; fit: then fitted to its photos, minutes
    scene_dtype: SceneDtype = SceneDtype.FLOAT16  # of scenes' files; float16: all but the places of Gaussians
    own_body: str = ""  # folder of masks, <camera>.png, of what the rig sees of the ego itself
    rig: RigSettings = field(default_factory=RigSettings)  # whether cameras and poses are corrected first
    asset: AssetSettings = field(default_factory=AssetSettings)
    fit: FitSettings = field(default_factory=FitSettings)

    def __post_init__(self) -> None:
        bounds = {
            "width": (16, math.inf),
            "height": (16, math.inf),
            "jpeg_quality": (1, 100),
            "psnr_min": (0.0, math.inf),
            "camera_psnr_min": (0.0, math.inf),
            "lidar_only_reach_m": (0.0, math.inf),
        }
        _check("render", self, bounds)

    @property
    def refuses_blocks(self) -> bool:
        """Whether a block can be too poor for any of its clips to be perturbed."""
        return self.mode is RenderMode.AUTO and self.psnr_min > 0.0 and self.psnr_gate is PsnrGate.REJECT
