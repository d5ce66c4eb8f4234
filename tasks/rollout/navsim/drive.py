"""The public traffic's steps: one agent after the other, on the geometry library's own shapes (docs/reward.md 5).

Step t answers to the ego of step t - 1, whose rear axle is taken for its centre. An agent looks along what is left of
its path in a strip as wide as itself; of the footprints that reach into it the nearest to its own footprint leads. A
footprint is the agent's box and the strip that it covers in the next headway. IDM moves it, and those after it see it
there already. (NavsimIDMAgentManager.propagate_agents, IDMAgent.projected_footprint, IDMPolicy)

The distance to the leader depends on how GEOS rounds the ends of a strip, and which of two leaders that both touch the
agent is taken on how GEOS packs its tree. So the shapes here are GEOS's, made by the same calls. Left out is what
changes nothing: footprints that nobody sees, strips that nothing is near, trees where one leader is the nearest.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely

from tasks.rollout.navsim.agents import WIDER, IdmAgent, NavsimAgents, bodies
from tasks.rollout.navsim.baseline_path import Pose
from tasks.rollout.settings import TrafficSettings
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import Array, Bools
from tasks.world.clip import STEP_S
from tasks.world.vehicle import HEADING, PACIFICA, VX, VY, X, Y

RADIUS_M = 100.0  # around the ego; agents beyond it are gone for good
SIMPLE_M = 1e-5  # all shapes are simplified by so much before each look
QUADRANT = 16  # segments of a quarter of a round corner
TIE_M = 1e-9


@dataclass
class _Agent:
    """An agent on its way."""

    about: IdmAgent
    progress: float  # [m], not bounded by the path's ends
    speed: float  # [m/s]
    pose: Pose

    @property
    def body(self) -> shapely.Polygon:
        return bodies(np.array([[*self.pose, self.about.length, self.about.width]]))[0]

    def footprint(self, headway_s: float) -> shapely.Geometry:
        """Its body and the strip along its path that it covers in the next headway."""
        path, half = self.about.path, self.about.length / 2.0
        start, stop = self.progress - half, self.progress + half + self.speed * headway_s
        return shapely.union_all([_strip(path.between(start, stop), self.about.width / 2.0), self.body])


class _Footprint:
    """What others see of somebody: a shape that is simplified before each look, so again and again."""

    def __init__(self, body: shapely.Polygon | None, looks: int) -> None:
        """body: None for an agent's footprint, which is made when it is first asked for; looks: that were before it."""
        self.is_body, self._looks, self._is_simple = body is not None, looks, False
        self._stages: list[shapely.Geometry] = [] if body is None else [body]

    def seen_again(self, looks: int) -> None:
        """The same shape stands there anew."""
        self._looks = looks

    def at(self, looks: int, agent: _Agent | None, headway_s: float) -> shapely.Geometry:
        """The shape in the look of this number."""
        if not self._stages:
            assert agent is not None
            self._stages.append(agent.footprint(headway_s))
        times = looks - self._looks
        while len(self._stages) <= times and not self._is_simple:
            simpler = shapely.simplify(self._stages[-1], SIMPLE_M, preserve_topology=True)
            fewer = shapely.get_num_coordinates(simpler) < shapely.get_num_coordinates(self._stages[-1])
            self._is_simple = not fewer
            if fewer:
                self._stages.append(simpler)
        return self._stages[min(times, len(self._stages) - 1)]


def answer(
    agents: NavsimAgents, settings: TrafficSettings, window: AgentTracks, ego_states: Array
) -> tuple[Array, Array, Bools]:
    """The traffic around one ego with states (T, 11), T = 41: boxes (T, N, 5), velocities (T, N, 2), valid (T, N).

    window: the log's tracks over the same steps, row 0 as the scene has them. Raises ValueError where an agent's path
    begins beyond its own body, at which the public code ends.
    """
    vehicle = np.array([kind == AgentKind.VEHICLE for kind in window.kinds], dtype=bool)
    boxes, velocities, valid = window.boxes.copy(), window.velocities.copy(), window.valid.copy()
    boxes[1:, vehicle], velocities[1:, vehicle], valid[1:, vehicle] = np.nan, np.nan, False
    staying = np.array(agents.staying, dtype=np.int64)
    for t, moving in enumerate(_Traffic(agents, settings, ego_states).steps(), start=1):
        for agent in moving.values():
            i, heading = agent.about.row, agent.pose[2]
            boxes[t, i] = *agent.pose, agent.about.length, agent.about.width
            velocities[t, i] = agent.speed * np.cos(heading), agent.speed * np.sin(heading)
            valid[t, i] = True
        stay = staying[_stay(agents, moving)]
        boxes[t, stay], velocities[t, stay], valid[t, stay] = window.boxes[0, stay], window.velocities[0, stay], True
    return boxes, velocities, valid


def _stay(agents: NavsimAgents, moving: dict[int, _Agent]) -> Bools:
    """(F,) which of the staying are there: in nobody that moves, and in none of the staying before them."""
    stays: Bools = np.zeros(len(agents.staying), dtype=bool)
    for i, body in enumerate(agents.staying_bodies):
        near = [moving[k].body for k in np.flatnonzero(agents.staying_meet[i]).tolist() if k in moving]
        stays[i] = not (shapely.intersects(body, near).any() or (agents.staying_touch[i] & stays).any())
    return stays


