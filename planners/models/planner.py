"""What a planner is: settings, model, loss, decode; and planners by name, or by a class of a user's own package.

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
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from factory.config.compose import ConfigError
from planners.data.batch import COMMANDS, Batch, Needs, TrainingData
from planners.models.settings import NO_PLANNER, PlanFrom, PlannerChoice, Status, named_class, settings_of
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

        Raises ValueError with the setting to fix.
        """
        return {}

    @property
    @abstractmethod
    def needs(self) -> Needs:
        """What it reads of a sample."""

    @property
    def needs_to_plan(self) -> Needs:
        """What of it `plan` looks at; less where auxiliary losses want more than planning does."""
        return replace(self.needs, labels=None)

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted scalar terms whose sum is minimised.

        Terms that imitate count samples with `batch.imitate` only, and are divided by the whole batch: a mean over the
        mixture in which a sample without a label weighs nothing (paper, eq. 5).
        """

    @abstractmethod
    def plan(self, batch: Batch) -> Tensor:
        """Plans (B, 8, 3) at 0.5 .. 4.0 s or (B, 40, 3) at 0.1 .. 4.0 s; the same for the same batch, always.

        But for those of DiffusionDrive in its variant `public`, which are as random as the public code's.
        """

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The losses: what a distributed wrapper calls."""
        return self.losses(batch)


def read_array(path: str, setting: str) -> NDArray[Any]:
    """The array in a .npy file. Raises ValueError naming the setting and the file."""
    try:
        loaded = np.load(Path(path), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{setting}={path}: not readable as a .npy file: {error}") from error
    if not isinstance(loaded, np.ndarray):
        raise ValueError(f"{setting}={path}: expected one array, found an archive of several")
    return loaded


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


def visible_status(which: Status, status: Tensor) -> Tensor:
    """(B, 8) of a batch's status, zeros for what is not seen.

    Acceleration tells what the log's driver is already doing, bend and brake, and a planner that drives on its own
    errors is told what these are doing: it goes on with them (de Haan et al. 2019, causal confusion).
    """
    if which == "all":
        return status
    known = len(COMMANDS) + 2
    return torch.cat([status[:, :known], torch.zeros_like(status[:, known:])], -1)


def imitation_l1(plan: Tensor, batch: Batch) -> Tensor:
    """Mean absolute error of x, y [m] and heading [rad] of plans (B, 8, 3) against the labels.

    Samples without `batch.imitate` weigh nothing, the sum is divided by the whole batch (paper, eq. 5).
    """
    error = (plan.float() - batch.plan_2hz).abs().mean(dim=(1, 2))
    return torch.where(batch.imitate, error, 0.0).mean()


def add_base_plan(base: PlanFrom, regressed: Tensor, batch: Batch) -> Tensor:
    """The plans (B, 8, 3) of what was regressed."""
    return regressed + constant_velocity_plan(batch) if base == "constant_velocity" else regressed


def constant_velocity_plan(batch: Batch) -> Tensor:
    """(B, 8, 3) poses at 0.5 .. 4.0 s of an ego that keeps the speed of now and does not turn.

    Speed is the length of the velocity, as in navsim/agents/constant_velocity_agent.py (autonomousvision/navsim
    @ 0a380a9).
    """
    times_s = torch.arange(1, 9, device=batch.status.device) * 0.5
    velocity = batch.status[:, len(COMMANDS) : len(COMMANDS) + 2].float()
    ahead = (velocity**2).sum(-1, keepdim=True).sqrt() * times_s
    return torch.stack([ahead, torch.zeros_like(ahead), torch.zeros_like(ahead)], -1)


def planner_class(name: str) -> type[Planner]:
    """The class of a planner. Raises ConfigError where there is none of that name."""
    cls = named_class(name)
    if not (isinstance(cls, type) and issubclass(cls, Planner)):
        raise ConfigError(NO_PLANNER.format(name))
    return cls


def build_planner(choice: PlannerChoice, arrays: Mapping[str, FloatArray]) -> Planner:
    """The planner around its fixed arrays. Raises ConfigError."""
    try:
        planner = planner_class(choice.name)(settings_of(choice), arrays)
    except ValueError as error:
        raise ConfigError(f"planner {choice.name}: {error}") from error
    planner.chosen_as = choice.name
    return planner
