"""Planners by name, and what may be set of each; beside their networks, so that nothing here imports PyTorch.

A planner of a user's own package has its settings where its class is, which is then imported with all that it needs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from factory.config.compose import ConfigError, fill
from factory.config.plugins import import_object, plugin_named, plugins_by_name
from factory.config.shapes import deep_merge, defaults_of
from factory.config.words import did_you_mean
from planners.data.batch import BevLayout, ImageLayout
from tasks.settings import constant
from tasks.subscores import LABELLED
from tasks.world.commands import CommandRule

STRIDES = (4, 8, 16, 32)
Status = Literal["all", "speed"]  # what of the ego's status is seen; speed: command and velocity, no acceleration
PlanFrom = Literal["zero", "constant_velocity"]  # what regressed poses are added to
WeightingName = Literal["release", "close"]


@dataclass(frozen=True)
class BackboneSettings:
    """Which network, and where its weights come from."""

    name: Literal["resnet34", "vovnet99", "small"] = "resnet34"
    pretrained: str | None = None  # .safetensors, .pth or .pt under the published names; None: random weights
    widths: tuple[int, ...] = (16, 32, 64, 128)  # of `small`, one residual block each
    pixels: Literal["imagenet", "unit"] = "imagenet"  # 0 .. 255 become ImageNet's mean 0 and deviation 1, or 0 .. 1
    frozen_norm: bool = False  # normalisations keep their statistics in training; scale and shift are learned


@dataclass(frozen=True)
class FusionSettings:
    """Sizes of the fusion."""

    backbone: BackboneSettings = field(default_factory=BackboneSettings)  # of the picture; the latent's has no weights
    latent_size: int = 256  # cells to a side, a multiple of 32
    latent_channels: int = 1
    image_tokens: tuple[int, int] = (16, 64)  # rows, columns that every map of the picture is averaged to
    latent_tokens: tuple[int, int] = (8, 8)
    layers: int = 2  # of each of the four transformers
    heads: int = 4
    expansion: int = 4  # of their feed-forward parts
    dropout: float = 0.1
    bev_channels: int = 64

    def __post_init__(self) -> None:
        if self.latent_size % STRIDES[-1]:
            raise ValueError(f"latent_size={self.latent_size}: give a multiple of {STRIDES[-1]}")


Variant = Literal["paper", "public", "small"]


@dataclass(frozen=True)
class Sizes:
    """Of a network; the defaults are the paper's and the public code's."""

    fusion: FusionSettings = field(default_factory=FusionSettings)
    width: int = 256  # of the decoders
    hidden: int = 1024
    layers: int = 3
    heads: int = 8
    agents: int = 30  # vehicles that are learnt beside planning, the nearest
    cell_m: float = 0.25  # of the raster from above
    picture: BackboneSettings = field(default_factory=lambda: BackboneSettings("vovnet99"))  # of an encoder of it alone


@dataclass(frozen=True)
class NetworkSettings:
    """What planners with a picture have in common."""

    image: ImageLayout = field(default_factory=ImageLayout)
    variant: Variant = "paper"  # public: as the public code, whose checkpoints it takes; small: for two cores
    pretrained: str | None = None  # the picture's backbone: .safetensors, .pth or .pt, published names; null: random
    command: CommandRule = "navsim"  # by which it is told where to go; curvature: as AlpaSim's routes show it
    status: Status = "all"  # what of the ego's own it sees; speed: no acceleration
    sizes: Sizes | None = constant(None)  # in the place of the variant's
    SIZES: ClassVar[Mapping[str, Sizes]] = {"paper": Sizes(), "public": Sizes()}  # by variant

    @property
    def is_public(self) -> bool:
        """Whether everything is as in the public code: pixels, targets, the weights to begin with."""
        return self.variant == "public"

    @property
    def network(self) -> Sizes:
        """The sizes."""
        return self.sizes or self.SIZES[self.variant]

    @property
    def picture(self) -> ImageLayout:
        """The picture, decoded as the variant does."""
        return replace(self.image, decoding="full") if self.is_public else self.image

    @property
    def bev(self) -> BevLayout:
        """The raster that is learnt beside planning."""
        return BevLayout(cell_m=self.network.cell_m, public=self.is_public)

    @property
    def fusion(self) -> FusionSettings:
        """With the weights that the picture's backbone begins with."""
        return replace(self.network.fusion, backbone=self.over_pictures(self.network.fusion.backbone))

    def over_pictures(self, backbone: BackboneSettings) -> BackboneSettings:
        """A backbone as the variant has it, with its first weights."""
        if self.is_public:
            backbone = replace(backbone, pixels="unit", frozen_norm=backbone.name == "vovnet99")
        return replace(backbone, pretrained=self.pretrained)


