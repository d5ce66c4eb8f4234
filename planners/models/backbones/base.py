"""What an image backbone is: four feature maps at strides 4, 8, 16, 32 from a picture."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor, nn

from planners.models.backbones.recompute import recomputed

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of red, green, blue in 0 .. 1
STRIDES = (4, 8, 16, 32)


@dataclass(frozen=True)
class BackboneSettings:
    """Which network, and where its weights come from."""

    name: Literal["resnet34", "vovnet99", "small"] = "resnet34"
    pretrained: str | None = None  # .safetensors, .pth or .pt under the published names; null: random weights
    prefix: str = ""  # before the names in that file, such as "img_backbone."; entries without it are not read
    widths: tuple[int, ...] = (16, 32, 64, 128)  # of `small`, one residual block each
    pixels: Literal["imagenet", "unit"] = "imagenet"  # 0 .. 255 become ImageNet's mean 0 and deviation 1, or 0 .. 1
    frozen_norm: bool = False  # normalisations keep their statistics in training; scale and shift are learned


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
        self.register_load_state_dict_post_hook(_weights_came)

    def normalised(self, image: Tensor) -> Tensor:
        """uint8 RGB (B, 3, h, w) as the float that `pixels` says; a float input as it is.

        Raises RuntimeError where the settings name weights that nobody loaded.
        """
        if self.weights_missing:
            raise RuntimeError(
                f"weights {self.settings.pretrained} are named but not loaded: call backbones.registry.load_pretrained"
            )
        image = image.contiguous(memory_format=torch.channels_last)  # a third faster in training on a CPU core
        if image.dtype != torch.uint8:
            return image
        return torch.addcmul(self.get_buffer("shift"), image, self.get_buffer("scale"))

    def through(self, blocks: Iterable[nn.Module], features: Tensor) -> Tensor:
        """The features after one block after the other."""
        again = self.recompute and torch.is_grad_enabled()
        for block in blocks:
            features = recomputed(block, features) if again else block(features)
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


def _weights_came(module: nn.Module, _: object) -> None:
    assert isinstance(module, Backbone)
    module.weights_missing = False
