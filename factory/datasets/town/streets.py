"""The road network of the town: roads, junctions, lanes with their graph, drivable areas, crossings.

Traffic drives on the right. Where the streets lie is plan.py's matter.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
import shapely

from factory.datasets.town import curves
from tasks.world.arrays import Array
from tasks.world.road_map import arc_lengths

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


class _NetworkBuilder:
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


# Where the town's streets lie: the seeded plan that streets.py's builder turns into lanes and surfaces.
#
# A tree of roads around signalised crossroads: an avenue (2+2 lanes) east to a Y-branch, a curved avenue south, a
# narrow street with parked cars north, a winding street west to a roundabout.

JUNCTION_REACH_M = 17.0  # crossroads: centre to the arms' mouths
RING_M = 19.0  # roundabout: radius of the ring lane's centre
RING_WIDTH_M = 5.0
ROUNDABOUT_REACH_M = 38.0
RING_ZONE_RAD = 0.44  # half angle of the part of the ring that belongs to one arm
TURN_SPEED_MPS = 8.0
EAST_WEST, NORTH_SOUTH = 0, 1  # signal groups


def build_streets(rng: np.random.Generator) -> Streets:
    """The town's network; `rng` chooses lengths, bends, angles, and where on the map it lies."""
    b = _NetworkBuilder()
    north_up = float(rng.uniform(-np.pi, np.pi))
    origin = np.array([*rng.uniform(1500.0, 4500.0, 2), north_up])

    def mouth(angle: float) -> Array:
        return curves.advance(curves.advance(origin, 0.0, 0.0, angle), JUNCTION_REACH_M)

    lean = float(rng.uniform(-0.08, 0.08))
    side = float(rng.choice([-1.0, 1.0]))
    bend = 1.0 / float(rng.uniform(62.0, 80.0))
    avenue_line = curves.from_curvature(mouth(0.0), [(float(rng.uniform(225, 260)), 0.0)])
    south_line = curves.from_curvature(
        mouth(-np.pi / 2),
        [(float(rng.uniform(30, 45)), 0.0), (1.35 / bend, bend), (45.0, 0.0), (60.0, -0.006), (60.0, 0.0)],
    )
    north_line = curves.from_curvature(mouth(np.pi / 2 + lean), [(270.0, 0.0)])
    sway = side / float(rng.uniform(75.0, 95.0))
    west_line = curves.from_curvature(
        mouth(np.pi), [(40.0, 0.0), (35.0, sway), (70.0, -sway), (35.0, sway), (40.0, 0.0)]
    )
    avenue = TownRoad("avenue", avenue_line, 2, 3.5, "bike", 1.8, 13.5, crossing_at_start=True)
    south = TownRoad("south avenue", south_line, 2, 3.5, "bike", 1.8, 12.5, crossing_at_start=True)
    north = TownRoad("narrow street", north_line, 1, 3.3, "park", 2.3, 8.8, crossing_at_start=True)
    west = TownRoad("west street", west_line, 1, 3.5, "bike", 1.8, 11.5, crossing_at_start=True)
    arms, far = zip(*(b.road(road) for road in (avenue, north, west, south)), strict=True)
    _crossroads(b, list(arms))
    _y_branch(b, far[0], rng)
    _roundabout(b, far[2], rng)
    return Streets(tuple(b.roads), tuple(b.junctions), b.lanes, tuple(b.areas), tuple(b.crossings), tuple(b.posts))


def _crossroads(b: _NetworkBuilder, arms: list[_Arm]) -> None:
    """Signalised; arms in the order east, north, west, south."""
    junction = b.mouth("crossroads", arms)
    b.areas.append(_ring(shapely.Polygon(junction.ring).buffer(0.4)))
    for i, arm in enumerate(arms):
        group = EAST_WEST if i % 2 == 0 else NORTH_SOUTH
        right, straight, left = (arms[(i + k) % 4] for k in (1, 2, 3))
        first_connector = len(b.lanes)
        b.connect(arm.incoming[-1], right.outgoing[-1], TURN_SPEED_MPS, group)
        b.connect(arm.incoming[-1], straight.outgoing[-1], arm.road.speed_mps, group, 0.33)
        b.connect(arm.incoming[0], left.outgoing[0], TURN_SPEED_MPS, group)
        shown = list(b.lanes)[first_connector]
        h = arm.road.half_width
        pose = curves.advance(arm.pose, 0.3, h + 0.7, np.pi)
        b.posts.append(SignalPost(pose, shown, arm.road.lanes * arm.road.lane_width))
        edges = [
            np.array([curves.advance(arm.pose, ahead, d)[:2] for d in (-h, h)])
            for ahead in (CROSSING_GAP_M, CROSSING_GAP_M + CROSSING_M)
        ]
        b.crossings.append(Crossing(edges[0], edges[1], group))


