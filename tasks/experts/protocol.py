"""What an expert is, and the log's own drive as one; experts from a user's own package satisfy the protocol too.

A class, or a function that makes an expert, is told of the run where it takes an argument `run`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import Scene
from tasks.world.frames import HEADING, wrap_angle


@dataclass(frozen=True)
class Plan:
    """What an expert wants to drive."""

    poses: Array  # (40, 3) world frame x, y, heading, at 0.1 .. 4.0 s after the scene's step
    goal: "Goal | None" = None  # where its drive has to end


@dataclass(frozen=True)
class Goal:
    """Where a drive has to end, and how far off it may."""

    pose: Array  # (3,) world frame x [m], y [m], heading [rad]
    speed_mps: float
    max_m: float
    max_deg: float
    max_mps: float

    def missed(self, pose: Array, speed_mps: float) -> str | None:
        """By how much an end pose (3,) and speed are too far off; None: they are not."""
        metres = math.hypot(*(pose[:2] - self.pose[:2]))
        degrees = abs(math.degrees(wrap_angle(pose[2] - self.pose[2])))
        mps = abs(speed_mps - self.speed_mps)
        if metres <= self.max_m and degrees <= self.max_deg and mps <= self.max_mps:
            return None
        return f"ends {metres:.1f} m, {degrees:.0f} degrees and {mps:.1f} m/s off the log"


class Expert(Protocol):
    """Plans H seconds from a scene. Pure: the same scene and rng give the same plan.

    One that has several ways to drive gives them by `plans(scene, rng)` beside, the one it likes best first: the first
    whose drive is accepted is the sample.
    """

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


def plans_of(expert: Expert, scene: Scene, rng: np.random.Generator) -> Iterator[Plan | Rejected]:
    """What the expert would drive, one plan or more, or why there is none."""
    several = getattr(expert, "plans", None)
    if several is None:
        yield expert.plan(scene, rng)
    else:
        yield from several(scene, rng)


def drives_once_per_clip(expert: object) -> bool:
    """Whether an expert, or the class of one, says `once = True`.

    It then drives once a clip, from the log at T, always has a plan, and is kept whatever the reward says, as `human`.
    Any other is tried from where candidates lead, until it has a sample for every round.
    """
    return bool(getattr(expert, "once", False))


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
        return Plan(scene.log_ahead[1:, : HEADING + 1].copy())


@dataclass(frozen=True)
class Logged(Human):
    """From a perturbed state to where the log's driver was at each moment, however far that is.

    What a planner would be taught without a pseudo-expert.
    """

    name: str = "logged"
    once: ClassVar[bool] = False
