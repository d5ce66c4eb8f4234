"""The public evaluation's reactive traffic, to the letter: `traffic=navsim` (docs/reward.md 5)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.settings import TrafficSettings
from tasks.world.arrays import Array, Bools
from tasks.world.clip import STEP_S, AgentKind, AgentTracks, Scene
from tasks.world.frames import HEADING, PACIFICA, VX, VY, X, Y, ego_boxes
from tasks.world.road_map import Lane, RoadMap, with_headings

# The public traffic's paths: a lane's baseline, and where along it a vehicle is.
#
# As nuplan-devkit's `InterpolatedPath` is made of a baseline by `create_path_from_se2` and read by `trim_path`
# (nuplan/planning/simulation/path, nuplan/planning/simulation/observation/idm/utils.py): in the order of their
# operations, the point that is lost at the end included.

Pose = tuple[float, float, float]  # x, y [m], heading [rad]
LOOK_M = 0.5  # along a baseline, to tell its direction at a point (polyline_map_object.py)


@dataclass(frozen=True)
class BaselinePath:
    """P >= 2 points of a baseline, all but its last and those that stand twice."""

    at: Array  # (P,) path length [m]
    rows: Array  # (P, 3) x, y [m], heading [rad] of the segment that starts there, unwrapped along the path

    @property
    def end(self) -> float:
        return float(self.at[-1])

    def pose(self, progress: float) -> Pose:
        """x, y, heading in [-pi, pi) at a path length; linear between points, beyond the ends as there."""
        progress = self._clamped(progress)
        k = min(max(int(self.at.searchsorted(progress)), 1), len(self.at) - 1)
        low, high = self.rows[k - 1], self.rows[k]
        x, y, heading = (high - low) / (self.at[k] - self.at[k - 1]) * (progress - self.at[k - 1]) + low
        return float(x), float(y), float((heading + np.pi) % (2.0 * np.pi) - np.pi)

    def ahead(self, progress: float) -> Array:
        """(K >= 2, 2) the path from a path length on; from its end on its last two points."""
        progress = self._clamped(progress)
        first = int(self.at.searchsorted(progress, side="right"))
        if first == len(self.at):
            return self.rows[-2:, :2]
        return np.concatenate([[self.pose(progress)[:2]], self.rows[first:, :2]])

    def between(self, start: float, stop: float) -> Array:
        """(K >= 2, 2) the path between two path lengths; where both are at one of its ends, the two points there."""
        start, stop = self._clamped(start), self._clamped(stop)
        first, last = int(self.at.searchsorted(start, side="right")), int(self.at.searchsorted(stop))
        if first == len(self.at):
            return self.rows[-2:, :2]
        if last == 0:
            return self.rows[:2, :2]
        return np.concatenate([[self.pose(start)[:2]], self.rows[first:last, :2], [self.pose(stop)[:2]]])

    def _clamped(self, progress: float) -> float:
        return max(float(self.at[0]), min(progress, self.end))


def baseline_path(centerline: Array) -> BaselinePath | None:
    """The path along a baseline (P, >= 2); None where fewer than two points are left of it."""
    points = with_headings(centerline[:, :2])
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    at = np.cumsum(np.append(0.0, steps))
    kept = np.append(~np.isclose(np.diff(at), 0.0), False)  # the last has no step of its own and is lost
    rows = points[kept]
    if len(rows) < 2:
        return None
    rows[:, 2] = np.unwrap(rows[:, 2])
    return BaselinePath(at[kept], rows)


def nearest_pose(baseline: shapely.LineString, xy: Array) -> tuple[Pose, float]:
    """The pose of the point of a baseline nearest to `xy` (2,), and its path length [m]."""
    at = float(shapely.line_locate_point(baseline, shapely.Point(xy)))
    here, there = _point(baseline, at), _point(baseline, at + LOOK_M)
    start, stop = (here, there) if here != there else (_point(baseline, at - LOOK_M), here)
    return (*here, math.atan2(stop[1] - start[1], stop[0] - start[0])), at


def _point(line: shapely.LineString, at: float) -> tuple[float, float]:
    point = shapely.line_interpolate_point(line, at)
    return float(shapely.get_x(point)), float(shapely.get_y(point))


# Who takes part in the public traffic, and how it starts (autonomousvision/navsim @ 0a380a9, docs/reward.md 5).
#
# Vehicles of the current frame alone, in its order. Each is asked for the lane under its centre: of the lanes that hold
# it, or inside an intersection of the lane connectors, the one whose direction there is nearest to its heading as plain
# numbers. On it, at most SNAP_M beside the baseline, it becomes an agent where its box, moved onto the baseline,
# touches neither the ego nor an agent before it. Of the others those stay as they are that stand beside all lanes, and
# those farther than SNAP_M from the baseline of the lane under them; the rest is gone after the current frame.
# (build_idm_agents_on_map_rails, get_starting_segment, NavsimIDMAgents.get_observation)

SNAP_M = 3.0  # idm_snap_threshold
STANDS_BELOW_MPS = 0.1
WIDER = 1.05  # than half of what is as wide: GEOS simplifies a line before it widens it


@dataclass(frozen=True)
class IdmAgent:
    """A vehicle on the one lane it starts on."""

    row: int  # among the scene's agents
    path: BaselinePath
    progress: float  # [m] along the baseline, which is longer than the path
    speed: float  # [m/s]
    target_speed: float  # [m/s]
    length: float  # [m]
    width: float  # [m]
    body: shapely.Polygon  # its box on the baseline


@dataclass(frozen=True)
class NavsimAgents:
    """The public traffic of a scene before anybody has moved."""

    driven: tuple[IdmAgent, ...]  # in the order they move in
    meet: Bools  # (A, A) whether the second's footprint can ever be in the first's way; False: surely not
    staying: tuple[int, ...]  # rows of the vehicles that stay unless somebody is in them, in their order
    staying_bodies: NDArray[np.object_]  # (F,) their boxes
    staying_touch: Bools  # (F, F) whether two of them touch
    staying_meet: Bools  # (F, A) whether an agent can ever touch one; False: surely not


@dataclass(frozen=True)
class _Layers:
    """The layers of a map that the public traffic asks for what holds a point."""

    lanes: tuple[Lane, ...]
    connectors: tuple[Lane, ...]
    lane_tree: shapely.STRtree
    connector_tree: shapely.STRtree
    intersection_tree: shapely.STRtree


def navsim_agents(scene: Scene, target_speed_mps: float) -> NavsimAgents:
    """The public traffic of a scene; target_speed_mps: where no lane so far has had a limit.

    Raises ValueError for a lane whose baseline has no path, on which the public code ends.
    """
    now, start = scene.agents, scene.step
    vehicles = [i for i in np.flatnonzero(now.valid[start]).tolist() if now.kinds[i] == AgentKind.VEHICLE]
    boxes = now.boxes[start]
    layers = _layers(scene.clip.road_map)
    taken = [*box_polygons(ego_boxes(scene.ego_state, PACIFICA)[None])]
    driven: list[IdmAgent] = []
    staying: list[int] = []
    for i in vehicles:
        speed = float(np.hypot(*now.velocities[start, i]))
        found, in_lanes = _starting_lane(layers, boxes[i])
        if found is None:
            if speed < STANDS_BELOW_MPS and not in_lanes:
                staying.append(i)
            continue
        pose, progress = nearest_pose(shapely.LineString(found.centerline[:, :2]), boxes[i, :2])
        if np.hypot(pose[0] - boxes[i, 0], pose[1] - boxes[i, 1]) > SNAP_M:
            staying.append(i)
            continue
        body = box_polygons(np.array([[*pose, *boxes[i, 3:]]]))[0]
        if shapely.intersects(body, taken).any():
            continue
        path = baseline_path(found.centerline)
        if path is None:
            problem = "fewer than three points that lie apart: the public traffic has no path along it"
            raise ValueError(f"traffic=navsim: the centreline of lane {found.lane_id} has {problem}")
        target_speed_mps = found.speed_limit_mps or target_speed_mps  # as there: it stays for those after it
        length, width = map(float, boxes[i, 3:])
        taken.append(body)
        driven.append(IdmAgent(i, path, progress, speed, target_speed_mps, length, width, body))
    return _together(driven, staying, box_polygons(boxes[staying]))


def _together(driven: list[IdmAgent], staying: list[int], stay: NDArray[np.object_]) -> NavsimAgents:
    """With who can meet whom: an agent's box and footprint are never farther from its way than its corners reach."""
    ways = np.empty(len(driven), dtype=object)
    for k, agent in enumerate(driven):
        way = shapely.LineString(agent.path.between(agent.progress - agent.length / 2.0, agent.path.end))
        ways[k] = shapely.GeometryCollection([way, agent.body])
    ahead = np.array([shapely.LineString(agent.path.ahead(agent.progress)) for agent in driven], dtype=object)
    half_width = np.array([agent.width / 2.0 for agent in driven])
    corner = np.array([np.hypot(agent.length, agent.width) / 2.0 for agent in driven])
    meet = shapely.dwithin(ahead[:, None], ways[None], WIDER * (half_width[:, None] + corner[None]))
    np.fill_diagonal(meet, False)
    touch = shapely.intersects(stay[:, None], stay[None])
    return NavsimAgents(
        tuple(driven), meet, tuple(staying), stay, touch, shapely.dwithin(stay[:, None], ways[None], WIDER * corner)
    )


