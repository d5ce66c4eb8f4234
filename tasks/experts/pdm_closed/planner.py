"""The planner expert: PDM-Closed (Dauner et al. 2023), as the public metric runs it (docs/reward.md 4).

Fifteen proposals along the route are driven by the tracker, scored against a constant-velocity forecast of the others,
and the first best PROPOSAL (not its simulated states) is the plan. Red lights: an on-route lane connector that is red
now is kept red; its polygon is a standing lead unless the ego's footprint lies within it already, and touching it makes
the proposal fail traffic light compliance, as in nuPlan's PDM.
"""

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from tasks.experts.pdm_closed.proposals import (
    MIN_PROGRESS_M,
    RADIUS_M,
    SCORED_STEPS,
    Proposals,
    forecast,
    path_length_m,
    proposals,
)
from tasks.experts.protocol import Plan, RunContext
from tasks.reward.epdms import Scores, score
from tasks.reward.prepare import prepare
from tasks.rollout.lqr import track
from tasks.settings import PDM_DEFAULTS, PdmSettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import AgentTracks, Scene
from tasks.world.frames import EGO_STATE_SIZE, PACIFICA
from tasks.world.geometry import ego_boxes
from tasks.world.road_map import LightState, MapLayer, MapPolygon, polygons_near

__all__ = ["PdmClosed", "PdmPlan", "PdmSettings", "plan_for", "plan_pdm_closed"]


@dataclass(frozen=True)
class PdmPlan:
    """What PDM-Closed considered and chose."""

    proposals: Proposals
    simulated: Array  # (P, 41, 11) the proposals as the tracker drives them
    scores: Scores  # (P,) progress relative to the batch, no history comfort
    chosen: int  # the first best

    @property
    def poses(self) -> Array:
        """(40, 3) of the chosen proposal, world frame, 0.1 .. 4.0 s."""
        return self.proposals.poses[self.chosen, 1 : SCORED_STEPS + 1]

    @property
    def driven(self) -> Array:
        """(41, 11) the chosen proposal as the tracker drives it, its own first pose as reference row 0."""
        return self.simulated[self.chosen]


def plan_pdm_closed(
    *,
    ego_state: Array,
    centerline: Array,
    agents: AgentTracks,
    polygons: Sequence[MapPolygon],
    route_lane_ids: frozenset[str],
    red_lane_ids: frozenset[str] = frozenset(),
    speed_limit_mps: float | None = None,
    settings: PdmSettings = PDM_DEFAULTS,
) -> PdmPlan:
    """Plan from `ego_state` (11,) along `centerline` (N, 3).

    agents: only their first step is looked at; polygons: the map within 100 m; red_lane_ids: connectors that are red
    now, of which the on-route ones matter; speed_limit_mps: of the lane the centerline starts on, None where unknown.
    Raises ValueError where the ego state, the centerline or a valid agent is misshapen or not finite, the centerline
    has no length, or the speed limit is not positive.
    """
    _refuse_nonsense(ego_state, agents)
    red, lights = red_connectors(polygons, red_lane_ids & route_lane_ids)
    seen = forecast(ego_state, agents, lights)
    candidates = proposals(ego_state, centerline, seen, speed_limit_mps, settings)
    driven = candidates.poses[:, : SCORED_STEPS + 1]
    simulated = track(ego_state, driven[:, 1:], planned_pose0=driven[:, 0])
    prepared = prepare(
        past_states=None,
        centerline=centerline,
        polygons=polygons,
        route_lane_ids=route_lane_ids,
        objects=seen.tracks(agents, SCORED_STEPS + 1),
        red_lanes=red,
        drop_touching=False,  # the forecast's tracks are without them
    )
    scores = score(prepared, simulated)
    return PdmPlan(candidates, simulated, scores, int(np.argmax(scores.pdm_score)))


