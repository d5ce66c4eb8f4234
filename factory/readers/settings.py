"""Which clips of a folder of logs are taken.

Light, like every module of this name: no numpy is loaded for it.
"""

from dataclasses import dataclass
from typing import Literal

STEPS_PER_S = 10  # of clips
Split = Literal["train", "val", "test"]


@dataclass(frozen=True)
class WindowSettings:
    """What a window must be like."""

    stride_s: float = 1.0  # between the starts of two windows of one log
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands
    first: int = 0  # window of a log that is taken; those before it are skipped
    max_speed_mps: float = 100.0  # a track that moves faster between two steps has changed its object

    def __post_init__(self) -> None:
        """Raises ValueError where the stride is no positive multiple of 0.1 s, or the first window is none."""
        if self.stride_steps < 1 or abs(self.stride_steps / STEPS_PER_S - self.stride_s) > 1e-6:
            raise ValueError(f"stride_s must be a positive multiple of {1 / STEPS_PER_S} s, not {self.stride_s}")
        if self.first < 0:
            raise ValueError(f"first_window must be 0 or more, not {self.first}")

    @property
    def stride_steps(self) -> int:
        """The stride in steps of 0.1 s."""
        return round(self.stride_s * STEPS_PER_S)

    @property
    def first_step(self) -> int:
        """Where the first window begins that is taken."""
        return self.first * self.stride_steps


def check_traversals(traversals: int) -> None:
    """Raises ValueError for a number that cannot be."""
    if traversals < 0:
        raise ValueError(f"clips.traversals must be 0 or more, not {traversals}")


class ReaderSettings:
    """What the settings of a built-in reader tell before a clip is read."""

    @property
    def photos_alone(self) -> bool:
        """Whether clips may have photos and no lidar."""
        return False

    @property
    def summary(self) -> str:
        """How many clips these are, and what saw them, for people; empty before they are looked at."""
        return ""

    def rig(self, painted: bool) -> tuple[str, ...]:
        """Names of the cameras, where settings choose them; painted: for pictures by the painter of the data set."""
        return ()


@dataclass(frozen=True)
class LogClips(ReaderSettings):
    """Clips of logs of one format."""

    root: str  # file or folder
    stride_s: float = 1.0  # between the starts of two windows of one log, a multiple of 0.1 s
    min_top_speed_mps: float = 0.5  # an ego that never reaches it stands: no clip
    first_window: int = 0  # of each log; those before it are skipped
    only: tuple[str, ...] = ()  # ids of logs; []: all under the root
    split: Split | None = None  # of every clip; null: the data set's own, else by the hash of the log's id
    traversals: int = 0  # other logs' drives through the same place, at most, that a block's scene is made of as well

    def __post_init__(self) -> None:
        self.windows  # noqa: B018 - raises ValueError for a stride or a first window that cannot be
        check_traversals(self.traversals)

    @property
    def windows(self) -> WindowSettings:
        """Which windows of a log are taken."""
        return WindowSettings(self.stride_s, self.min_top_speed_mps, self.first_window)
