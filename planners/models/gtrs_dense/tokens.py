"""A picture as tokens that trajectories attend to; each cell of a map is one, with a place of its own to learn."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from planners.data.batch import ImageLayout
from planners.models.backbones.base import STRIDES, BackboneSettings
from planners.models.backbones.registry import build_backbone
from planners.models.transfuser import FusionSettings, LatentFusion


class PictureTokens(nn.Module):
    """The backbone's last map: what GTRS-Dense reads with V2-99."""

    def __init__(self, backbone: BackboneSettings, image: ImageLayout, width: int) -> None:
        super().__init__()
        stride = STRIDES[-1]
        if image.width % stride or image.height % stride:
            raise ValueError(f"image is {image.width} x {image.height}: both sides must be divisible by {stride}")
        self.backbone = build_backbone(backbone)
        self.narrow = nn.Conv2d(self.backbone.channels[-1], width, 1)
        self.places = nn.Parameter(torch.randn(image.height // stride * (image.width // stride), width))

    def forward(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w) uint8 to (B, h / 32 x w / 32, width)."""
        return self.narrow(self.backbone(image)[-1]).flatten(2).transpose(1, 2) + self.places


class FusedTokens(nn.Module):
    """LTF's view from above, coarse and fine side by side: what GTRS-Dense reads with ResNet-34."""

    def __init__(self, fusion: FusionSettings, width: int) -> None:
        super().__init__()
        self.fusion = LatentFusion(fusion)
        self.narrow = nn.Conv2d(self.fusion.channels[-1] + fusion.bev_channels, width, 1)
        self.places = nn.Parameter(torch.randn((fusion.latent_size // STRIDES[0]) ** 2, width))

    def forward(self, image: Tensor) -> Tensor:
        """Picture (B, 3, h, w) uint8 to (B, (latent_size / 4)^2, width)."""
        fused = self.fusion(image)
        coarse = F.interpolate(fused.latent, fused.bev.shape[2:], mode="bilinear")
        return self.narrow(torch.cat([coarse, fused.bev], dim=1)).flatten(2).transpose(1, 2) + self.places
