"""Multi-head attention and post-norm transformer layers (Vaswani et al. 2017) that never hold a matrix of scores.

torch's own layers take a path of their own in evaluation that does hold it on a CPU: 8 heads x 16,384 x 16,384 numbers
for each sample of a vocabulary that attends to itself. Parameters are as many and as torch's layers have them.
"""

import torch.nn.functional as F
from torch import Tensor, nn


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
