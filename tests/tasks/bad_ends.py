"""Experts whose drives end badly: beside the route, or a moment before a collision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.experts.protocol import Plan
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import PACIFICA, VX, X, Y, to_world


def shift(speed: float, side_m: float) -> NDArray[np.float64]:
    """(40, 3) at constant speed to `side_m` to the left within 2.5 s."""
    step = np.arange(1, HORIZON_STEPS + 1)
    share = np.minimum(step / 25.0, 1.0)
    slope = side_m * 6.0 * share * (1.0 - share) / (2.5 * speed)
    return np.column_stack([0.1 * speed * step, side_m * share**2 * (3.0 - 2.0 * share), np.arctan(slope)])


@dataclass(frozen=True)
class Aside:
    """Keeps its speed, at least 2 m/s, and moves over to the right."""

    by_m: float = 4.5
    name: str = "aside"

    def digest(self) -> str:
        return f"aside {self.by_m}"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        return Plan(to_world(scene.ego_state[:3], shift(max(float(scene.ego_state[VX]), 2.0), -self.by_m)))


@dataclass(frozen=True)
class Close:
    """Ever faster along x, so that the bumper is planned to end 0.5 m behind the first track of the log."""

    name: str = "close"

    def digest(self) -> str:
        return "close"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan:
        ahead, time = scene.clip.agents.boxes[-1, 0], STEP_S * np.arange(1, HORIZON_STEPS + 1)
        x, y, speed = scene.ego_state[[X, Y, VX]]
        way = ahead[0] - ahead[3] / 2.0 - 0.5 - PACIFICA.front_length - x
        accel = 2.0 * (way - time[-1] * speed) / time[-1] ** 2
        return Plan(np.column_stack([x + speed * time + accel * time**2 / 2.0, np.full((len(time), 2), [y, 0.0])]))
