"""What planners are built of: attention, Latent TransFuser's fusion, heads for what is learnt beside planning.

Attention and post-norm transformer layers (Vaswani et al. 2017) never hold a matrix of scores. torch's own layers take
a path of their own in evaluation that does hold it on a CPU: 8 heads x 16,384 x 16,384 numbers for each sample of a
vocabulary that attends to itself. Parameters are as many and as torch's layers have them.

The fusion (Chitta et al. 2022) has the form of the public code for NAVSIM (TransfuserBackbone with `latent=True`), from
which the default values are: an image network and one over a learned latent view from above talk at four scales. There
the latent stands in a lidar raster's place: the same for every sample, it becomes a picture of the scene by what it
takes from the camera. Beside planning it is learned where things are, as classes of cells and as boxes of vehicles:
heads, losses and constants of the public TransfuserModel and transfuser_loss.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from planners.data.batch import Batch
from planners.data.bev import BevClass
from planners.models.backbones import BasicBlock, build_backbone
from planners.models.settings import STRIDES, FusionSettings


class Attention(nn.Module):
    """Queries (B, Q, width) over values (B, N, width); dropout on what is attended to, in training.

    `bias`: whether its four linear maps have one.
    """

    def __init__(self, width: int, heads: int, dropout: float = 0.0, bias: bool = True) -> None:
        super().__init__()
        if width % heads:
            raise ValueError(f"width {width} is not divisible by heads {heads}")
        self.heads, self.dropout = heads, dropout
        self.query, self.key = nn.Linear(width, width, bias), nn.Linear(width, width, bias)
        self.value, self.out = nn.Linear(width, width, bias), nn.Linear(width, width, bias)
        for projection in (self.query, self.key, self.value):
            nn.init.xavier_uniform_(projection.weight)

    def forward(self, queries: Tensor, values: Tensor) -> Tensor:
        def split(x: Tensor) -> Tensor:  # (B, heads, N, width / heads)
            return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

        attended = F.scaled_dot_product_attention(
            split(self.query(queries)),
            split(self.key(values)),
            split(self.value(values)),
            dropout_p=self.dropout if self.training else 0.0,
        )
        return self.out(attended.transpose(1, 2).flatten(2))


class Layer(nn.Module):
    """Self-attention, attention to a memory where `crosses`, feed-forward; each added and normalised.

    `bias`: whether the linear maps of self-attention have one.
    """

    def __init__(
        self, width: int, heads: int, feedforward: int, crosses: bool, dropout: float = 0.0, bias: bool = True
    ) -> None:
        super().__init__()
        self.own = Attention(width, heads, dropout, bias)
        self.own_norm = nn.LayerNorm(width)
        self.cross = Attention(width, heads, dropout) if crosses else None
        self.cross_norm = nn.LayerNorm(width) if crosses else None
        self.feedforward = nn.Sequential(
            nn.Linear(width, feedforward), nn.ReLU(), nn.Dropout(dropout), nn.Linear(feedforward, width)
        )
        self.feedforward_norm = nn.LayerNorm(width)
        self.drop = nn.Dropout(dropout)

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor:
        """x (B, Q, width), or (1, Q, width) for B times the same; memory (B, N, width) where the layer crosses."""
        x = self.own_norm(x + self.drop(self.own(x, x)))
        if self.cross is not None and self.cross_norm is not None:
            assert memory is not None
            x = x.expand(len(memory), -1, -1)
            x = self.cross_norm(x + self.drop(self.cross(x, memory)))
        return self.feedforward_norm(x + self.drop(self.feedforward(x)))


class Decoder(nn.Module):
    """Layers of queries that attend to each other and to a memory."""

    def __init__(self, width: int, heads: int, feedforward: int, layers: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(width, heads, feedforward, True, dropout) for _ in range(layers))

    def forward(self, queries: Tensor, memory: Tensor) -> Tensor:
        for layer in self.layers:
            queries = layer(queries, memory)
        return queries


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
        self.exchanges = nn.ModuleList(TokenExchange(c, settings) for c in self.channels)
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
            seen = seen + _resized_like(to_seen, seen)
            above = above + _resized_like(self.to_latent[i](to_above), above)
        bev = F.relu(self.lateral(above))
        for convolve, stride in zip(self.up, (STRIDES[-1] // 2, STRIDES[0])):
            size = self.settings.latent_size // stride
            bev = F.relu(convolve(F.interpolate(bev, (size, size), mode="bilinear")))
        return Fused(seen, above, bev)


def _resized_like(tokens: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(tokens, like.shape[2:], mode="bilinear")


class TokenExchange(nn.Module):
    """Transformer blocks over the tokens of both views.

    Published code draws their weights with deviation 0.02 at any width (planners.models.layers), which torch's own
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


N_CLASSES = 7  # background .. pedestrian, as published: a cell of the route counts as centre line
IN_VIEW_RAD = 4 * math.pi / 9  # to either side of ahead: the cameras do not show the vehicles beyond


class BevHead(nn.Module):
    """Features from above to scores of the classes of every cell."""

    def __init__(self, channels: int, shape: tuple[int, int]) -> None:
        super().__init__()
        self.shape = shape
        self.layers = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, N_CLASSES, 1)
        )

    def forward(self, bev: Tensor) -> Tensor:
        """(B, channels, n, n) to logits (B, N_CLASSES, rows, columns)."""
        return F.interpolate(self.layers(bev), self.shape, mode="bilinear")