def box_polygons(boxes: Array) -> NDArray[np.object_]:
    """(N,) polygons of boxes (N, 5), corners as nuPlan's `OrientedBox` has them."""
    x, y, heading, length, width = boxes.T
    quarter = np.pi / 2.0
    cos, sin, across_x, across_y = (
        np.cos(heading),
        np.sin(heading),
        np.cos(heading + quarter),
        np.sin(heading + quarter),
    )
    corners = [
        np.stack([x + (lat * across_x + lon * cos), y + (lat * across_y + lon * sin)], axis=-1)
        for lon, lat in ((length, width), (-length, width), (-length, -width), (length, -width))
        for lon, lat in ((lon / 2.0, lat / 2.0),)
    ]
    return np.asarray(shapely.polygons(np.stack(corners, axis=-2)), dtype=object).reshape(len(boxes))


def _starting_lane(layers: _Layers, box: Array) -> tuple[Lane | None, bool]:
    """The lane a vehicle starts on, None where there is none; and whether it is on a lane or in an intersection."""
    point = shapely.Point(box[:2])
    on = _holding(layers.lane_tree, point)
    if on:
        lanes = [layers.lanes[k] for k in on]
    elif _holding(layers.intersection_tree, point):
        lanes = [layers.connectors[k] for k in _holding(layers.connector_tree, point)]
    else:
        return None, False
    if not lanes:
        return None, True
    turns = [abs(nearest_pose(shapely.LineString(lane.centerline[:, :2]), box[:2])[0][2] - box[2]) for lane in lanes]
    return lanes[int(np.argmin(turns))], True


