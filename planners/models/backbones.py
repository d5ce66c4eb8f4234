"""Image backbones: four feature maps at strides 4, 8, 16, 32 from a picture, by name, with weights from a user's file.

Nothing is downloaded. A planner is built without weights; `load_pretrained` reads the files its settings name when a
training begins, so that a checkpoint is opened where those files are not.
"""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Self

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

from factory.files import file_digest
from factory.readers.pickles import load_tensors
from factory.wording import listed, one_line
from planners.models.settings import STRIDES, BackboneSettings

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of red, green, blue in 0 .. 1


class Backbone(nn.Module, ABC):
    """`enter`, then `stage` 0 .. 3, between which a planner may change the features; `forward` is all of them."""

    over_pictures = True  # False of one over something else, which learns as the rest does
    recompute = False  # whether blocks keep no activations for the backward pass; results stay the same

    def __init__(self, settings: BackboneSettings, channels: tuple[int, ...]) -> None:
        super().__init__()
        self.settings, self.channels = settings, channels
        self.weights_missing = settings.pretrained is not None
        imagenet = settings.pixels == "imagenet"
        mean = torch.tensor(IMAGENET_MEAN if imagenet else (0.0, 0.0, 0.0)).view(3, 1, 1)
        std = torch.tensor(IMAGENET_STD if imagenet else (1.0, 1.0, 1.0)).view(3, 1, 1)
        self.register_buffer("shift", -mean / std, persistent=False)
        self.register_buffer("scale", 1.0 / (255.0 * std), persistent=False)
        self.register_load_state_dict_post_hook(_mark_weights_loaded)

    def normalised(self, image: Tensor) -> Tensor:
        """uint8 RGB (B, 3, h, w) as the float that `pixels` says; a float input as it is.

        Raises RuntimeError where the settings name weights that nobody loaded.
        """
        if self.weights_missing:
            raise RuntimeError(
                f"weights {self.settings.pretrained} are named but not loaded: call backbones.load_pretrained"
            )
        image = image.contiguous(memory_format=torch.channels_last)  # a third faster in training on a CPU core
        if image.dtype != torch.uint8:
            return image
        return torch.addcmul(self.get_buffer("shift"), image, self.get_buffer("scale"))

    def through(self, blocks: Iterable[nn.Module], features: Tensor) -> Tensor:
        """The features after one block after the other."""
        again = self.recompute and torch.is_grad_enabled()
        for block in blocks:
            features = checkpointed_block(block, features) if again else block(features)
        return features

    def train(self, mode: bool = True) -> Self:
        """As of every module, but that normalisations with `frozen_norm` stay in evaluation."""
        super().train(mode)
        if self.settings.frozen_norm:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    @abstractmethod
    def enter(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w), see `normalised`, to features at stride 4."""

    @abstractmethod
    def stage(self, index: int, features: Tensor) -> Tensor:
        """Features at the stride before to (B, channels[index], h / STRIDES[index], w / STRIDES[index])."""

    def forward(self, image: Tensor) -> list[Tensor]:
        """Picture (B, 3, h, w), h and w multiples of 32, to (B, channels[i], h / STRIDES[i], w / STRIDES[i]) each."""
        maps = [self.enter(image)]
        for i in range(len(STRIDES)):
            maps.append(self.stage(i, maps[-1]))
        return maps[1:]


def _mark_weights_loaded(module: nn.Module, _: object) -> None:
    assert isinstance(module, Backbone)
    module.weights_missing = False


def checkpointed_block(block: nn.Module, features: Tensor) -> Tensor:
    """block(features), with its gradients and running statistics; of memory, what its input takes."""

    def contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        return nullcontext(), _statistics_kept(block)

    result: Tensor = checkpoint(block, features, use_reentrant=False, context_fn=contexts)
    return result


@contextmanager
def _statistics_kept(block: nn.Module) -> Iterator[None]:
    """Inside, normalisations count what they see in copies of their statistics: the first pass has counted it."""
    counting = [m for m in block.modules() if isinstance(m, _BatchNorm) and m.training]
    counted = [(module, name, value) for module in counting for name, value in module.named_buffers(recurse=False)]
    for module, name, value in counted:
        setattr(module, name, value.clone())
    try:
        yield
    finally:
        for module, name, value in counted:
            setattr(module, name, value)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut, which is a 1x1 convolution where size or width changes."""

    def __init__(self, entering: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(entering, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or entering != width:
            self.downsample = nn.Sequential(nn.Conv2d(entering, width, 1, stride, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        return self.relu(self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x))))) + shortcut)


