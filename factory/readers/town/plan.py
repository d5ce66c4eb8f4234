"""Where the town's streets lie: the seeded plan that streets.py's builder turns into lanes and surfaces.

A tree of roads around signalised crossroads: an avenue (2+2 lanes) east to a Y-branch, a curved avenue south, a narrow
street with parked cars north, a winding street west to a roundabout.
"""

import numpy as np
import shapely

from factory.readers.town import curves
from factory.readers.town.streets import (
    CROSSING_GAP_M,
    CROSSING_M,
    Crossing,
    SignalPost,
    Streets,
    TownRoad,
    _Arm,
    _Builder,
)
from tasks.world.arrays import Array

JUNCTION_REACH_M = 17.0  # crossroads: centre to the arms' mouths
RING_M = 19.0  # roundabout: radius of the ring lane's centre
RING_WIDTH_M = 5.0
ROUNDABOUT_REACH_M = 38.0
RING_ZONE_RAD = 0.44  # half angle of the part of the ring that belongs to one arm
TURN_SPEED_MPS = 8.0
EAST_WEST, NORTH_SOUTH = 0, 1  # signal groups


def build_streets(rng: np.random.Generator) -> Streets:
    """The town's network; `rng` chooses lengths, bends, angles, and where on the map it lies."""
    b = _Builder()
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


def _crossroads(b: _Builder, arms: list[_Arm]) -> None:
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


def _y_branch(b: _Builder, stem: _Arm, rng: np.random.Generator) -> None:
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


def _roundabout(b: _Builder, stem: _Arm, rng: np.random.Generator) -> None:
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