def _y_branch(b: _NetworkBuilder, stem: _Arm, rng: np.random.Generator) -> None:
    """The avenue's inner lane goes to the left branch, the outer one to the right branch."""
    inward = curves.advance(stem.pose, 0.0, turn=np.pi)
    branches = []
    for name, sign in (("right branch", -1.0), ("left branch", 1.0)):
        angle = sign * float(rng.uniform(0.42, 0.55))
        start = curves.advance(inward, 27.0, sign * 8.8, angle)
        bend = -sign * float(rng.uniform(0.0, 0.004))
        line = curves.from_curvature(start, [(50.0, 0.0), (90.0, bend), (120.0, 0.0)])
        branches.append(b.road(TownRoad(name, line, 1, 3.5, "bike", 1.8, 11.5))[0])
    junction = b.mouth("branch", [stem, *branches])
    b.areas.append(_ring(shapely.Polygon(junction.ring).buffer(0.4)))
    right, left = branches
    b.connect(stem.incoming[0], left.outgoing[0], 11.0)
    b.connect(stem.incoming[1], right.outgoing[0], 11.0)
    b.connect(left.incoming[0], stem.outgoing[1], 11.0)
    b.connect(right.incoming[0], stem.outgoing[0], 11.0)


def _roundabout(b: _NetworkBuilder, stem: _Arm, rng: np.random.Generator) -> None:
    """Four arms around a single-lane ring, driven counter-clockwise; arcs between the arms are ordinary lanes."""
    inward = curves.advance(stem.pose, 0.0, turn=np.pi)
    center = curves.advance(inward, ROUNDABOUT_REACH_M)
    first_angle = float(stem.pose[2])
    arms = [stem]
    for k in (1, 2, 3):
        angle = first_angle + k * np.pi / 2 + float(rng.uniform(-0.06, 0.06))
        start = curves.advance(np.array([center[0], center[1], angle]), ROUNDABOUT_REACH_M)
        bend = float(rng.uniform(-0.004, 0.004))
        line = curves.from_curvature(start, [(60.0, 0.0), (80.0, bend), (90.0, 0.0)])
        arms.append(b.road(TownRoad(f"ring road {k}", line, 1, 3.5, "bike", 1.8, 11.5))[0])
    inner = RING_M - RING_WIDTH_M / 2
    junction = b.mouth("roundabout", arms, inner - 0.6, RING_M + RING_WIDTH_M / 2 + 0.8)
    angles = np.unwrap([float(arm.pose[2]) for arm in arms])
    angles = np.append(angles, angles[0] + 2 * np.pi)

    def arc(a: float, z: float) -> Array:
        around = np.linspace(a, z, max(2, int(np.ceil((z - a) * RING_M)) + 1))
        xy = center[:2] + RING_M * np.column_stack([np.cos(around), np.sin(around)])
        return np.column_stack([xy, around + np.pi / 2])

    arcs = []
    for a, z in zip(angles[:-1] + RING_ZONE_RAD, angles[1:] - RING_ZONE_RAD, strict=True):
        line = arc(a, z)
        left, right = curves.offset(line, RING_WIDTH_M / 2), curves.offset(line, -RING_WIDTH_M / 2)
        arcs.append(b.lane(line, left, right, "ring", TURN_SPEED_MPS).lane_id)
    for i, arm in enumerate(arms):
        before, after = arcs[i - 1], arcs[i]
        line = arc(angles[i] - RING_ZONE_RAD, angles[i] + RING_ZONE_RAD)
        left, right = curves.offset(line, RING_WIDTH_M / 2), curves.offset(line, -RING_WIDTH_M / 2)
        through = b.lane(line, left, right, "", TURN_SPEED_MPS, is_intersection=True).lane_id
        b.join(before, through)
        b.join(through, after)
        b.connect(arm.incoming[0], after, TURN_SPEED_MPS)
        b.connect(before, arm.outgoing[0], TURN_SPEED_MPS)
    surface = shapely.Polygon(junction.ring).buffer(0.4).difference(shapely.Point(center[:2]).buffer(inner - 0.6))
    before_and = np.concatenate([[angles[3] - 2 * np.pi], angles])
    for i in range(4):
        a, z = (before_and[i] + before_and[i + 1]) / 2, (before_and[i + 1] + before_and[i + 2]) / 2
        around = np.linspace(a - 0.05, z + 0.05, 12)
        wedge = np.vstack([center[:2], center[:2] + 60.0 * np.column_stack([np.cos(around), np.sin(around)])])
        b.areas.append(_ring(surface.intersection(shapely.Polygon(wedge))))


def _ring(area: shapely.Geometry) -> Array:
    """The exterior of a polygon's largest part, without the repeated point."""
    if area.geom_type != "Polygon":
        area = max(area.geoms, key=lambda part: part.area)
    return np.asarray(area.exterior.coords)[:-1, :2]