@dataclass(frozen=True)
class ConstantVelocitySettings:
    """Nothing to set."""


@dataclass(frozen=True)
class EgoMlpSettings:
    """Of the one that sees its status alone."""

    hidden: tuple[int, ...] = (512, 512, 512)  # widths of the hidden layers
    plan_from: PlanFrom = "zero"  # what the regressed poses are added to
    command: CommandRule = "navsim"  # as of NetworkSettings
    status: Status = "all"


@dataclass(frozen=True)
class EgoMlpBevSettings(EgoMlpSettings):
    """The raster, and the convolutions over it, each of stride 2."""

    bev: BevLayout = field(
        default_factory=lambda: BevLayout(ahead_m=48.0, behind_m=16.0, cell_m=0.5, times_s=(-1.0, -0.5, 0.0))
    )
    classes: int = 4  # numbers that a class of cell is told by
    channels: tuple[int, ...] = (16, 32, 64, 64)
    features: int = 256  # that the map is folded into


LTF_SMALL = FusionSettings(  # a step of 16 samples takes 0.1 s of a core
    backbone=BackboneSettings("small"),
    latent_size=96,
    image_tokens=(2, 8),
    latent_tokens=(3, 3),
    layers=1,
    expansion=2,
    dropout=0.0,
    bev_channels=16,
)


@dataclass(frozen=True)
class LtfSettings(NetworkSettings):
    """Latent TransFuser's."""

    SIZES: ClassVar[Mapping[str, Sizes]] = {
        "paper": Sizes(),
        "public": Sizes(FusionSettings(image_tokens=(8, 32))),
        "small": Sizes(LTF_SMALL, width=64, hidden=128, layers=2, heads=4, agents=10, cell_m=1.0),
    }
    plan_from: PlanFrom = "zero"  # what the regressed positions are added to
    trajectory_weight: float = constant(10.0)  # the unit that the others are weighed against
    agent_class_weight: float = 10.0
    agent_box_weight: float = 1.0
    bev_weight: float = 10.0


DIFFUSIONDRIVE_SMALL = FusionSettings(  # a step of 16 samples takes 0.1 s of a core
    backbone=BackboneSettings("small", widths=(16, 32, 64, 96)),
    latent_size=64,
    image_tokens=(2, 8),
    latent_tokens=(2, 2),
    layers=1,
    expansion=2,
    dropout=0.0,
    bev_channels=16,
)


@dataclass(frozen=True)
class DiffusionDriveSettings(NetworkSettings):
    """DiffusionDrive's."""

    SIZES: ClassVar[Mapping[str, Sizes]] = {
        "paper": Sizes(),
        "public": Sizes(FusionSettings(image_tokens=(8, 32))),
        "small": Sizes(DIFFUSIONDRIVE_SMALL, width=48, hidden=96, layers=2, heads=4, agents=10, cell_m=1.0),
    }
    anchors: str | None = None  # .npy (A, 8, 2); null: clusters of the plans to be trained on
    n_anchors: int = 20  # of them
    dropout: float = 0.1  # in the cascade
    offsets_from: Literal["noisy", "anchors"] = "noisy"  # what the first refinement's plans are added to
    trajectory_weight: float = constant(12.0)  # of all refinements together
    confidence_weight: float = 10.0  # within it
    regression_weight: float = constant(8.0)
    agent_class_weight: float = constant(10.0)
    agent_box_weight: float = constant(1.0)
    bev_weight: float = constant(14.0)


GTRS_SMALL = BackboneSettings("small")


