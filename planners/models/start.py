"""Weights to begin a training with as the public code draws them, where torch's own draw of ours is another.

Public: navsim/agents/*/transfuser_backbone.py, GPT._init_weights (OpenDriveLab/SimScale @ f51ad64); timm's ResNet
(`zero_init_last`); torch's MultiheadAttention and, for the cascade, nn.TransformerDecoder's and transfuser_model_v2's
clones of one layer. A backbone over pictures begins from a file there and is drawn as the other one until it is read.
"""

import math
from typing import Literal

from torch import nn

from planners.models.attention import Attention, Decoder
from planners.models.backbones import BasicBlock
from planners.models.transfuser import Exchange

Start = Literal["torch", "public"]  # whose draw weights are
GPT_DEVIATION = 0.02


def begin(model: nn.Module, start: Start) -> None:
    """Draw a planner's weights anew, in place, where `start` says so."""
    if start == "torch":
        return
    for module in model.modules():
        if isinstance(module, Exchange):
            _as_gpt(module)
        elif isinstance(module, BasicBlock):
            nn.init.zeros_(module.bn2.weight)
        elif isinstance(module, Attention):
            _as_torch_s_attention(module)
    for module in model.modules():
        if isinstance(module, Decoder):
            clone_first(module.layers)


def clone_first(layers: nn.ModuleList) -> None:
    """Give all layers the weights of the first."""
    for layer in layers[1:]:
        layer.load_state_dict(layers[0].state_dict())


def _as_gpt(exchange: Exchange) -> None:
    for module in exchange.modules():
        if isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, std=GPT_DEVIATION)
            nn.init.zeros_(module.bias)


def _as_torch_s_attention(attention: Attention) -> None:
    """Query, key and value as parts of one matrix; without biases it is lucidrains', whose maps are plain."""
    for projection in (attention.query, attention.key, attention.value):
        if attention.query.bias is None:
            projection.reset_parameters()
        else:
            nn.init.xavier_uniform_(projection.weight, gain=1.0 / math.sqrt(2.0))
            nn.init.zeros_(projection.bias)
    if attention.out.bias is not None:
        nn.init.zeros_(attention.out.bias)
