"""A trained planner as an expert of the factory: one that learned from human and accepted drives, seen from above.

    python -m planners train planner=ego_mlp_bev_small data.real=[runs/av2] data.sim=[runs/av2] out=runs/bev
    python -m factory.run +expert.learned._target_=planners.drive.expert.learned +expert.learned.planner=runs/bev \
        experts=[learned,human]

It is shown the row that a sample of the scene would have, up to now: the raster of map, route and agents, and the ego's
status. A planner of one's own that takes rows or batches without pictures does as well.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from factory.config.compose import ConfigError
from factory.setup.settings import RunContext
from planners.drive.drivers import PlannerDriver
from planners.drive.eyes import NoEyes, sample_of
from planners.evaluation.planner_names import EvaluatedPlanner, planner_of
from tasks.experts.pdm_closed.path import MIN_PROGRESS_M, path_length_m
from tasks.experts.protocol import Plan
from tasks.experts.recovery.feasible import feasible
from tasks.stages import Rejected
from tasks.world.clip import Scene
from tasks.world.frames import to_local, to_world
from tasks.world.vehicle import HEADING


@dataclass(frozen=True)
class LearnedExpert:
    """Plans as the planner does; with `smooth` the plan is first made drivable from the ego's state, as recovery's."""

    planner: EvaluatedPlanner
    smooth: bool = True
    name: str = "learned"

    def digest(self) -> str:
        """Of the planner's weights and settings."""
        return f"{self.planner.digest}{'' if self.smooth else '-raw'}"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The planner's plan; "no_plan" where no route is left to be shown, or the smoothing finds no solution."""
        if path_length_m(scene.centerline) <= MIN_PROGRESS_M:
            return Rejected("expert", "no_plan", "no route is left")
        poses = self._driver.plan(scene, lambda: sample_of(scene, NoEyes(), ()))
        assert isinstance(poses, np.ndarray), "a planner always has a plan"
        if not self.smooth:
            return Plan(poses)
        ego = scene.ego_state[: HEADING + 1]
        drivable = feasible(to_local(ego, poses), scene.ego_state)
        if isinstance(drivable, str):
            return Rejected("expert", "no_plan", drivable)
        return Plan(to_world(ego, drivable))

    @cached_property
    def _driver(self) -> PlannerDriver:
        import torch

        torch.set_num_threads(1)  # sums do not depend on how many a worker has
        assert self.planner.load is not None
        return PlannerDriver(self.planner.load())

    def __getstate__(self) -> dict[str, Any]:
        """The weights stay where they are: every worker reads them itself."""
        return {key: value for key, value in vars(self).items() if key != "_driver"}


def learned(run: RunContext, planner: str, smooth: bool = True) -> LearnedExpert:
    """The expert that `planner` makes, named as `python -m planners evaluate planner=` names it. Raises ConfigError."""
    where = f"expert.{run.name}"
    one = planner_of(planner)
    if one.load is None:
        raise ConfigError(f"{where}.planner={planner}: {planner} is an expert itself: experts=[{planner}]")
    made = LearnedExpert(one, smooth, run.name)
    if made._driver.needs_pictures:
        raise ConfigError(f"{where}.planner={planner}: it needs pictures, and an expert drives before any are rendered")
    return made