def _holding(tree: shapely.STRtree, point: shapely.Point) -> list[int]:
    """Polygons that hold a point, in file order; on an edge it is outside."""
    return sorted(tree.query(point, predicate="within").tolist())


@lru_cache(maxsize=4)
def _layers(road_map: RoadMap) -> _Layers:
    lanes = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and not lane.is_intersection)
    connectors = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and lane.is_intersection)
    areas = road_map.intersections
    return _Layers(
        lanes,
        connectors,
        shapely.STRtree([shapely.Polygon(lane.ring) for lane in lanes]),
        shapely.STRtree([shapely.Polygon(lane.ring) for lane in connectors]),
        shapely.STRtree(
            [shapely.Polygon(lane.ring) for lane in connectors]
            if areas is None
            else [shapely.Polygon(area.ring, area.holes) for area in areas]
        ),
    )


# The public traffic's steps: one agent after the other, on the geometry library's own shapes (docs/reward.md 5).
#
# Step t answers to the ego of step t - 1, whose rear axle is taken for its centre. An agent looks along what is left of
# its path in a strip as wide as itself; of the footprints that reach into it the nearest to its own footprint leads. A
# footprint is the agent's box and the strip that it covers in the next headway. IDM moves it, and those after it see it
# there already. (NavsimIDMAgentManager.propagate_agents, IDMAgent.projected_footprint, IDMPolicy)
#
# The distance to the leader depends on how GEOS rounds the ends of a strip, and which of two leaders that both touch
# the agent is taken on how GEOS packs its tree. So the shapes here are GEOS's, made by the same calls. Left out is what
# changes nothing: footprints that nobody sees, strips that nothing is near, trees where one leader is the nearest.

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
        return box_polygons(np.array([[*self.pose, self.about.length, self.about.width]]))[0]

    def footprint(self, headway_s: float) -> shapely.Geometry:
        """Its body and the strip along its path that it covers in the next headway."""
        path, half = self.about.path, self.about.length / 2.0
        start, stop = self.progress - half, self.progress + half + self.speed * headway_s
        return shapely.union_all([_strip(path.between(start, stop), self.about.width / 2.0), self.body])


