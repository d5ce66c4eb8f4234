"""What stands still: road surfaces with paint, kerbs, pavements, houses, trees, lamps, signs, signal masts."""

import itertools
from dataclasses import dataclass

import numpy as np
import shapely

from factory.readers.town import curves
from factory.readers.town import textures as tx
from factory.readers.town.houses import KERB_M, PLAIN_Z, build_houses, plant_tree, plant_trees
from factory.readers.town.mesh import WHITE, Builder, lifted
from factory.readers.town.raster import Mesh
from factory.readers.town.streets import CROSSING_GAP_M, CROSSING_M, PAVEMENT_M, STOP_LINE_M, Streets, TownRoad
from factory.readers.town.traffic import GREEN, RED, YELLOW
from tasks.world.arrays import Array, Ints
from tasks.world.polygons import arc_lengths

LAMPS = {RED: (0, (0.95, 0.10, 0.06)), YELLOW: (1, (0.98, 0.75, 0.10)), GREEN: (2, (0.12, 0.90, 0.45))}
LAMP_OFF = (0.07, 0.07, 0.06)
MAST, LAMP_POST = (tx.METAL, (0.30, 0.32, 0.32)), (tx.METAL, (0.36, 0.38, 0.38))


@dataclass(frozen=True)
class Scenery:
    """The town's standing geometry."""

    mesh: Mesh
    marks: Array  # (roads, M, 9) lane paint, shade.road_paint
    lamps: tuple[Mesh, ...]  # per signal post, its lamps: thirds red, yellow, green
    lamp_groups: Ints  # (posts,) signal group


def lamps_lit(lamps: Mesh, state: int) -> Mesh:
    """The lamps of one post in a state."""
    third = np.arange(len(lamps.material)) % 30 // 10
    lit, colour = LAMPS[state]
    return lamps._replace(colour=np.where((third == lit)[:, None], colour, LAMP_OFF))


def build_scenery(streets: Streets, rng: np.random.Generator) -> Scenery:
    """Everything that does not move; houses and trees by `rng`."""
    b = Builder()
    for k, road in enumerate(streets.roads):
        _road(b, road, k)
    for junction in streets.junctions:
        _fan(b, [*junction.center, 0.0], lifted(junction.ring, 0.0), tx.ASPHALT)
        for kerb in junction.kerbs:
            _kerb(b, kerb, min(PAVEMENT_M, 2.6) if junction.name == "branch" else PAVEMENT_M)
        if junction.island_radius:
            _island(b, junction.center, junction.island_radius, rng)
    everything = np.vstack([road.line[:, :2] for road in streets.roads])
    middle, reach = (everything.min(0) + everything.max(0)) / 2, np.ptp(everything, axis=0).max() / 2 + 260.0
    _plain(b, middle, reach)
    taken = build_houses(b, streets, _reserved(streets), rng)
    plant_trees(b, streets, taken, rng)
    _furniture(b, streets, rng)
    lamps = tuple(_signal(b, post.pose, post.width) for post in streets.posts)
    groups = np.array([streets.lanes[post.lane_id].light_group for post in streets.posts], np.int64)
    return Scenery(b.mesh(), _road_marks(streets.roads), lamps, groups)


def _fan(b: Builder, middle: list[float], ring: Array, material: int) -> None:
    """Triangles from the middle to a ring (N, 3), their coordinates those of the world."""
    fan = np.stack([np.broadcast_to(middle, ring[1:].shape), ring[:-1], ring[1:]], axis=1)
    b.triangles(fan, fan[..., :2], material)


def _stations(line: Array) -> Ints:
    """Indices of a 1 m curve at which a ribbon is cut: denser in bends."""
    steps = np.maximum(
        np.diff(np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line[:, 2])))])) / 0.03,
        np.hypot(*np.diff(line[:, :2], axis=0).T) / 10.0,
    )
    wanted = np.cumsum(np.concatenate([[0.0], steps]))
    picks = np.searchsorted(wanted, np.arange(0.0, wanted[-1], 1.0))
    return np.unique(np.append(picks, len(line) - 1))


def _road_marks(roads: tuple[TownRoad, ...]) -> Array:
    """(roads, M, 9) paint rectangles in road coordinates (u along the line, d to its left), see shade.road_paint."""
    tables = [_marks_of(road) for road in roads]
    out = np.full((len(tables), max(map(len, tables)), 9), 1e9)
    for k, rows in enumerate(tables):
        out[k, : len(rows)] = rows
    return out


