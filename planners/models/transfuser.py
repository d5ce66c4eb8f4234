"""The fusion of Latent TransFuser: an image network and one over a learned latent view from above talk at four scales.

Chitta et al. 2022, in the form of the public code for NAVSIM (TransfuserBackbone with `latent=True`), from which the
default values are. There the latent stands in a lidar raster's place: the same for every sample, it becomes a picture
of the scene by what it takes from the camera.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from planners.models.backbones import STRIDES, BackboneSettings, build_backbone


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


class Fused(NamedTuple):
    """What comes out."""

    image: Tensor  # (B, C, h / 32, w / 32) of the picture
    latent: Tensor  # (B, C, latent_size / 32, latent_size / 32): what the camera sees, seen from above
    bev: Tensor  # (B, bev_channels, latent_size / 4, latent_size / 4), the same upsampled


class LatentFusion(nn.Module):
    """From a picture to features seen from above."""

    def __init__(self, settings: FusionSettings) -> None:
        super().__init__()
        self.settings = settings
        self.image = build_backbone(settings.backbone)
        own = replace(settings.backbone, pretrained=None)
        self.latent = build_backbone(own, settings.latent_channels)
        self.latent.over_pictures = False
        size = settings.latent_size
        self.picture = nn.Parameter(torch.randn(1, settings.latent_channels, size, size))
        self.channels = self.image.channels
        self.to_image = nn.ModuleList(nn.Conv2d(c, c, 1) for c in self.channels)
        self.to_latent = nn.ModuleList(nn.Conv2d(c, c, 1) for c in self.channels)
        self.exchanges = nn.ModuleList(Exchange(c, settings) for c in self.channels)
        bev = settings.bev_channels
        self.lateral = nn.Conv2d(self.channels[-1], bev, 1)
        self.up = nn.ModuleList(nn.Conv2d(bev, bev, 3, padding=1) for _ in range(2))

    def forward(self, image: Tensor) -> Fused:
        """image: (B, 3, h, w) uint8."""
        seen = self.image.stage(0, self.image.enter(image))
        # Until the first exchange the latent is the same for all samples, and so are its statistics: computed once.
        above = self.latent.stage(0, self.latent.enter(self.picture)).expand(len(image), -1, -1, -1)
        above = above.contiguous(memory_format=torch.channels_last)
        for i in range(len(STRIDES)):
            if i:
                seen, above = self.image.stage(i, seen), self.latent.stage(i, above)
            tokens = F.adaptive_avg_pool2d(seen, self.settings.image_tokens)
            latent_tokens = self.to_image[i](F.adaptive_avg_pool2d(above, self.settings.latent_tokens))
            to_seen, to_above = self.exchanges[i](tokens, latent_tokens)
            seen = seen + _stretched(to_seen, seen)
            above = above + _stretched(self.to_latent[i](to_above), above)
        bev = F.relu(self.lateral(above))
        for convolve, stride in zip(self.up, (STRIDES[-1] // 2, STRIDES[0])):
            size = self.settings.latent_size // stride
            bev = F.relu(convolve(F.interpolate(bev, (size, size), mode="bilinear")))
        return Fused(seen, above, bev)


def _stretched(tokens: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(tokens, like.shape[2:], mode="bilinear")


class Exchange(nn.Module):
    """Transformer blocks over the tokens of both views.

    Published code draws their weights with deviation 0.02 at any width (planners.models.start), which torch's own
    0.58 / sqrt(width) is at the widest, 512. At a narrow planner's 64 that is too little for one view to reach the
    other: 32 samples learnt by heart were 1.05 m off after 150 steps, and are 0.28 m with torch's.
    """

    def __init__(self, width: int, settings: FusionSettings) -> None:
        super().__init__()
        rows, columns = settings.image_tokens
        n = rows * columns + settings.latent_tokens[0] * settings.latent_tokens[1]
        self.position = nn.Parameter(torch.zeros(1, n, width))
        self.dropout = nn.Dropout(settings.dropout)
        self.blocks = nn.Sequential(*(_AttentionBlock(width, settings) for _ in range(settings.layers)))
        self.norm = nn.LayerNorm(width)

    def forward(self, image: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Maps (B, C, rows, columns) of both views, mixed."""
        tokens = torch.cat([image.flatten(2), latent.flatten(2)], 2).transpose(1, 2)
        mixed = self.norm(self.blocks(self.dropout(tokens + self.position))).transpose(1, 2)
        n = image.shape[2] * image.shape[3]
        return mixed[..., :n].reshape(image.shape), mixed[..., n:].reshape(latent.shape)


class _AttentionBlock(nn.Module):
    """Self-attention and a feed-forward part, both behind a normalisation and beside a shortcut."""

    def __init__(self, width: int, settings: FusionSettings) -> None:
        super().__init__()
        self.heads, self.dropout = settings.heads, settings.dropout
        self.norm_attention, self.norm_forward = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        hidden = settings.expansion * width
        self.feed_forward = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))

    def forward(self, x: Tensor) -> Tensor:
        b, n, width = x.shape
        parts = self.query_key_value(self.norm_attention(x)).view(b, n, 3, self.heads, width // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        p = self.dropout if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, dropout_p=p).transpose(1, 2).reshape(b, n, width)
        x = x + F.dropout(self.project(mixed), self.dropout, self.training)
        return x + F.dropout(self.feed_forward(self.norm_forward(x)), self.dropout, self.training)