class _Footprint:
    """What others see of somebody: a shape that is simplified before each look, so again and again."""

    def __init__(self, body: shapely.Polygon | None, looks: int) -> None:
        """body: None for an agent's footprint, which is made when it is first asked for; looks: that were before it."""
        self.is_body, self.looks, self._is_simple = body is not None, looks, False
        self._stages: list[shapely.Geometry] = [] if body is None else [body]

    def at(self, looks: int, agent: _Agent | None, headway_s: float) -> shapely.Geometry:
        """The shape in the look of this number."""
        if not self._stages:
            assert agent is not None
            self._stages.append(agent.footprint(headway_s))
        times = looks - self.looks
        while len(self._stages) <= times and not self._is_simple:
            simpler = shapely.simplify(self._stages[-1], SIMPLE_M, preserve_topology=True)
            fewer = shapely.get_num_coordinates(simpler) < shapely.get_num_coordinates(self._stages[-1])
            self._is_simple = not fewer
            if fewer:
                self._stages.append(simpler)
        return self._stages[min(times, len(self._stages) - 1)]


def roll_out_navsim(
    agents: NavsimAgents, settings: TrafficSettings, window: AgentTracks, ego_states: Array
) -> tuple[AgentTracks, Bools]:
    """The tracks of T rows around one ego with states (T, 11), and who is driven (N,).

    window: the log's tracks over the same steps, row 0 as the scene has them. Boxes keep the height that they have now:
    the public traffic lives in the plane. Raises ValueError where an agent's path begins beyond its own body, at which
    the public code ends.
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
        stay = staying[_staying_present(agents, moving)]
        boxes[t, stay], velocities[t, stay], valid[t, stay] = window.boxes[0, stay], window.velocities[0, stay], True
    center_z = np.where(vehicle, np.where(valid, window.center_z[0], np.nan), window.center_z)
    driven = np.zeros(len(window), dtype=bool)
    driven[[agent.row for agent in agents.driven]] = True
    return replace(window, boxes=boxes, velocities=velocities, valid=valid, center_z=center_z), driven


def _staying_present(agents: NavsimAgents, moving: dict[int, _Agent]) -> Bools:
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
        egos = box_polygons(
            np.column_stack([self.ego_states[:, [X, Y, HEADING]], np.tile(_BODY, (len(self.ego_states), 1))])
        )
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
            self.footprints[k].looks = self.looks  # the same shape stands there anew
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
