"""The log's own drive as an expert: from T, and from perturbed states."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tasks.experts.protocol import Plan
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.frames import HEADING


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
