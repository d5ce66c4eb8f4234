"""What a planner asks of a sample, and what it is given: the contract between the loader and the planners."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tasks.settings import constant
from tasks.world.arrays import F32, FloatArray
from tasks.world.commands import CommandRule

if TYPE_CHECKING:  # PyTorch is imported where something is computed: settings are read without it
    import torch
    from torch import Tensor

COMMANDS = ("left", "straight", "right", "unknown")  # order of the one-hot driving command


def one_hot_command(command: str) -> F32:
    """(4,) in the order of COMMANDS. Raises ValueError for another."""
    return (np.arange(len(COMMANDS)) == COMMANDS.index(command)).astype(np.float32)


@dataclass(frozen=True)
class ImageLayout:
    """One wide picture: three front cameras side by side, cut so that they hardly overlap, then resized.

    The cuts are those of the public Latent TransFuser: 28 of 1080 rows above and below, 416 of 1920 columns on either
    side of the left and the right camera, which makes 4096 x 1024 of three 1920 x 1080 pictures.
    """

    cameras: tuple[str, ...] = ()  # left to right; empty: the front camera and its neighbours, by their yaw
    width: int = 2048  # pixels of the stitched picture
    height: int = 512
    rows_cut: float = constant(28 / 1080)  # share of the height, above and below
    sides_cut: float = constant(416 / 1920)  # share of the width, on both sides of every camera but the middle one
    decoding: Literal["reduced", "full"] = constant("reduced")  # full: public planners', see planners.data.images


@dataclass(frozen=True)
class BevLayout:
    """A raster from above in the ego frame: row 0 is farthest ahead, column 0 farthest left; one class a cell.

    A public planner's lies the other way round: row 0 is nearest, column 0 farthest right.
    """

    ahead_m: float = 32.0
    behind_m: float = 0.0
    side_m: float = 32.0  # to either side
    cell_m: float = 0.25
    times_s: tuple[float, ...] = (0.0,)  # one raster each, with the agents as they were then; now or before
    public: bool = constant(False)  # drawn as the public code's targets, see planners.data.bev

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return round((self.ahead_m + self.behind_m) / self.cell_m), round(2 * self.side_m / self.cell_m)


@dataclass(frozen=True)
class Needs:
    """What a planner reads of a sample beyond ego status, history, command and plans."""

    image: ImageLayout | None = None
    bev: BevLayout | None = None
    n_agents: int = 0  # the nearest that many agents inside `bev`, as boxes
    labels: str | None = None  # digest of the vocabulary whose scores are wanted
    normalise: Literal["pairs", "batch", "masked"] = "masked"  # of the labels' EP, see tasks.reward.label_bytes
    command: CommandRule = "navsim"  # the rows' own; another is made of their route


@dataclass(frozen=True)
class Batch:
    """B samples. Poses are x, y [m], heading [rad], rear axle, in the frame of the ego at now."""

    attempt_ids: tuple[str, ...]
    status: Tensor  # (B, 8) float32: command one-hot (COMMANDS), vx, vy [m/s], ax, ay [m/s2]
    history: Tensor  # (B, 4, 3) float32, -1.5, -1.0, -0.5, 0 s
    plan_2hz: Tensor  # (B, 8, 3) float32 label, 0.5 .. 4.0 s
    plan_10hz: Tensor  # (B, 40, 3) float32 label, 0.1 .. 4.0 s
    simulated: Tensor  # (B,) bool
    imitate: Tensor  # (B,) bool: whether the plan is a label to be imitated
    image: Tensor | None = None  # (B, 3, height, width) uint8 RGB
    bev: Tensor | None = None  # (B, T, rows, columns) uint8, planners.data.bev.BevClass
    agents: Tensor | None = None  # (B, N, 5) float32: centre x, y, heading, length, width
    agents_valid: Tensor | None = None  # (B, N) bool
    labels: Mapping[str, Tensor] | None = None  # tasks.subscores.LABELLED -> (B, K) float32

    def __len__(self) -> int:
        return len(self.attempt_ids)

    def parts(self, n: int) -> list[Batch]:
        """The same samples in n batches of equal size, in order. Raises ValueError where they do not divide."""
        if len(self) % n:
            raise ValueError(f"a batch of {len(self)} does not divide into {n} parts of equal size")
        size = len(self) // n

        def cut(value: Any, start: int) -> Any:
            if isinstance(value, Mapping):
                return {k: cut(v, start) for k, v in value.items()}
            return None if value is None else value[start : start + size]

        return [replace(self, **{f.name: cut(getattr(self, f.name), i * size) for f in fields(self)}) for i in range(n)]

    def to(self, device: torch.device | str) -> Batch:
        """The same on a device."""
        from torch import Tensor

        def moved(value: Any) -> Any:
            if isinstance(value, Tensor):
                return value.to(device, non_blocking=True)
            return {k: moved(v) for k, v in value.items()} if isinstance(value, Mapping) else value

        return replace(self, **{f.name: moved(getattr(self, f.name)) for f in fields(self)})


@dataclass(frozen=True)
class TrainingData:
    """What a planner may look at when it is built for a training."""

    labels_2hz: Callable[[], FloatArray]  # (n, 8, 3) of every sample to be trained on; read when called
    label_vocabulary: str | None  # digest of the vocabulary that all samples are labelled with; None: no labels