@dataclass(frozen=True)
class GtrsDenseSettings(NetworkSettings):
    """GTRS-Dense's."""

    SIZES: ClassVar[Mapping[str, Sizes]] = {
        "paper": Sizes(),
        "public": Sizes(FusionSettings(latent_channels=4)),
        "small": Sizes(FusionSettings(GTRS_SMALL), width=64, hidden=128, layers=2, heads=4, picture=GTRS_SMALL),
    }
    vocabulary: str | None = None  # .npy (K, 40, 3): the one whose labels the samples carry
    inference_vocabulary: str | None = None  # .npy of another to choose from; published: 8,192 for navhard
    inference_entries: int | None = None  # or that many of the first, evenly spaced; null for both: all
    weighting: WeightingName = "release"
    encoder: Literal["fused", "picture"] = "fused"  # as published with ResNet-34; with V2-99
    kept: float = 0.5  # share of the vocabulary in a training step
    velocity_noise_mps: tuple[float, float] = constant((1.0, 0.2))  # deviation along and across, in training
    image_shift: float = constant(1 / 256)  # largest, as a share of the width, in training: half a degree

    def __post_init__(self) -> None:
        if self.inference_vocabulary is not None and self.inference_entries is not None:
            raise ValueError("inference_vocabulary and inference_entries: give one of them")
        if not 0.0 < self.kept <= 1.0:
            raise ValueError(f"kept={self.kept}: a share of the vocabulary above 0, at most 1")

    def check_labels(self, labelled: str | None) -> None:
        """labelled: digest of the samples' vocabulary. Raises ValueError where there is none, or no file of it."""
        if labelled is None:
            raise ValueError("gtrs_dense learns from labels of a vocabulary and these samples carry none")
        if self.vocabulary is None:
            raise ValueError(f"vocabulary: give the .npy file of trajectories with digest {labelled}, the labels' own")

    @property
    def backbone(self) -> BackboneSettings:
        """Of an encoder of the picture alone."""
        return self.over_pictures(self.network.picture)

    @property
    def sub_scores(self) -> tuple[str, ...]:
        """Those that a head learns: the public model has none for history comfort."""
        return tuple(name for name in LABELLED if not (self.is_public and name == "hc"))


BUILT_IN: Mapping[str, tuple[str, type]] = {  # name -> its class, and what its settings are
    "constant_velocity": ("planners.models.baselines:ConstantVelocity", ConstantVelocitySettings),
    "ego_mlp": ("planners.models.baselines:EgoMlp", EgoMlpSettings),
    "ego_mlp_bev": ("planners.models.baselines:EgoMlpBev", EgoMlpBevSettings),
    "ltf": ("planners.models.ltf:Ltf", LtfSettings),
    "diffusiondrive": ("planners.models.diffusiondrive:DiffusionDrive", DiffusionDriveSettings),
    "gtrs_dense": ("planners.models.gtrs_dense:GtrsDense", GtrsDenseSettings),
}
OWN = "my.module:MyPlanner"  # how a class of the user's own is named
NO_PLANNER = "planner.name={} is not a planners.models.planner.Planner"


@dataclass(frozen=True)
class PlannerChoice:
    """A planner and its settings, as conf/planner/*.yaml and checkpoints name it."""

    name: str  # one of BUILT_IN, of an installed package's, or my.module:MyPlanner
    settings: dict[str, Any] = field(default_factory=dict)


def named_class(name: str) -> Any:
    """What the name of a planner names, imported. Raises ConfigError where there is none of that name."""
    plugin = plugin_named("planner", name, BUILT_IN)
    target = plugin.reference if plugin is not None else BUILT_IN[name][0] if name in BUILT_IN else name
    if ":" not in target:
        known = [*BUILT_IN, *plugins_by_name("planner")]
        meant = did_you_mean(name, known)
        raise ConfigError(f"planner.name={name}: none of {', '.join(known)}{meant}; or name a class, {OWN}")
    return import_object(target, "planner.name", OWN)


def settings_class(name: str) -> type[Any]:
    """The dataclass of a planner's settings; of a built-in one without PyTorch. Raises ConfigError."""
    found = BUILT_IN[name][1] if name in BUILT_IN else getattr(named_class(name), "settings_type", None)
    if found is None:
        raise ConfigError(NO_PLANNER.format(name))
    return found


def settings_of(choice: PlannerChoice) -> Any:
    """The planner's own settings, its defaults for what is not named. Raises ConfigError for one it does not have."""
    shape = settings_class(choice.name)
    return fill(shape, deep_merge(defaults_of(shape), choice.settings), "planner.settings")