class _Traffic:
    """The agents on their way around one ego, who goes by the number after theirs."""

    def __init__(self, agents: NavsimAgents, settings: TrafficSettings, ego_states: Array) -> None:
        self.agents, self.settings, self.ego_states = agents, settings, ego_states
        self.moving = {k: _Agent(a, a.progress, a.speed, a.path.pose(a.progress)) for k, a in enumerate(agents.driven)}
        self.ego = len(agents.driven)
        self.looks = 0
        self.footprints = {k: _Footprint(agent.about.body, 0) for k, agent in self.moving.items()}

    def steps(self) -> Iterator[dict[int, _Agent]]:
        """The agents that are left after each of the T - 1 steps, by their numbers."""
        egos = bodies(np.column_stack([self.ego_states[:, [X, Y, HEADING]], np.tile(_BODY, (len(self.ego_states), 1))]))
        for ego, body in zip(self.ego_states[:-1], egos):
            self.footprints[self.ego] = _Footprint(body, self.looks)
            for k, agent in list(self.moving.items()):
                if math.hypot(agent.pose[0] - ego[X], agent.pose[1] - ego[Y]) > RADIUS_M:
                    del self.moving[k], self.footprints[k]
            for k, agent in self.moving.items():
                self.looks += 1
                self._move(k, agent, ego)
            yield self.moving

    def _move(self, k: int, agent: _Agent, ego: Array) -> None:
        """Agent k looks and moves."""
        path, settings = agent.about.path, self.settings
        leader = self._leader(k, agent)
        if leader is None:
            gap, lead_speed, lead_length = path.end - agent.progress, 0.0, agent.about.length / 2.0
        else:
            ahead = self.moving.get(leader)
            speed = float(np.hypot(ego[VX], ego[VY])) if ahead is None else ahead.speed
            turn = float((ego[HEADING] if ahead is None else ahead.pose[2]) - agent.pose[2])
            lead_speed = speed * math.cos((turn + math.pi) % (2.0 * math.pi) - math.pi)
            gap, lead_length = float(shapely.length(shapely.shortest_line(self._shape(k), self._shape(leader)))), 0.0
        acceleration = idm_acceleration(agent.speed, agent.about.target_speed, gap - lead_length, lead_speed, settings)
        before = agent.progress, agent.speed
        agent.progress += STEP_S * agent.speed
        agent.speed = max(agent.speed + STEP_S * acceleration, 0.0)
        if before == (agent.progress, agent.speed) and not self.footprints[k].is_body:
            self.footprints[k].seen_again(self.looks)
        else:
            agent.pose = path.pose(agent.progress)
            self.footprints[k] = _Footprint(None, self.looks)

    def _shape(self, k: int) -> shapely.Geometry:
        return self.footprints[k].at(self.looks, self.moving.get(k), self.settings.headway_s)

    def _leader(self, k: int, agent: _Agent) -> int | None:
        """Whose footprint in the strip ahead of agent k is the nearest to its own; None: nobody else's is in it."""
        half_width, at_start = agent.about.width / 2.0, self.footprints[k].is_body
        ahead = agent.about.path.ahead(agent.progress)
        line, reach = shapely.LineString(ahead), WIDER * half_width
        others = [j for j in (*np.flatnonzero(self.agents.meet[k]).tolist(), self.ego) if j in self.footprints]
        near = [j for j in others if shapely.dwithin(self._shape(j), line, reach)]
        if not near and not (at_start and not shapely.intersects(self._shape(k), line)):
            return None
        strip = _strip(ahead, half_width)
        if at_start and not shapely.intersects(self._shape(k), strip):
            problem = "stands beyond the end of its lane's path, where the public traffic looks for its leader"
            raise ValueError(f"traffic=navsim: agent {agent.about.row} {problem}: its centreline has too few points")
        near = [j for j in near if shapely.intersects(self._shape(j), strip)]
        if len(near) < 2:
            return near[0] if near else None
        away = shapely.distance([self._shape(j) for j in near], self._shape(k))
        first, second = np.partition(away, 1)[:2]
        return near[int(away.argmin())] if second - first > TIE_M else self._first_of_equals(k, strip)

    def _first_of_equals(self, k: int, strip: shapely.Geometry) -> int:
        """Of several that are as near, which the public code's trees come to first (STRTreeOccupancyMap)."""
        there = sorted(self.footprints)
        shapes = np.array([self._shape(j) for j in there], dtype=object)
        found = shapely.STRtree(shapes).query(strip)
        found = found[shapely.intersects(shapes[found], strip)]
        found = found[found != there.index(k)]
        return there[int(found[shapely.STRtree(shapes[found]).nearest(self._shape(k))])]


_BODY = (PACIFICA.length, PACIFICA.width)


def idm_acceleration(
    speed: float, target_speed: float, gap: float, lead_speed: float, settings: TrafficSettings
) -> float:
    """[m/s2] of IDM `gap` m behind a leader, clipped to what is comfortable (idm_policy.py)."""
    closing = speed * (speed - lead_speed) / (2.0 * math.sqrt(settings.accel_max * settings.decel_max))
    wanted = settings.min_gap_m + speed * settings.headway_s + closing
    free = 1.0 - (speed / target_speed) ** settings.exponent
    wish = settings.accel_max * (free - (wanted / max(gap, settings.min_gap_m)) ** 2)
    return min(max(-settings.decel_max, wish), settings.accel_max)


def _strip(line: Array, half_width: float) -> shapely.Geometry:
    return shapely.buffer(shapely.LineString(line), half_width, quad_segs=QUADRANT, cap_style="flat")
