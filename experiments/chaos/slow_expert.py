"""An expert for runs that last: it waits before it plans, so that hours of a run cost minutes of a core."""

import time
from dataclasses import dataclass

import numpy as np

from examples.keep_lane import KeepLane
from tasks.experts.protocol import Plan
from tasks.stages import Rejected
from tasks.world.clip import Scene


@dataclass(frozen=True)
class SlowKeepLane(KeepLane):
    """KeepLane's plans and digest, `wait_s` seconds later. `journal` gets a line for each plan."""

    wait_s: float = 0.0
    journal: str = ""

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        with open(self.journal, "a") as file:
            file.write(f"{scene.clip.clip_id}\n")
        time.sleep(self.wait_s)
        return super().plan(scene, rng)
