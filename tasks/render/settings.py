"""What a user may set of pictures: of a scene and its fit, of the cameras' rig, of the gates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from tasks.settings import constant

# How a scene is built, and what draws it.


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


DISCS = AssetSettings()  # every block's: a user chooses between discs and fit, not how discs are built


# Whether a rig's calibration is corrected before its photos are used.


class Adjust(StrEnum):
    AUTO = "auto"  # blocks without lidar, whose depth hangs on the calibration alone
    ON = "on"
    OFF = "off"


@dataclass(frozen=True)
class RigSettings:
    """The priors are one set for all rigs, in tasks/render/rig/correct.py."""

    adjust: Adjust = Adjust.AUTO

    def may_correct(self, photos_alone: bool) -> bool:
        """Whether a run may have a rig to correct; photos_alone: its clips may have photos and no lidar."""
        return self.adjust is Adjust.ON or (self.adjust is Adjust.AUTO and photos_alone)


# What the fit is told.


@dataclass(frozen=True)
class FitSettings:
    """Budgets are counts of iterations, one photo each; lengths in metres unless said otherwise.

    The rates are about twice those of Kerbl et al. 2023, for budgets of some thousand iterations. What is fixed was
    chosen on real and synthetic streets (docs/reconstruction.md) and is the same for every block.
    """

    iterations: int = 8000  # in all
    seed: int = constant(0)  # of every draw
    hold_out_every: int = constant(8)  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    # Where it starts.
    start_every: int = 1  # every n-th instant's photos say where surfaces are: less work where photos hardly differ
    start_gaussians: int = 200_000  # of the background
    road_share: float = 0.4  # of the discs on the road, against those elsewhere, how many are taken
    start_node_gaussians: int = 3_000  # of each track, at most
    most_gaussians: int = 250_000  # of a scene
    start_opacity: float = 0.5  # of every Gaussian
    stereo_photos: int = 4  # neighbours compared where lidar does not reach
    # Loss.
    ssim_weight: float = 0.1  # loss = (1 - w) L1 + w (1 - SSIM)
    opaque_weight: float = constant(0.1)  # of the mean light that passes where a photo looks at the ground
    # Step sizes of Adam; each falls exponentially to a share of itself.
    rate_end: float = constant(0.3)  # that share, but for mean_rate
    mean_rate: float = 1.6e-3  # times the nearest viewing depth
    quat_rate: float = 4e-3  # of rotations
    scale_rate: float = 2e-2  # of sizes; farther in fits of less than 8,000 iterations, by the root of how many less
    opacity_rate: float = 8e-2  # of opacities
    colour_rate: float = 1.2e-2  # of colours
    sky_rate: float = 4e-3  # of the sky map
    exposure_rate: float = 1e-3  # 0: the cameras agree, nothing is aligned
    turn_rate: float = constant(3e-4)  # [rad] of the pose corrections
    shift_rate: float = constant(1e-3)  # [m]
    pose_from: int = 100  # iteration at which poses and boxes start to move
    box_shift_rate: float = constant(2e-2)  # [m] of where boxes are; 0: where they were logged
    box_turn_rate: float = constant(2e-3)  # [rad]
    mean_rate_end: float = constant(0.15)  # that of mean_rate
    # Shape: how often a Gaussian's longest side is its shortest, at most; 0: as often as it likes.
    stretch: float = 0.0  # of the background, but for the road
    box_stretch: float = constant(2.0)  # of what lies in boxes
    # Density: relocation and growth of 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024).
    refine_every: int = constant(100)  # iterations
    refine_from: int = constant(300)  # iteration
    growth: float = constant(0.03)  # share of Gaussians added each time

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "start_every",
            "start_gaussians",
            "start_node_gaussians",
            "most_gaussians",
            "refine_every",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"fit {name} must be 1 or more, not {getattr(self, name)}")
        if self.road_share <= 0.0:
            raise ValueError(f"fit road_share must be above 0, not {self.road_share}")
        for name in ("ssim_weight", "rate_end", "mean_rate_end"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"fit {name} must be from 0 to 1, not {getattr(self, name)}")
        for name in ("stretch", "box_stretch"):
            if getattr(self, name) != 0.0 and not getattr(self, name) >= 1.0:
                raise ValueError(f"fit {name} must be 0 (any) or 1 and more, not {getattr(self, name)}")


class RenderMode(StrEnum):
    AUTO = "auto"  # from the block's scene where its sensors allow one, else no images
    MAP = "map"  # lanes, paint and boxes on plain ground; marked as such
    PAINTER = "painter"  # what a camera would have taken: of the synthetic town alone, by the painter of its photos
    NONE = "none"


class SceneFrom(StrEnum):
    """How photos become a block's scene."""

    DISCS = "discs"  # built from depth in one go: seconds a block
    FIT = "fit"  # the same, then fitted to the photos: render.fit says how long


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
STEPS_OF = {Frames.ALL: tuple(range(-15, 41, 5)), Frames.HISTORY: tuple(range(-15, 1, 5)), Frames.NOW: (0,)}