def _refuse_nonsense(ego_state: Array, agents: AgentTracks) -> None:
    if np.shape(ego_state) != (EGO_STATE_SIZE,) or not np.isfinite(ego_state).all():
        raise ValueError(f"ego_state must be ({EGO_STATE_SIZE},) finite numbers, got {np.asarray(ego_state).tolist()}")
    n = len(agents)
    shapes = agents.boxes.shape[1:], agents.velocities.shape[1:], agents.valid.shape[1:]
    if agents.n_steps < 1 or shapes != ((n, 5), (n, 2), (n,)):
        raise ValueError(f"agents: {n} tracks need boxes (S >= 1, {n}, 5), velocities, valid; got {shapes} per step")
    known = np.isfinite(agents.boxes[0]).all(axis=1) & np.isfinite(agents.velocities[0]).all(axis=1)
    if (agents.valid[0] & ~known).any():
        unknown = agents.track_ids[np.flatnonzero(agents.valid[0] & ~known)[0]]
        raise ValueError(f"agents: track {unknown} is valid at the first step but its box or velocity is not finite")


def plan_for(scene: Scene, settings: PdmSettings = PDM_DEFAULTS) -> PdmPlan:
    """PDM-Closed from a scene, seeing its agents and lights at the scene's step only."""
    clip = scene.clip
    center = ego_boxes(scene.ego_state, PACIFICA)[:2]
    return plan_pdm_closed(
        ego_state=scene.ego_state,
        centerline=scene.centerline,
        agents=scene.agents.window(scene.step, scene.step + 1),
        polygons=polygons_near(clip.road_map, center, RADIUS_M),
        route_lane_ids=clip.route.lane_ids,
        red_lane_ids=red_now(scene),
        speed_limit_mps=speed_limit_of(scene),
        settings=settings,
    )


def red_connectors(
    polygons: Sequence[MapPolygon], red_on_route: Collection[str]
) -> tuple[tuple[str, ...], tuple[shapely.Polygon, ...]]:
    """The connectors among `polygons` that are red on the route: their ids, and their areas."""
    red = [
        polygon for polygon in polygons if polygon.layer is MapLayer.LANE_CONNECTOR and polygon.token in red_on_route
    ]
    return tuple(polygon.token for polygon in red), tuple(shapely.Polygon(polygon.ring[:, :2]) for polygon in red)


def red_now(scene: Scene) -> frozenset[str]:
    """Lanes whose light is red at the scene's step."""
    lights = scene.clip.lights
    states = lights.states[scene.step] if lights.lane_ids else ()
    return frozenset(lane_id for lane_id, state in zip(lights.lane_ids, states) if state == LightState.RED)


def speed_limit_of(scene: Scene) -> float | None:
    """Of the lane [m/s] that the scene's centre line starts on; None where unknown."""
    clip = scene.clip
    on_route = (clip.road_map.lanes.get(lane_id) for lane_id in sorted(clip.route.lane_ids))
    starts = (
        lane for lane in on_route if lane is not None and np.array_equal(lane.centerline[:2], scene.centerline[:2])
    )
    first = next(starts, None)
    return None if first is None else first.speed_limit_mps


@dataclass(frozen=True)
class PdmClosed:
    """PDM-Closed as an expert."""

    settings: PdmSettings = PDM_DEFAULTS
    name: str = "pdm_closed"

    @classmethod
    def of_run(cls, run: RunContext) -> "PdmClosed":
        """With the constants of the run."""
        return cls(run.pdm)

    def digest(self) -> str:
        """Of every setting."""
        return hashlib.sha256(repr(self.settings).encode()).hexdigest()[:16]

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The best proposal; "no_plan" where the route ahead has no length to drive along."""
        length_m = path_length_m(scene.centerline)
        if length_m <= MIN_PROGRESS_M:
            return Rejected("expert", "no_plan", f"the route ahead is {length_m:g} m long")
        return Plan(plan_for(scene, self.settings).poses)
