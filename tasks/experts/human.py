"""The human expert: what the log's driver did."""

from dataclasses import dataclass

import numpy as np

from tasks.experts.protocol import Plan
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.vehicle import HEADING


@dataclass(frozen=True)
class Human:
    """Replays the log from the scene's step. At T, `human`, it makes the real samples.

    From a perturbed state, `logged`, it goes to where the log's driver was at each moment, however far that is: what
    a planner would be taught without a pseudo-expert.
    """

    name: str = "human"

    def digest(self) -> str:
        """The log is the clip itself: nothing else goes in."""
        return "human"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        """The logged poses of the next 4 s. Raises ValueError where the clip ends before."""
        after = scene.clip.ego_states[scene.step + 1 : scene.step + 1 + HORIZON_STEPS, : HEADING + 1]
        if len(after) < HORIZON_STEPS:
            raise ValueError(f"the clip ends {len(after)} steps after step {scene.step}; a plan needs {HORIZON_STEPS}")
        return Plan(after.copy())