def _marks_of(road: TownRoad) -> list[list[float]]:
    length, h, parks = float(arc_lengths(road.line)[-1]), road.half_width, road.strip == "park"
    outer = road.lanes * road.lane_width
    rows: list[list[float]] = []

    def line(d: float, half: float, period: float = 0.0, dash: float = 0.0, yellow: float = 0.0) -> None:
        start = STOP_LINE_M if road.crossing_at_start else 0.0
        rows.append([d - half, d + half, start, length, period, dash, 0.0, 0.0, yellow])

    if parks:
        line(0.0, 0.06, 6.0, 3.0)
    else:
        line(0.11, 0.06, yellow=1.0)
        line(-0.11, 0.06, yellow=1.0)
    for side in (-1.0, 1.0):
        for k in range(1, road.lanes):
            line(side * k * road.lane_width, 0.07, 9.0, 3.5)
        if parks:
            across = sorted((side * outer, side * (outer + 2.1)))
            rows.append([*across, 26.0, length - 14.0, 6.4, 0.1, 0.0, 0.0, 0.0])
        line(side * outer, 0.07, *((3.0, 1.0) if parks else ()))
    if road.crossing_at_start:
        rows.append([-h + 0.35, h - 0.35, CROSSING_GAP_M, CROSSING_GAP_M + CROSSING_M, 0.0, 0.0, 1.0, 0.5, 0.0])
        rows.append([0.25, outer, STOP_LINE_M - 0.35, STOP_LINE_M, 0.0, 0.0, 0.0, 0.0, 0.0])
    return rows


def _road(b: Builder, road: TownRoad, index: int) -> None:
    cuts = _stations(road.line)
    s, h = arc_lengths(road.line)[cuts], road.half_width
    for left, right in itertools.pairwise(np.linspace(h, -h, 5)):
        a, z = (lifted(curves.offset(road.line[cuts], d), 0.0) for d in (left, right))
        b.strip(a, z, s, left, right, tx.ROAD, WHITE, index)
    _kerb(b, curves.offset(road.line, -h), PAVEMENT_M)
    _kerb(b, curves.reverse(curves.offset(road.line, h)), PAVEMENT_M)


def _kerb(b: Builder, edge: Array, pavement_m: float) -> None:
    """Kerb stone and pavement to the right of `edge`."""
    cuts = _stations(edge)
    line, s = edge[cuts], arc_lengths(edge)[cuts]
    foot, top = lifted(line, 0.0), lifted(line, KERB_M)
    back = lifted(curves.offset(line, -0.18), KERB_M)
    far, far_low = lifted(curves.offset(line, -pavement_m), KERB_M), lifted(curves.offset(line, -pavement_m), PLAIN_Z)
    b.strip(foot, top, s, 0.0, KERB_M, tx.KERB)
    b.strip(top, back, s, KERB_M, 0.3, tx.KERB)
    b.strip(back, far, s, 0.18, pavement_m, tx.PAVING)
    b.strip(far, far_low, s, 0.0, 0.2, tx.KERB)


def _island(b: Builder, center: Array, radius: float, rng: np.random.Generator) -> None:
    angle = np.linspace(0, 2 * np.pi, 41)
    ring = np.column_stack([center + radius * np.column_stack([np.cos(angle), np.sin(angle)]), angle - np.pi / 2])[::-1]
    foot, top = lifted(ring, 0.0), lifted(ring, 0.16)
    inner = center + (ring[:, :2] - center) * (1 - 1.2 / radius)
    s = arc_lengths(ring)
    b.strip(foot, top, s, 0.0, 0.16, tx.KERB)
    b.strip(top, lifted(inner, 0.22), s, 0.16, 1.4, tx.PAVING)
    _fan(b, [*center, 0.9], lifted(inner, 0.22), tx.GRASS)
    for k in range(5):
        turn = 2 * np.pi * k / 5 + 0.4
        plant_tree(b, center + 6.0 * np.array([np.cos(turn), np.sin(turn)]), 0.5, rng, 0.7)
    b.post(center, 0.6, 5.0, 0.9, tx.ISLAND_STONE, (0.62, 0.60, 0.56), 3, sides=8, taper=0.5)


