"""The follow-up expert of two-stage benchmarks: PDM-Closed from where a perturbation leads, whatever its reward.

A hard scene is allowed to be hard: its drive is a label to look at, not one that must have been good.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from tasks.experts.pdm_closed.planner import DEFAULTS, PdmClosed, PdmSettings
from tasks.experts.protocol import Plan
from tasks.stages import Rejected
from tasks.world.clip import Scene

BEFORE_STEPS = 5  # the earlier frame of a pair: 0.5 s, over which extended comfort compares two plans


@dataclass(frozen=True)
class FollowUp:
    """PDM-Closed from T+H; with `before` the sample is the frame 0.5 s earlier of the same drive."""

    settings: PdmSettings = DEFAULTS
    before: bool = False

    @property
    def name(self) -> str:
        """As in `experts=[...]`."""
        return "follow_up_before" if self.before else "follow_up"

    def digest(self) -> str:
        """Of every setting."""
        return hashlib.sha256(repr((self.settings, self.before)).encode()).hexdigest()[:16]

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """PDM-Closed's."""
        return PdmClosed(self.settings).plan(scene, rng)