class ResNet(Backbone):
    """Four groups of basic blocks (He et al. 2016) behind a 7x7 stem, with torchvision's and timm's parameter names.

    `pool`: the published stem, stride 2 twice; else stride 4 at once.
    The latter costs a small picture a sixth of the stem's arithmetic, which would be most of a narrow network's.
    """

    def __init__(
        self, settings: BackboneSettings, widths: Sequence[int], blocks: Sequence[int], pool: bool, in_channels: int
    ) -> None:
        super().__init__(settings, tuple(widths))
        self.conv1 = nn.Conv2d(in_channels, widths[0], 7, 2 if pool else 4, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1) if pool else nn.Identity()
        entering = widths[0]
        for group, (width, depth) in enumerate(zip(widths, blocks)):
            first = BasicBlock(entering, width, 1 if group == 0 else 2)
            rest = [BasicBlock(width, width, 1) for _ in range(depth - 1)]
            self.add_module(f"layer{group + 1}", nn.Sequential(first, *rest))
            entering = width
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def enter(self, image: Tensor) -> Tensor:
        return self.maxpool(self.relu(self.bn1(self.conv1(self.normalised(image)))))

    def stage(self, index: int, features: Tensor) -> Tensor:
        return self.through(self.get_submodule(f"layer{index + 1}").children(), features)


STEM = (64, 64, 128)  # of VoVNet-99
LAYER_WIDTHS, STAGE_WIDTHS, DEPTHS, LAYERS = (128, 160, 192, 224), (256, 512, 768, 1024), (1, 3, 9, 3), 5


