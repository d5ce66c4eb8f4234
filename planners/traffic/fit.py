"""The fit of the imitation policy's network, in torch; tasks/rollout/learned/imitation.py is the same in numpy."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from planners.traffic.lessons import Lessons
from tasks.rollout.learned.imitation import ACCELERATION_SCALE, MOST_BESIDE, NetworkWeights
from tasks.rollout.learned.look import NEAR, NEIGHBOURS, OWN, PURSUIT

SLOWEST_MPS, FASTEST_MPS = 3.0, 12.0  # at which an error of curvature is counted
OVERLOOKS = 0.4  # of the rows
HALF_A_METRE = 0.5  # beside the log after a second: as bad as 1 m/s2


@dataclass(frozen=True)
class NetworkSettings:
    """The network and its fit."""

    neighbour_width: int = 24
    width: int = 48
    epochs: int = 20  # of each round
    batch: int = 1024
    learning_rate: float = 2e-3  # falls to 0 by half a cosine within a round
    weight_decay: float = 1e-2

    def __post_init__(self) -> None:
        for name in ("neighbour_width", "width", "epochs", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: must be positive")
        if not self.learning_rate > 0.0 or not self.weight_decay >= 0.0:
            raise ValueError(f"learning_rate={self.learning_rate} must be positive, weight_decay not negative")


class Network(nn.Module):
    """What a vehicle sees to what it wants."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.near = nn.Linear(NEAR, settings.neighbour_width)
        self.first = nn.Linear(OWN + settings.neighbour_width, settings.width)
        self.second = nn.Linear(settings.width, settings.width)
        self.last = nn.Linear(settings.width, 2)

    def forward(self, own: Tensor, near: Tensor, there: Tensor) -> Tensor:
        """(A, 2) acceleration [m/s2], curvature [1/m] of own (A, OWN), near (A, NEIGHBOURS, NEAR) and who is there."""
        pooled = (functional.relu(self.near(near)) * there[..., None]).amax(dim=1)
        hidden = functional.relu(self.first(torch.cat([own, pooled], dim=1)))
        last = self.last(functional.relu(self.second(hidden)))
        curvature = own[:, PURSUIT] + MOST_BESIDE * last[:, 1].tanh()
        return torch.stack([ACCELERATION_SCALE * last[:, 0], curvature], dim=1)

    @property
    def weights(self) -> NetworkWeights:
        """As the policy has them."""
        layers: Sequence[nn.Linear] = (self.near, self.first, self.second, self.last)
        arrays = [
            np.ascontiguousarray(tensor.detach().numpy().T, np.float64)
            for layer in layers
            for tensor in (layer.weight, layer.bias)
        ]
        return NetworkWeights(*arrays)


def there_are(count: Tensor) -> Tensor:
    """(A, NEIGHBOURS) of counts (A,)."""
    return torch.arange(NEIGHBOURS) < count[:, None]


def overlooked(there: Tensor, chance: torch.Generator) -> Tensor:
    """With neighbours left out of part of the rows: logs hold no empty roads. The leader is seen apart from them."""
    left_out = (torch.rand((len(there), 1), generator=chance) - (1.0 - OVERLOOKS)).clamp_min(0.0) / OVERLOOKS
    return there & (torch.rand(there.shape, generator=chance) >= left_out)


def loss_of(wanted: Tensor, lessons: Sequence[Tensor]) -> Tensor:
    """Huber's, of accelerations in m/s2 and of where curvatures lead in a second."""
    own, _, _, wants, known = lessons
    speed = (10.0 * own[:, :1]).clamp(SLOWEST_MPS, FASTEST_MPS)
    scale = torch.cat([torch.ones_like(speed), 0.5 * speed * speed / HALF_A_METRE], dim=1)
    off = functional.huber_loss(wanted * scale, wants * scale, reduction="none")
    return (off * known).sum() / known.sum()


def fit(network: Network, lessons: Lessons, settings: NetworkSettings, seed: int) -> float:
    """A round of the fit, in place; the last epoch's mean loss. The same seed and thread count, the same weights."""
    arrays = [torch.from_numpy(array) for array in vars(lessons).values()]
    order = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )  # fmt: skip
    n_batches = -(-len(lessons) // settings.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs * n_batches)
    total = 0.0
    for _ in range(settings.epochs):
        total = 0.0
        for rows in torch.randperm(len(lessons), generator=order).split(settings.batch):
            batch = [array[rows] for array in arrays]
            own, near, count = batch[:3]
            loss = loss_of(network(own, near, overlooked(there_are(count), order)), batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
    return total / n_batches


def held_out_error(network: Network, lessons: Lessons) -> tuple[float, float]:
    """Root mean squares of what is known: of acceleration [m/s2], and of the place beside in a second [m]."""
    with torch.no_grad():
        own, near, count = (torch.from_numpy(array) for array in (lessons.own, lessons.near, lessons.count))
        wanted = network(own, near, there_are(count)).numpy()
    off, known = wanted - lessons.wants, lessons.known > 0.0
    speed = 10.0 * lessons.own[:, 0]
    beside = 0.5 * speed**2 * off[:, 1]
    of = (off[known[:, 0], 0], beside[known[:, 1]])
    acceleration, place = (float(np.sqrt(np.mean(values**2))) if len(values) else np.nan for values in of)
    return acceleration, place
