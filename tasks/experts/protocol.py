"""What an expert is; experts from a user's own package satisfy it too."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import Scene


@dataclass(frozen=True)
class Plan:
    """What an expert wants to drive."""

    poses: Array  # (40, 3) world frame x, y, heading, at 0.1 .. 4.0 s after the scene's step


class Expert(Protocol):
    """Plans H seconds from a scene. Pure: the same scene and rng give the same plan."""

    @property
    def name(self) -> str:
        """As in `experts=[...]`."""
        ...

    def digest(self) -> str:
        """Identifies the expert's inputs and settings (tables, constants); part of the attempt id."""
        ...

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The plan, or why there is none."""
        ...
