"""A planner and a loader small enough to train in a test's blink."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from planners.data.batch import Batch, Needs
from planners.models.planner import FloatArray, Planner, TrainingData


@dataclass(frozen=True)
class ToySettings:
    hidden: int = 8
    dropout: float = 0.5  # random on purpose: only the right seeds bring the same curve back


class Toy(Planner):
    name: ClassVar[str] = "tests.planners.toy:Toy"
    settings_type = ToySettings

    def __init__(self, settings: ToySettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)
        self.net = nn.Sequential(
            nn.Linear(8, settings.hidden), nn.ReLU(), nn.Dropout(settings.dropout), nn.Linear(settings.hidden, 24)
        )

    @classmethod
    def fixed_arrays(cls, settings: ToySettings, data: TrainingData) -> dict[str, FloatArray]:
        return {"mean_plan": data.labels_2hz().mean(axis=0)}

    @property
    def needs(self) -> Needs:
        return Needs()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        error = (self.net(batch.status).reshape(-1, 8, 3) - batch.plan_2hz) ** 2
        per_sample = error.mean(dim=(1, 2)) * batch.imitate
        return {"imitation": per_sample.mean(), "size": 1e-3 * sum(p.square().mean() for p in self.parameters())}

    def plan(self, batch: Batch) -> Tensor:
        return self.net(batch.status).reshape(-1, 8, 3)


def toy_batch(rows: np.ndarray[Any, Any]) -> Batch:
    """The samples of these numbers; a sample's plan is a linear function of its status."""
    rng = np.random.default_rng(0)
    to_plan = torch.from_numpy(rng.normal(size=(8, 24)).astype(np.float32))
    status = torch.from_numpy(np.stack([np.random.default_rng(int(r)).normal(size=8) for r in rows]).astype(np.float32))
    plan = (status @ to_plan).reshape(-1, 8, 3)
    n = len(rows)
    return Batch(
        tuple(str(r) for r in rows),
        status,
        torch.zeros(n, 4, 3),
        plan,
        plan.repeat_interleave(5, dim=1),
        torch.zeros(n, dtype=torch.bool),
        torch.ones(n, dtype=torch.bool),
    )


class ToyBatches:
    """n samples in a seeded order; this rank's share of every batch."""

    def __init__(self, n: int, size: int, rank: int = 0, world: int = 1) -> None:
        self.n, self.size, self.rank, self.world = n, size, rank, world
        self.at = {"epoch": 0, "next": 0}

    def n_batches(self, epoch: int) -> int:
        return self.n // self.size

    def epoch(self, epoch: int) -> Iterator[Batch]:
        order = np.random.default_rng(epoch).permutation(self.n)
        for i in range(self.at["next"], self.n_batches(epoch)):
            mine = order[i * self.size : (i + 1) * self.size][self.rank :: self.world]
            self.at = {"epoch": epoch, "next": i + 1}
            yield toy_batch(mine)
        self.at = {"epoch": epoch + 1, "next": 0}

    def state(self) -> dict[str, Any]:
        return dict(self.at)

    def resume(self, state: Mapping[str, Any]) -> None:
        self.at = dict(state)
