"""What an expert is; experts from a user's own package satisfy it too.

A class, or a function that makes an expert, is told of the run where it takes an argument `run`.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tasks.settings import PdmSettings
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


def tried_once(expert: object) -> bool:
    """Whether an expert, or the class of one, says `once = True`.

    It then drives once a clip, from the log at T, always has a plan, and is kept whatever the reward says, as `human`.
    Any other is tried from where candidates lead, until it has a sample for every round.
    """
    return bool(getattr(expert, "once", False))


class RunContext(Protocol):
    """What an expert is told of its run; factory.setup.settings has more of it."""

    @property
    def pdm(self) -> PdmSettings: ...
