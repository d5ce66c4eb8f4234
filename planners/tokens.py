"""A picture as tokens that trajectories attend to."""

import torch
from torch import Tensor, nn

from planners.backbone import BackboneSettings, build_backbone
from planners.batch import ImageLayout

STRIDE = 32


class PictureTokens(nn.Module):
    """The backbone's last map, a token a cell with a place of its own to learn (as GTRS does with V2-99)."""

    def __init__(self, backbone: BackboneSettings, image: ImageLayout, width: int) -> None:
        super().__init__()
        if image.width % STRIDE or image.height % STRIDE:
            raise ValueError(f"image is {image.width} x {image.height}: both sides must be divisible by {STRIDE}")
        self.backbone = build_backbone(backbone)
        self.narrow = nn.Conv2d(self.backbone.channels[-1], width, 1)
        self.places = nn.Parameter(torch.randn(image.height // STRIDE * (image.width // STRIDE), width))

    def forward(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w) uint8 to (B, h / 32 x w / 32, width)."""
        return self.narrow(self.backbone(image)[-1]).flatten(2).transpose(1, 2) + self.places
