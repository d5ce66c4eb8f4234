"""An expert: back to the lane's middle, at the speed of now.

    python -m factory.run +expert.keep_lane._target_=examples.keep_lane.KeepLane experts=[keep_lane,human]
    python -m factory.run ... +expert.keep_lane.settle_m=30

It looks at the scene only: the ego's state and the centreline of the route ahead. What a scene holds: docs/extend.md.
"""

from dataclasses import dataclass

import numpy as np

from tasks.experts.protocol import Plan
from tasks.stages import Rejected
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import HEADING, VX, X, Y, wrap_angle
from tasks.world.road_map import arc_lengths


@dataclass(frozen=True)
class KeepLane:
    """Follows the route's centreline; an offset from it dies away over some `settle_m` metres."""

    settle_m: float = 15.0
    name: str = "keep_lane"

    def digest(self) -> str:
        """Rows of another setting are other rows."""
        return f"settle {self.settle_m}"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """(40, 3) world poses at 0.1 .. 4.0 s; "off_route" where the ego is far from the route or does not face it."""
        ego, line = scene.ego_state, scene.centerline
        nearest = int(np.argmin(np.hypot(*(line[:, :2] - ego[[X, Y]]).T)))
        to_left = np.array([-np.sin(line[nearest, 2]), np.cos(line[nearest, 2])])
        offset_m = float((ego[[X, Y]] - line[nearest, :2]) @ to_left)
        if abs(offset_m) > 5.0 or abs(wrap_angle(ego[HEADING] - line[nearest, 2])) > 1.0:
            return Rejected("expert", "off_route", f"{offset_m:.1f} m beside the centreline")

        gone_m = ego[VX] * STEP_S * np.arange(HORIZON_STEPS + 1)
        along, first = np.unique(arc_lengths(line), return_index=True)  # where two lanes join, a point stands twice
        at = along[np.searchsorted(along, arc_lengths(line)[nearest])] + gone_m
        if at[-1] > along[-1]:
            return Rejected("expert", "off_route", "the route ends before the plan does")
        x, y = (np.interp(at, along, line[first, i]) for i in (0, 1))
        heading = np.interp(at, along, np.unwrap(line[first, 2]))
        beside = offset_m * np.exp(-gone_m / self.settle_m)
        x, y = x - beside * np.sin(heading), y + beside * np.cos(heading)
        turned = heading - np.arctan2(beside, self.settle_m)
        return Plan(np.column_stack([x, y, turned])[1:])
