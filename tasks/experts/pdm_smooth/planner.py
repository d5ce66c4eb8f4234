"""PDM-Closed with proposals that continue the ego's own motion.

PDM-Closed's proposals start beside the ego, on their path, with full braking for a tenth of a second, and turn with the
polyline: its plans are kicked at the seam, and two of them half a second apart are unlike each other. Here the fifteen
proposals, each with quicker and slower merges, start with the ego's pose, curvature, speed and acceleration
(paths.py, proposals.py). What it believes of the others, how proposals are driven and scored is PDM-Closed's; the score
knows the ego's history, and among proposals of nearly the same score the smoothest is the plan.
"""

import hashlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tasks.experts.pdm_closed.forecast import RADIUS_M, forecast
from tasks.experts.pdm_closed.planner import red_connectors, red_now, speed_limit_of
from tasks.experts.pdm_smooth.paths import LEAST_LINE_M, line_ahead
from tasks.experts.pdm_smooth.proposals import SmoothProposals, smooth_proposals
from tasks.experts.pdm_smooth.settings import DEFAULTS, SmoothSettings
from tasks.experts.protocol import Plan
from tasks.experts.smoothness import best_first, roughness
from tasks.reward.epdms import Scores, score
from tasks.reward.prepare import PAST_STEPS, prepare
from tasks.rollout.lqr import track
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.boxes import ego_boxes
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.polygons import polygons_near
from tasks.world.vehicle import PACIFICA

__all__ = ["PdmSmooth", "SmoothPlan", "SmoothSettings", "plan_smooth"]


@dataclass(frozen=True)
class SmoothPlan:
    """What was considered, and what was chosen."""

    proposals: SmoothProposals
    simulated: Array  # (P, 41, 11) the proposals as the tracker drives them
    scores: Scores  # (P,) progress relative to the batch
    chosen: int

    @property
    def poses(self) -> Array:
        """(40, 3) of the chosen proposal, world frame, 0.1 .. 4.0 s."""
        return self.proposals.poses[self.chosen, 1:]


def plan_smooth(scene: Scene, settings: SmoothSettings = DEFAULTS) -> SmoothPlan | None:
    """The plan from a scene, seeing its agents and lights at the scene's step only; None: hardly any route is left."""
    ego = scene.ego_state
    line = line_ahead(scene.centerline, ego, settings.line_smoothing_m)
    if line is None:
        return None
    agents = scene.agents.window(scene.step, scene.step + 1)
    polygons = polygons_near(scene.clip.road_map, ego_boxes(ego, PACIFICA)[:2], RADIUS_M)
    red, lights = red_connectors(polygons, red_now(scene) & scene.clip.route.lane_ids)
    seen = forecast(ego, agents, lights)
    limit = speed_limit_of(scene)
    proposals = smooth_proposals(ego, line, seen, settings.fallback_speed_mps if limit is None else limit, settings)
    simulated = track(ego, proposals.poses[:, 1:])
    prepared = prepare(
        past_states=scene.ego_history[list(PAST_STEPS)],
        centerline=scene.centerline,
        polygons=polygons,
        route_lane_ids=scene.clip.route.lane_ids,
        objects=seen.tracks(agents, HORIZON_STEPS + 1),
        red_lanes=red,
        drop_touching=False,  # the forecast's tracks are without them
    )
    scores = score(prepared, simulated)
    order = best_first(scores.pdm_score, roughness(simulated), settings.score_step)
    return SmoothPlan(proposals, simulated, scores, int(order[0]))


@dataclass(frozen=True)
class PdmSmooth:
    """The smooth planner as an expert."""

    settings: SmoothSettings = DEFAULTS
    name: str = "pdm_smooth"
    kernels: ClassVar[tuple[str, ...]] = ("smooth",)

    def digest(self) -> str:
        """Of every setting."""
        return hashlib.sha256(repr(self.settings).encode()).hexdigest()[:16]

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The chosen proposal; "no_plan" where hardly any route is left to drive along."""
        found = plan_smooth(scene, self.settings)
        if found is None:
            return Rejected("expert", "no_plan", f"less than {LEAST_LINE_M:g} m of the route lie ahead")
        return Plan(found.poses)