def _plain(b: Builder, middle: Array, reach: float) -> None:
    """The lawn below everything, and a belt of far trees that ends the view."""
    ticks = np.linspace(-reach, reach, 9)
    spans = list(itertools.pairwise(ticks))
    cells = [[(x, y), (x_next, y), (x_next, y_next), (x, y_next)] for x, x_next in spans for y, y_next in spans]
    corners = np.array(cells) + middle
    b.quads(lifted(corners, PLAIN_Z), corners, tx.GRASS)
    angle = np.linspace(0, 2 * np.pi, 97)
    ring = middle + reach * 1.05 * np.column_stack([np.cos(angle), np.sin(angle)])
    for factor, height, tone in ((1.0, 16.0, (0.20, 0.27, 0.17)), (0.93, 12.0, (0.25, 0.32, 0.18))):
        line = middle + (ring - middle) * factor
        b.strip(lifted(line, PLAIN_Z), lifted(line, height), angle * reach, 0.0, height, tx.TREELINE, tone, 5)


def _reserved(streets: Streets) -> list[shapely.Geometry]:
    """Streets with their pavements: no house stands there."""
    roads = [
        shapely.LineString(road.line[:, :2]).buffer(road.half_width + PAVEMENT_M + 0.05, cap_style="flat")
        for road in streets.roads
    ]
    return roads + [shapely.Polygon(j.ring).buffer(PAVEMENT_M + 0.6) for j in streets.junctions]


def _furniture(b: Builder, streets: Streets, rng: np.random.Generator) -> None:
    """Street lamps, signs, litter bins, post boxes."""
    for road, side in itertools.product(streets.roads, (0, 1)):
        line = road.both_ways[side]
        end = arc_lengths(line)[-1] - 4.0
        for s in np.arange(10.0 + 15.0 * side, end, 30.0):
            foot = curves.beside(line, s, road.half_width + 0.45)
            arm = curves.advance(foot, 0.0, 1.9)
            b.post(foot, KERB_M, 7.2, 0.09, *LAMP_POST, taper=0.6)
            b.tube((*foot[:2], 7.1), (*arm[:2], 7.5), 0.05, *LAMP_POST, sides=5)
            b.box((*arm[:2], 7.45), (0.5, 0.5, 0.14), tx.METAL, (0.5, 0.5, 0.5))
        for s in np.arange(22.0, end, 27.0):
            kind = rng.random()
            at = curves.beside(line, s + float(rng.uniform(-5, 5)), road.half_width + 0.5)
            if kind < 0.5:
                b.post(at, KERB_M, 2.75, 0.035, tx.METAL, (0.55, 0.55, 0.55), sides=5)
                facing, seed = _facing(at), int(rng.integers(99))
                centre = np.array([*at[:2], 2.45]) + 0.05 * facing
                b.disc(centre, facing, 0.32, tx.SIGN, WHITE, seed, sides=14, uv_scale=1 / 0.32)
            elif kind < 0.8:
                b.post(at, KERB_M, 1.0, 0.24, tx.METAL, (0.16, 0.28, 0.18), sides=8)
            else:
                b.box((*at[:2], 0.75), (0.5, 0.45, 1.25), tx.METAL, (0.62, 0.10, 0.09))


def _facing(pose: Array) -> Array:
    """(3,) against the pose's heading: towards who comes."""
    return np.array([-np.cos(pose[2]), -np.sin(pose[2]), 0.0])


def _signal(b: Builder, pose: Array, width: float) -> Mesh:
    """A mast with an arm over the approach's lanes; returns its lamps, in thirds red, yellow, green per head."""
    arm_length = width + 1.2
    b.post(pose, KERB_M, 6.1, 0.12, *MAST, sides=7)
    b.tube((*pose[:2], 5.9), (*curves.advance(pose, 0.0, arm_length)[:2], 6.1), 0.07, *MAST)
    facing, lamps = _facing(pose), Builder()
    one = np.array([-facing[1], facing[0], 0.0])
    for left, z in ((0.0, 3.0), *((arm_length - 0.7 - 3.4 * k, 5.7) for k in range(max(1, int(width / 3.4))))):
        middle = np.array([*curves.advance(pose, 0.0, left)[:2], z]) + 0.18 * facing
        front = middle + 0.16 * facing
        plate = [(-0.28, -0.68), (0.28, -0.68), (0.28, 0.68), (-0.28, 0.68)]
        b.face([front + x * one + np.array([0, 0, up]) for x, up in plate], tx.DARK, (0.06, 0.06, 0.06))
        b.box(middle, (0.26, 0.26, 1.1), tx.DARK, (0.08, 0.09, 0.08))
        for k in range(3):
            lamp = front + 0.02 * facing + np.array([0, 0, 0.38 - 0.38 * k])
            lamps.disc(lamp, facing, 0.15, tx.GLOW, LAMP_OFF)
    return lamps.mesh()
