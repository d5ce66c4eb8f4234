"""What a planner is: settings, model, loss, decode. One file is one planner.

A planner's file has a frozen dataclass of settings and a `Planner` made from it:

    class Mine(Planner):
        name = "mine"
        settings_type = MySettings
        def __init__(self, settings: MySettings, arrays: Mapping[str, NDArray]) -> None: ...

`arrays` are what it is built around and does not learn, such as a vocabulary or anchors: `fixed_arrays` makes them when
a training begins, and checkpoints carry them.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from planners.data.batch import Batch, Needs, TrainingData
from tasks.world.arrays import FloatArray


class Planner(nn.Module, ABC):
    """From what a car sees to where it goes in the next 4 s."""

    name: ClassVar[str]
    settings_type: ClassVar[type]  # the frozen dataclass that `settings` is
    free_settings: ClassVar[frozenset[str]] = frozenset()  # of planning alone: they may be changed after training

    def __init__(self, settings: Any, arrays: Mapping[str, FloatArray]) -> None:
        """settings: the planner's own frozen dataclass. Raises ValueError where an array has the wrong shape."""
        super().__init__()
        self.settings, self.arrays = settings, dict(arrays)
        self.chosen_as = self.name  # in configurations and checkpoints: the registry's name, or my.module:MyPlanner

    @classmethod
    def fixed_arrays(cls, settings: Any, data: TrainingData) -> dict[str, FloatArray]:
        """What the planner is built around, from files the settings name or from the training data.

        Raises ValueError with the setting to mend.
        """
        return {}

    @property
    @abstractmethod
    def needs(self) -> Needs:
        """What it reads of a sample."""

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted scalar terms whose sum is minimised.

        Terms that imitate count samples with `batch.imitate` only, and are divided by the whole batch: a mean over the
        mixture in which a sample without a label weighs nothing (paper, eq. 5).
        """

    @abstractmethod
    def plan(self, batch: Batch) -> Tensor:
        """Plans (B, 8, 3) at 0.5 .. 4.0 s or (B, 40, 3) at 0.1 .. 4.0 s; the same for the same batch, always."""

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The losses: what a distributed wrapper calls."""
        return self.losses(batch)


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Evaluation mode without gradients inside, the mode of before after it: for `plan`, whoever calls it."""
    before = model.training
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        model.train(before)