def bev_loss(logits: Tensor, bev: Tensor) -> Tensor:
    """Cross-entropy of logits (B, N_CLASSES, rows, columns) against the newest of rasters (B, T, rows, columns)."""
    wanted = bev[:, -1].long()
    return F.cross_entropy(logits, torch.where(wanted == int(BevClass.ROUTE), int(BevClass.CENTERLINE), wanted))


class AgentHead(nn.Module):
    """One vehicle a query: its box, and how sure it is that there is one."""

    def __init__(self, width: int, hidden: int, reach_m: float) -> None:
        super().__init__()
        self.reach_m = reach_m
        self.box = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, 5))
        self.there = nn.Linear(width, 1)

    def forward(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Queries (B, N, width) to boxes (B, N, 5), centre x, y, heading, length, width, and logits (B, N)."""
        centre, heading, size = self.box(queries).float().split([2, 1, 2], dim=-1)
        boxes = torch.cat([centre.tanh() * self.reach_m, heading.tanh() * math.pi, size], -1)
        return boxes, self.there(queries)[..., 0].float()


def agent_losses(
    boxes: Tensor, logits: Tensor, agents: Tensor, valid: Tensor, class_weight: float, box_weight: float
) -> tuple[Tensor, Tensor]:
    """Cross-entropy of being there, and L1 of the boxes summed over their five numbers, a vehicle's mean; unweighted.

    boxes, agents (B, N, 5); logits, valid (B, N). Predictions and vehicles are matched one to one, at the least sum of
    both terms (of the boxes the centre alone) under their weights. Vehicles outside IN_VIEW_RAD do not count.
    """
    valid = valid & (torch.atan2(agents[..., 1], agents[..., 0]).abs() <= IN_VIEW_RAD)
    chosen = _matching(boxes, logits, agents, valid, class_weight, box_weight)
    agents = agents.gather(1, chosen[..., None].expand_as(agents))
    there = valid.gather(1, chosen).float()
    off = ((boxes - agents).abs().sum(-1) * there).sum() / there.sum().clamp(min=1.0)
    return F.binary_cross_entropy_with_logits(logits, there), off


@torch.no_grad()
def _matching(
    boxes: Tensor, logits: Tensor, agents: Tensor, valid: Tensor, class_weight: float, box_weight: float
) -> Tensor:
    """(B, N) int64: which vehicle, or which empty place, each prediction answers for."""
    there = valid[:, None, :].float().expand(-1, logits.shape[1], -1)  # (B, predictions, vehicles)
    unsure = F.binary_cross_entropy_with_logits(logits[:, :, None].expand_as(there), there, reduction="none")
    apart = (boxes[:, :, None, :2] - agents[:, None, :, :2]).abs().sum(-1) * there
    cost = (class_weight * unsure + box_weight * apart).cpu().numpy()
    columns = [torch.from_numpy(linear_sum_assignment(c)[1]) for c in cost]
    return torch.stack(columns).to(boxes.device)


def auxiliary_losses(settings: Any, batch: Batch, bev: Tensor, boxes: Tensor, logits: Tensor) -> dict[str, Tensor]:
    """The terms of a planner by the weights of its settings, of the outputs of both heads."""
    if batch.bev is None or batch.agents is None or batch.agents_valid is None:
        raise ValueError("a batch without view from above or agents cannot be learned from")
    weights = settings.agent_class_weight, settings.agent_box_weight
    there, box = agent_losses(boxes, logits, batch.agents, batch.agents_valid, *weights)
    return {
        "agent_class": weights[0] * there,
        "agent_box": weights[1] * box,
        "bev": settings.bev_weight * bev_loss(bev, batch.bev),
    }


GPT_DEVIATION = 0.02


def initialise_as_public(model: nn.Module) -> None:
    """Draw a planner's weights anew, in place, as the public code draws them.

    That is navsim/agents/*/transfuser_backbone.py, GPT._init_weights (OpenDriveLab/SimScale @ f51ad64); timm's ResNet
    (`zero_init_last`); torch's MultiheadAttention and, for the cascade, nn.TransformerDecoder's and
    transfuser_model_v2's clones of one layer. A backbone over pictures begins from a file there and is drawn as the
    other one until it is read.
    """
    for module in model.modules():
        if isinstance(module, TokenExchange):
            for linear in (part for part in module.modules() if isinstance(part, nn.Linear)):
                nn.init.normal_(linear.weight, std=GPT_DEVIATION)
                nn.init.zeros_(linear.bias)
        elif isinstance(module, BasicBlock):
            nn.init.zeros_(module.bn2.weight)
        elif isinstance(module, Attention):
            _init_as_torch_attention(module)
    for module in model.modules():
        if isinstance(module, Decoder):
            copy_first_layer(module.layers)


def copy_first_layer(layers: nn.ModuleList) -> None:
    """Give all layers the weights of the first."""
    for layer in layers[1:]:
        layer.load_state_dict(layers[0].state_dict())


def _init_as_torch_attention(attention: Attention) -> None:
    """Query, key and value as parts of one matrix; without biases it is lucidrains', whose maps are plain."""
    for projection in (attention.query, attention.key, attention.value):
        if attention.query.bias is None:
            projection.reset_parameters()
        else:
            nn.init.xavier_uniform_(projection.weight, gain=1.0 / math.sqrt(2.0))
            nn.init.zeros_(projection.bias)
    if attention.out.bias is not None:
        nn.init.zeros_(attention.out.bias)
