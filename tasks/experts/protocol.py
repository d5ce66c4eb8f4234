"""What an expert is, and the log's own drive as one; experts from a user's own package satisfy the protocol too.

A class, or a function that makes an expert, is told of the run where it takes an argument `run`.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from tasks.settings import PdmSettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.frames import HEADING


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


def drives_once_per_clip(expert: object) -> bool:
    """Whether an expert, or the class of one, says `once = True`.

    It then drives once a clip, from the log at T, always has a plan, and is kept whatever the reward says, as `human`.
    Any other is tried from where candidates lead, until it has a sample for every round.
    """
    return bool(getattr(expert, "once", False))


class RunContext(Protocol):
    """What an expert is told of its run; factory.setup.settings has more of it."""

    @property
    def pdm(self) -> PdmSettings: ...


@dataclass(frozen=True)
class Human:
    """What the log's driver did from T: it makes the real samples, one a clip."""

    name: str = "human"
    once: ClassVar[bool] = True

    def digest(self) -> str:
        """The log is the clip itself: nothing else goes in."""
        return "human"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        """The logged poses of the next 4 s. Raises ValueError where the clip ends before."""
        after = scene.clip.ego_states[scene.step + 1 : scene.step + 1 + HORIZON_STEPS, : HEADING + 1]
        if len(after) < HORIZON_STEPS:
            raise ValueError(f"the clip ends {len(after)} steps after step {scene.step}; a plan needs {HORIZON_STEPS}")
        return Plan(after.copy())


@dataclass(frozen=True)
class Logged(Human):
    """From a perturbed state to where the log's driver was at each moment, however far that is.

    What a planner would be taught without a pseudo-expert.
    """

    name: str = "logged"
    once: ClassVar[bool] = False
