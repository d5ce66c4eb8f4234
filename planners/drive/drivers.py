"""Who drives: the log's own drive, PDM-Closed, and every planner that `planners evaluate` knows."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from factory.store.reader import Sample
from planners.evaluation.planner_names import EvaluatedPlanner, needs_of
from planners.evaluation.planning import plan_samples
from planners.evaluation.scoring import human_plans, pdm_plans
from tasks.experts.pdm_closed import PdmClosed
from tasks.experts.protocol import Plan
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene, random_stream
from tasks.world.frames import HEADING, VX, to_world

MakeSample = Callable[[], Sample]  # a sample's row of the scene, with pictures where there are cameras


class Driver(Protocol):
    """Plans anew every 0.5 s. Pure: the same scene, seen the same way, gives the same plan."""

    @property
    def needs_pictures(self) -> bool:
        """Whether its plans depend on pictures."""
        ...

    def plan(self, scene: Scene, look: MakeSample) -> Array | None:
        """(40, 3) world poses at 0.1 .. 4.0 s; None: it has no plan. Raises ValueError for what is no plan."""
        ...


@dataclass(frozen=True)
class HumanDriver:
    """Follows the log pose by pose, at the times of the log, wherever it has come to itself."""

    needs_pictures: bool = False

    def plan(self, scene: Scene, look: MakeSample) -> Array:
        """Beyond the log's last pose straight on at its last speed, which the tracker looks at for its last seconds."""
        ahead = scene.clip.ego_states[scene.step + 1 :]
        poses = ahead[:HORIZON_STEPS, : HEADING + 1]
        further = np.arange(1, HORIZON_STEPS - len(poses) + 1)[:, None] * STEP_S * ahead[-1, VX]
        straight = np.concatenate([further, np.zeros((len(further), 2))], axis=1)
        return np.concatenate([poses, to_world(poses[-1], straight)])


@dataclass(frozen=True)
class PdmClosedDriver:
    """The privileged planner: sees the world's boxes and lights as they are now."""

    needs_pictures: bool = False

    def plan(self, scene: Scene, look: MakeSample) -> Array | None:
        """None where the route ahead has no length."""
        made = PdmClosed().plan(scene, random_stream(0, scene.clip.clip_id, "drive"))
        return made.poses if isinstance(made, Plan) else None


@dataclass(frozen=True)
class PlannerDriver:
    """A planner with one of the faces of planners.evaluation.planner_names."""

    made: Any
    device: str = "cpu"

    @property
    def needs_pictures(self) -> bool:
        """Where it takes samples itself it may look at them."""
        needs = needs_of(self.made)
        return needs is None or needs.image is not None

    def plan(self, scene: Scene, look: MakeSample) -> Array:
        """Raises ValueError, naming the sample, for what is no plan."""
        return to_world(scene.ego_state[: HEADING + 1], plan_samples(self.made, [look()], self.device)[0])


def make_driver(one: EvaluatedPlanner, device: str = "cpu") -> Driver:
    """The driver that an evaluated planner is, its weights read. Raises ConfigError for plans of a submission."""
    if one.privileged is human_plans:
        return HumanDriver()
    if one.privileged is pdm_plans:
        return PdmClosedDriver()
    made = one.made()
    return PlannerDriver(made.to(device) if hasattr(made, "to") else made, device)
