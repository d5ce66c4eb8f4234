"""The road network of the town: roads, junctions, lanes with their graph, drivable areas, crossings.

Traffic drives on the right. Where the streets lie is plan.py's matter.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
import shapely

from factory.readers.town import curves
from tasks.world.arrays import Array
from tasks.world.polygons import arc_lengths

CROSSING_M = 3.0  # a crosswalk's width along the road
CROSSING_GAP_M = 0.8  # from the junction's edge
STOP_LINE_M = 5.0  # stop line before the end of a lane that has a crosswalk
PAVEMENT_M = 3.4  # pavement's width behind the kerb


@dataclass(frozen=True)
class TownRoad:
    """A street between two junctions (or the town's edge); `line` runs from its first to its second end."""

    name: str
    line: Array  # (N, 3) poses of the reference line, between the two directions
    lanes: int  # per direction
    lane_width: float
    strip: str  # "bike" | "park": what lies between the outer lane and the kerb
    strip_width: float
    speed_mps: float
    crossing_at_start: bool = False

    @property
    def half_width(self) -> float:
        """Reference line to kerb [m]."""
        return self.lanes * self.lane_width + self.strip_width

    @property
    def both_ways(self) -> tuple[Array, Array]:
        """The line as driven in either direction."""
        return self.line, curves.reverse(self.line)


@dataclass
class TownLane:
    """One lane segment under construction, then read only. Boundaries run in driving direction."""

    lane_id: int
    center: Array  # (N, 3)
    left: Array  # (N, 2)
    right: Array  # (N, 2)
    road: str
    speed_mps: float
    kind: str = "VEHICLE"
    is_intersection: bool = False
    left_mark: str = "NONE"
    right_mark: str = "NONE"
    successors: list[int] = field(default_factory=list)
    predecessors: list[int] = field(default_factory=list)
    left_neighbor: int | None = None
    right_neighbor: int | None = None
    light_group: int = -1  # of the signal that governs this connector, -1: none
    stop_before_end: float = 0.0  # stop line [m] before the lane's end


@dataclass(frozen=True)
class Junction:
    """Surface of a junction: its kerb ring and which parts of the ring are kerb (the rest are road mouths)."""

    name: str
    center: Array  # (2,)
    ring: Array  # (M, 2) closed, counter-clockwise
    kerbs: tuple[Array, ...]  # (K, 3) poses, asphalt on their left
    island_radius: float = 0.0


@dataclass(frozen=True)
class Crossing:
    """A crosswalk: two edges of two points each, from one pavement to the other."""

    edge1: Array  # (2, 2)
    edge2: Array
    light_group: int  # of the cars that it crosses


@dataclass(frozen=True)
class SignalPost:
    """One approach's traffic lights."""

    pose: Array  # (3,) at the kerb by the stop line, heading = driving direction of the approach
    lane_id: int  # a connector whose state it shows
    width: float  # of the approach [m], for the mast's arm


@dataclass(frozen=True)
class Streets:
    """The whole network."""

    roads: tuple[TownRoad, ...]
    junctions: tuple[Junction, ...]
    lanes: dict[int, TownLane]
    areas: tuple[Array, ...]  # rings (M, 2) of drivable surface
    crossings: tuple[Crossing, ...]
    posts: tuple[SignalPost, ...]

    def surface(self) -> shapely.Geometry:
        """Everything drivable as one geometry."""
        return shapely.unary_union([shapely.Polygon(ring).buffer(0.01) for ring in self.areas])


@dataclass(frozen=True)
class _Arm:
    """A road's end at a junction; `pose` looks out of the junction along the road's reference line."""

    road: TownRoad
    pose: Array
    incoming: list[int]  # lane ids that end here, inner lane first
    outgoing: list[int]


class _Builder:
    def __init__(self) -> None:
        self.lanes: dict[int, TownLane] = {}
        self.roads: list[TownRoad] = []
        self.junctions: list[Junction] = []
        self.areas: list[Array] = []
        self.crossings: list[Crossing] = []
        self.posts: list[SignalPost] = []

    def lane(self, center: Array, left: Array, right: Array, road: str, speed: float, **more: object) -> TownLane:
        lane = TownLane(1000 + 7 * len(self.lanes), center, left[:, :2], right[:, :2], road, speed, **more)  # type: ignore[arg-type]
        self.lanes[lane.lane_id] = lane
        return lane

    def join(self, before: int, after: int) -> None:
        self.lanes[before].successors.append(after)
        self.lanes[after].predecessors.append(before)

    def road(self, road: TownRoad) -> tuple[_Arm, _Arm]:
        """Lanes of a road in segments of ~80 m; returns the arms at its first and second end."""
        self.roads.append(road)
        n_cuts = max(1, round(arc_lengths(road.line)[-1] / 80.0))
        bounds = np.linspace(0, len(road.line) - 1, n_cuts + 1).astype(int)
        chains: dict[tuple[bool, int], list[int]] = {}
        for a, b in itertools.pairwise(bounds):
            innermost = [self._segment(road, road.line[a : b + 1], forward, chains) for forward in (True, False)]
            for here, other in (innermost, innermost[::-1]):
                self.lanes[here].left_neighbor = other
        for (forward, _), chain in chains.items():
            ordered = chain if forward else chain[::-1]
            for before, after in itertools.pairwise(ordered):
                self.join(before, after)
            self.lanes[ordered[-1]].stop_before_end = STOP_LINE_M if road.crossing_at_start and not forward else 0.5
        h = road.half_width
        self.areas.append(np.vstack([curves.offset(road.line, -h)[:, :2], curves.offset(road.line, h)[::-1, :2]]))
        outwards = (road.line[0], 0, False), (curves.advance(road.line[-1], 0.0, turn=np.pi), -1, True)
        first, second = (
            _Arm(road, pose, *([chains[way, k][end] for k in range(road.lanes)] for way in (comes, not comes)))
            for pose, end, comes in outwards
        )
        return first, second

    def _segment(self, road: TownRoad, line: Array, forward: bool, chains: dict[tuple[bool, int], list[int]]) -> int:
        """Lanes of one direction over one segment; returns the innermost lane's id."""
        base = line if forward else curves.reverse(line)
        previous: TownLane | None = None
        innermost = -1
        for k in range(road.lanes + 1):
            is_strip = k == road.lanes
            if is_strip and road.strip != "bike":
                break
            inner = k * road.lane_width
            outer = road.half_width if is_strip else inner + road.lane_width
            middle_mark = "DASHED_WHITE" if road.strip == "park" else "DOUBLE_SOLID_YELLOW"
            lane = self.lane(
                curves.offset(base, -(inner + outer) / 2),
                curves.offset(base, -inner),
                curves.offset(base, -outer),
                road.name,
                road.speed_mps,
                kind="BIKE" if is_strip else "VEHICLE",
                left_mark=middle_mark if k == 0 else ("SOLID_WHITE" if is_strip else "DASHED_WHITE"),
                right_mark="NONE" if is_strip else ("SOLID_WHITE" if k == road.lanes - 1 else "DASHED_WHITE"),
            )
            if previous is None:
                innermost = lane.lane_id
            else:
                lane.left_neighbor, previous.right_neighbor = previous.lane_id, lane.lane_id
            previous = lane
            chains.setdefault((forward, k), []).append(lane.lane_id)
        return innermost

    def connect(self, before: int, after: int, speed: float, group: int = -1, reach: float = 0.39) -> None:
        """A lane connector from the end of lane `before` to the start of lane `after`."""
        a, b = self.lanes[before], self.lanes[after]
        center = curves.bezier(a.center[-1], b.center[0], reach)
        width_a = float(np.hypot(*(a.left[-1] - a.right[-1])))
        width_b = float(np.hypot(*(b.left[0] - b.right[0])))
        half = np.linspace(width_a, width_b, len(center)) / 2
        left, right = curves.offset(center, half)[:, :2], curves.offset(center, -half)[:, :2]
        left[0], left[-1], right[0], right[-1] = a.left[-1], b.left[0], a.right[-1], b.right[0]
        lane = self.lane(center, left, right, "", speed, is_intersection=True, light_group=group)
        self.join(before, lane.lane_id)
        self.join(lane.lane_id, after)

    def mouth(self, name: str, arms: list[_Arm], island_radius: float = 0.0, round_to: float = 0.0) -> Junction:
        """The kerb ring of a junction whose arms are given counter-clockwise."""
        center = np.mean([arm.pose[:2] for arm in arms], axis=0)
        parts, kerbs = [], []
        for arm, after in zip(arms, arms[1:] + arms[:1], strict=True):
            left = curves.advance(arm.pose, 0.0, arm.road.half_width)
            right = curves.advance(after.pose, 0.0, -after.road.half_width)
            parts.append(curves.advance(arm.pose, 0.0, -arm.road.half_width)[None, :2])
            start, end = curves.advance(left, 0.0, turn=np.pi), right
            kerb = _rounded(start, end, center, round_to) if round_to else curves.bezier(start, end, 0.42)
            kerbs.append(kerb)
            parts.append(kerb[:, :2])
        ring = np.vstack([*parts, parts[0][:1]])
        junction = Junction(name, center, ring, tuple(kerbs), island_radius)
        self.junctions.append(junction)
        return junction


def _rounded(start: Array, end: Array, center: Array, radius: float) -> Array:
    """Kerb from `start` to `end` that follows the circle of a roundabout counter-clockwise in between."""
    angle_a = np.arctan2(*(start[:2] - center)[::-1]) + 0.30
    angle_b = np.arctan2(*(end[:2] - center)[::-1]) - 0.30
    angle_b = angle_a + (angle_b - angle_a) % (2 * np.pi)
    angles = np.linspace(angle_a, angle_b, 40)
    arc = np.column_stack([center + radius * np.column_stack([np.cos(angles), np.sin(angles)]), angles + np.pi / 2])
    return np.vstack([curves.bezier(start, arc[0], 0.35)[:-1], arc, curves.bezier(arc[-1], end, 0.35)[1:]])
