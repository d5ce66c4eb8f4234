"""Residual networks (He et al. 2016) under the parameter names of torchvision's and timm's published weights."""

from collections.abc import Sequence

from torch import Tensor, nn

from planners.models.backbones.base import Backbone, BackboneSettings


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
    """Four groups of basic blocks behind a 7x7 stem. `pool`: the published stem, stride 2 twice; else stride 4 at once.

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