def _unit(name: str, entering: int, leaving: int, size: int, stride: int = 1) -> list[tuple[str, nn.Module]]:
    """Convolution, normalisation, rectifier, named as published."""
    return [
        (f"{name}/conv", nn.Conv2d(entering, leaving, size, stride, size // 2, bias=False)),
        (f"{name}/norm", nn.BatchNorm2d(leaving)),
        (f"{name}/relu", nn.ReLU(inplace=True)),
    ]


class ChannelGate(nn.Module):
    """eSE: every channel is weighed by a hard sigmoid of a linear map of all channels' means."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x * F.hardsigmoid(self.fc(x.mean((2, 3), keepdim=True)))


class OneShotAggregation(nn.Module):
    """A chain of 3x3 convolutions whose outputs are all joined once, at the end."""

    def __init__(self, name: str, entering: int, width: int, leaving: int, shortcut: bool) -> None:
        super().__init__()
        sources = [entering] + [width] * (LAYERS - 1)
        self.layers = nn.ModuleList(
            nn.Sequential(OrderedDict(_unit(f"{name}_{i}", source, width, 3))) for i, source in enumerate(sources)
        )
        self.concat = nn.Sequential(OrderedDict(_unit(f"{name}_concat", entering + LAYERS * width, leaving, 1)))
        self.ese = ChannelGate(leaving)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        outputs = [x]
        for layer in self.layers:
            outputs.append(layer(outputs[-1]))
        joined = self.ese(self.concat(torch.cat(outputs, 1)))
        return joined + x if self.shortcut else joined


class VoVNet99(Backbone):
    """A stem at stride 4 and four stages of 1, 3, 9, 3 modules, each behind a pooling but the first.

    With effective squeeze-and-excitation (Lee & Park 2020, CenterMask) under the names of vovnet-detectron2
    (`stem.stem_1/conv`, `stage2.OSA2_1.layers.0.OSA2_1_0/conv`, `OSA2_1.ese.fc`), which the depth-pretrained weights of
    DD3D carry on and GTRS loads as `img_backbone.*`. They want blue first.
    """

    def __init__(self, settings: BackboneSettings) -> None:
        super().__init__(settings, STAGE_WIDTHS)
        sources = (3, *STEM[:-1])
        stem: OrderedDict[str, nn.Module] = OrderedDict()
        for i, stride in enumerate((2, 1, 2)):
            stem.update(_unit(f"stem_{i + 1}", sources[i], STEM[i], 3, stride))
        self.add_module("stem", nn.Sequential(stem))
        entering = STEM[-1]
        for number, width, leaving, depth in zip((2, 3, 4, 5), LAYER_WIDTHS, STAGE_WIDTHS, DEPTHS):
            stage: OrderedDict[str, nn.Module] = OrderedDict()
            if number > 2:
                stage["Pooling"] = nn.MaxPool2d(3, 2, ceil_mode=True)
            for i in range(depth):
                name = f"OSA{number}_{i + 1}"
                stage[name] = OneShotAggregation(name, entering if i == 0 else leaving, width, leaving, i > 0)
            self.add_module(f"stage{number}", nn.Sequential(stage))
            entering = leaving
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)

    def enter(self, image: Tensor) -> Tensor:
        return self.get_submodule("stem")(self.normalised(image).flip(1))

    def stage(self, index: int, features: Tensor) -> Tensor:
        return self.through(self.get_submodule(f"stage{index + 2}").children(), features)


CLASSIFIERS = ("fc.", "classifier.", "head.")  # of the published networks; not part of a backbone


def build_backbone(settings: BackboneSettings, in_channels: int = 3) -> Backbone:
    """The network with random weights; in_channels other than 3 for residual networks over something not a picture.

    Raises ValueError for settings that make no network.
    """
    if settings.name == "resnet34":
        return ResNet(settings, (64, 128, 256, 512), (3, 4, 6, 3), True, in_channels)
    if settings.name == "small":
        if len(settings.widths) != len(STRIDES):
            raise ValueError(f"backbone.widths are {settings.widths}: give {len(STRIDES)}, one for each stride")
        return ResNet(settings, settings.widths, (1, 1, 1, 1), False, in_channels)
    if in_channels != 3:
        raise ValueError("vovnet99 takes pictures of 3 channels only: use resnet34 or small")
    return VoVNet99(settings)


def set_recompute(model: nn.Module, on: bool) -> None:
    """Whether the backbones of a model that are over pictures keep no activations for the backward pass."""
    for module in model.modules():
        if isinstance(module, Backbone) and module.over_pictures:
            module.recompute = on


def load_pretrained(model: nn.Module) -> dict[str, str]:
    """Loads what every backbone of a model names, and says what that was: module -> "none", or file and sha256.

    Raises ValueError naming what a file lacks or has too much.
    """
    record = {}
    for name, module in model.named_modules():
        if isinstance(module, Backbone):
            path = module.settings.pretrained
            if path is not None:
                _load(module, Path(path))
            record[name or "backbone"] = "none" if path is None else f"{Path(path).name} {file_digest(Path(path))}"
    return record


def _load(backbone: Backbone, path: Path) -> None:
    weights, own = _read(path), backbone.state_dict()
    wanted = {key for key in own if not key.endswith("num_batches_tracked")}  # which older files lack, nothing reads
    prefix = _prefix(wanted, weights, path)
    named = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    named = {key: value for key, value in named.items() if key in own or not key.startswith(CLASSIFIERS)}
    missing, extra = sorted(wanted - set(named)), sorted(set(named) - set(own))
    if missing:
        raise ValueError(f"{path} lacks {listed(missing, 5)} of {backbone.settings.name}")
    if extra:
        raise ValueError(f"{path} has {listed(extra, 5)}, unknown to {backbone.settings.name}: another network's")
    wrong = [f"{k} {tuple(named[k].shape)}, not {tuple(own[k].shape)}" for k in named if named[k].shape != own[k].shape]
    if wrong:
        raise ValueError(f"{path} has other shapes than {backbone.settings.name}: {listed(wrong, 5)}")
    backbone.load_state_dict(named, strict=False)


def _read(path: Path) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise ValueError(f"pretrained: there is no file {path}")
    try:
        content: Any = load_file(path) if path.suffix == ".safetensors" else load_tensors(path)
    except Exception as error:  # whatever a damaged file, or an object that is no tensor, raises
        raise ValueError(f"pretrained: {path} cannot be read as weights: {one_line(error)}") from error
    for wrapper in ("state_dict", "model"):  # as trainers wrap their checkpoints
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping):
        raise ValueError(f"pretrained: {path} holds a {type(content).__name__}, not named tensors")
    return {key: value for key, value in content.items() if isinstance(value, Tensor)}


def _prefix(keys: set[str], weights: Mapping[str, Tensor], path: Path) -> str:
    """What stands before a network's names in a file, such as "img_backbone."; "" where no prefix has all of them.

    Raises ValueError where several have.
    """
    probe = max(keys, key=len)
    candidates = [name.removesuffix(probe) for name in weights if name == probe or name.endswith("." + probe)]
    complete = [prefix for prefix in candidates if all(prefix + key in weights for key in keys)]
    if len(complete) > 1:
        raise ValueError(f"{path} holds such weights under {complete}: keep those of one network in a file")
    return complete[0] if complete else ""
