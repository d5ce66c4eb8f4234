"""VoVNet-99 with effective squeeze-and-excitation (Lee & Park 2020, CenterMask) under its published parameter names.

They are those of vovnet-detectron2 (`stem.stem_1/conv`, `stage2.OSA2_1.layers.0.OSA2_1_0/conv`, `OSA2_1.ese.fc`),
which the depth-pretrained weights of DD3D carry on and GTRS loads as `img_backbone.*`. They want blue first.
"""

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from planners.models.backbones.base import Backbone, BackboneSettings

STEM = (64, 64, 128)
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
    """A stem at stride 4 and four stages of 1, 3, 9, 3 modules, each behind a pooling but the first."""

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