def _check(what: str, settings: object, bounds: Mapping[str, tuple[float, float]]) -> None:
    for name, (low, high) in bounds.items():
        value = getattr(settings, name)
        if not (math.isfinite(value) and low <= value <= high):
            wanted = f"from {low:g} to {high:g}" if high < math.inf else f"finite and at least {low:g}"
            raise ValueError(f"{what} {name} must be {wanted}, not {value}")


@dataclass(frozen=True)
class GateSettings:
    """What every picture must come up to. What the looks at vehicles catch and lose: docs/reconstruction.md.

    The measures are fixed, since what a bound of theirs catches and loses was counted at these.
    """

    enabled: bool = True  # whether pictures are looked at
    width: int = constant(160)  # pixels of the pictures that are looked at, where those to be stored are no smaller
    reach_m: float = constant(30.0)  # of the scene that is looked at
    contrast_min: float = constant(0.02)  # standard deviation of the grey picture in [0, 1]: five grey levels
    vehicle_min: float = 0.75  # likeness to its photos to be expected of a large vehicle; 0: no look at vehicles
    # Likeness that it must have beside a photo from near, place by place; 0: no such look.
    beside_min: float = constant(0.75)
    guessed_max: float = 0.36  # share of a picture's worst quarter that may be a guess; 1: no such look
    vehicle_share: float = constant(0.02)  # of a picture, from which on a vehicle is large

    def __post_init__(self) -> None:
        shares = dict.fromkeys(
            ("contrast_min", "vehicle_min", "beside_min", "guessed_max", "vehicle_share"), (0.0, 1.0)
        )
        _check("render gate", self, {"width": (16, math.inf), "reach_m": (0.0, math.inf), **shares})


@dataclass(frozen=True)
class RenderSettings:
    """The render stage's settings."""

    mode: RenderMode = RenderMode.AUTO  # auto: clips with cameras or lidar; map: lanes, boxes; painter: the town
    backend: Backend = Backend.CPU  # gsplat: CUDA, needs the extra [gpu]
    frames: Frames = Frames.HISTORY  # at 2 Hz; all: from 1.5 s before now to the label's end; history: to now
    cameras: tuple[str, ...] = ()  # by name; empty: every camera of the rig
    width: int = 320  # pixels
    height: int = 180  # pixels
    jpeg_quality: int = 90  # 1 to 100
    camera_psnr_min: float = 20.0  # [dB] a camera whose held-out photos come out worse is left out; 0: none
    psnr_min: float = 24.0  # [dB] what those of the others must come out with, else the block is refused; 0: anything
    gate: GateSettings = field(default_factory=GateSettings)  # what every rendered picture of a drive must come up to
    scene: SceneFrom = SceneFrom.FIT  # discs: built in one go, seconds a block; fit: then fitted to its photos, minutes
    scene_dtype: SceneDtype = constant(SceneDtype.FLOAT16)  # of scenes' files; float16: all but the places of Gaussians
    own_body: str = ""  # folder of masks, <camera>.png, of what the rig sees of the ego itself; empty: found; none
    rig: RigSettings = field(default_factory=RigSettings)  # whether cameras and poses are corrected first
    asset: AssetSettings = constant(DISCS)
    fit: FitSettings = field(default_factory=FitSettings)

    def __post_init__(self) -> None:
        bounds = {
            "width": (16, math.inf),
            "height": (16, math.inf),
            "jpeg_quality": (1, 100),
            "psnr_min": (0.0, math.inf),
            "camera_psnr_min": (0.0, math.inf),
        }
        _check("render", self, bounds)

    @property
    def refuses_blocks(self) -> bool:
        """Whether a block can be too poor for any of its clips to be perturbed."""
        return self.mode is RenderMode.AUTO and self.psnr_min > 0.0
