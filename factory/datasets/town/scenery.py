"""What stands still: road surfaces with paint, kerbs, pavements, houses, trees, lamps, signs, signal masts."""

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely

from factory.datasets.town import curves
from factory.datasets.town import textures as tx
from factory.datasets.town.drive import GREEN, RED, YELLOW, TownTrack
from factory.datasets.town.raster import WHITE, Mesh, MeshBuilder, lifted, parse_colours
from factory.datasets.town.streets import CROSSING_GAP_M, CROSSING_M, PAVEMENT_M, STOP_LINE_M, Streets, TownRoad
from tasks.world.arrays import Array, Ints
from tasks.world.road_map import arc_lengths

# Houses with their awnings and balconies, and trees of leaf cards.

KERB_M = 0.12  # height
PLAIN_Z = -0.06  # the lawn around, below the road
AWNINGS = parse_colours("55 12 12, 14 32 24, 16 22 42, 78 70 52")
CROWNS = parse_colours("27 38 13, 22 33 14, 33 40 14, 40 36 13")
TILES = parse_colours("46 22 15, 28 27 29, 38 25 18")
CONCRETE, RAILING = (tx.ISLAND_STONE, (0.66, 0.64, 0.6)), (tx.DARK, (0.16, 0.16, 0.17))


def build_houses(
    b: MeshBuilder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator
) -> list[shapely.Geometry]:
    """Rows of houses along both sides of every street; returns what is taken now."""
    streets_area = shapely.unary_union(taken)
    shapely.prepare(streets_area)
    built: list[shapely.Geometry] = []
    for road in streets.roads:
        tall = 3.1 * (5 if "avenue" in road.name else 3 if road.name == "narrow street" else 2)
        for line in road.both_ways:
            s = float(rng.uniform(0.0, 6.0))
            while s < arc_lengths(line)[-1] - 8.0:
                width, depth = float(rng.uniform(9.0, 19.0)), float(rng.uniform(9.0, 13.0))
                setback = float(rng.choice([0.0, 0.0, 0.4, 2.5]))
                front = curves.pose_beside(line, s + width / 2, road.half_width + PAVEMENT_M + 0.15 + setback)
                plan = ((-width / 2, 0), (width / 2, 0), (width / 2, depth), (-width / 2, depth))
                corners = np.array([curves.advance(front, x, -y)[:2] for x, y in plan])
                plot = shapely.Polygon(corners)
                if not any(plot.intersects(other) for other in (streets_area, *built)):
                    built.append(plot)
                    _house(b, corners, tall * float(rng.uniform(0.75, 1.35)) + 1.2, int(rng.integers(1 << 20)), rng)
                s += width + float(rng.choice([0.0, 0.0, 0.3, 7.0]))
    return taken + built


def _house(b: MeshBuilder, corners: Array, height: float, seed: int, rng: np.random.Generator) -> None:
    """Four walls and a roof; corners (4, 2) start with the front's, from the street's left to right as driven."""
    low, top = lifted(corners, PLAIN_Z), lifted(corners, height)
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
        b.face([low[j], low[i], top[i], top[j]], tx.FACADE, seed=seed + i % 2)
    width, depth = (float(np.hypot(*(corners[k] - corners[0]))) for k in (1, 3))
    if tx.chance(seed, 1, 78) < 0.45 and height < 14.0:
        ridge = (top[[0, 1]] + top[[3, 2]]) / 2 + [0, 0, 0.32 * depth]
        for roof in ([top[0], top[1], ridge[1], ridge[0]], [top[2], top[3], ridge[0], ridge[1]]):
            b.face(roof, tx.ROOF_TILES, TILES[seed % 3], seed)
        for gable in ([top[1], top[2], ridge[1]], [top[3], top[0], ridge[0]]):
            b.triangles([gable], [[(0, 0), (6, 0), (3, 3)]], tx.ISLAND_STONE, (0.62, 0.56, 0.48))
        b.box(ridge[0] * 0.7 + ridge[1] * 0.3, (0.8, 0.6, 1.8), tx.ISLAND_STONE, (0.45, 0.28, 0.22))
    else:
        b.face(top, tx.FLAT_ROOF, (0.45, 0.45, 0.45))
    along = (corners[1] - corners[0]) / width
    outward = (corners[0] - corners[3]) / depth
    ground = 3.3 + tx.chance(seed, 2, 77) * 0.9
    if tx.chance(seed, 6, 77) < 0.55:
        for k in range(int(width / 4.6)):
            if rng.random() < 0.45:
                a, z = corners[1] - along * (4.6 * k + 0.2), corners[1] - along * (4.6 * k + 4.3)
                colour, (foot, head) = AWNINGS[int(rng.integers(4))], (ground - 1.35, ground - 0.85)
                front = [(*(p + outward * 1.1), foot) for p in (a, z)]
                b.face([*front, *((*(p + outward * 0.02), head) for p in (z, a))], tx.CLOTH, colour, seed)
                lip = [(x, y, foot - 0.25) for x, y, _ in front[::-1]]
                b.face(front + lip, tx.CLOTH, colour * 0.85, seed)
    elif height > 8.0:
        floor = 2.9 + tx.chance(seed, 3, 77) * 0.5
        for z in np.arange(ground + 0.1, height - 3.0, floor):
            for x in np.arange(2.0, width - 3.0, 5.4):
                if rng.random() < 0.6:
                    _balcony(b, corners[1] - along * x, -along, outward, float(z))


def _balcony(b: MeshBuilder, corner: Array, along: Array, outward: Array, z: float) -> None:
    """A slab of 2.4 x 1.0 m with a railing."""
    p = [corner, corner + along * 2.4, corner + along * 2.4 + outward, corner + outward]
    b.face([(*q, z) for q in p], *CONCRETE)
    for a, e in ((p[1], p[2]), (p[2], p[3]), (p[3], p[0])):
        b.face([(*a, z - 0.15), (*e, z - 0.15), (*e, z), (*a, z)], *CONCRETE)
        b.tube((*a, z + 1.0), (*e, z + 1.0), 0.03, *RAILING, sides=4)
        for t in np.linspace(0.0, 1.0, 7):
            b.post(a + (e - a) * t, z, z + 1.0, 0.012, *RAILING, sides=3)


def plant_trees(b: MeshBuilder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator) -> None:
    """Street trees in the pavement, garden trees and hedges between and behind the houses."""
    blocked = shapely.unary_union([g.buffer(1.5) for g in taken])
    shapely.prepare(blocked)
    for road in streets.roads:
        for line in road.both_ways:
            length = arc_lengths(line)[-1]
            for s in np.arange(12.0, length - 4.0, 13.0 if road.name == "narrow street" else 9.5):
                if rng.random() < 0.62:
                    at = curves.pose_beside(line, s + float(rng.uniform(-2, 2)), road.half_width + 0.75)
                    plant_tree(b, at[:2], KERB_M, rng, float(rng.uniform(0.65, 1.0)))
            for s in np.arange(3.0, length, 7.0):
                at = curves.pose_beside(line, s, road.half_width + PAVEMENT_M + float(rng.uniform(2.5, 24.0)))
                if rng.random() < 0.8 and not blocked.contains(shapely.Point(at[:2])):
                    plant_tree(b, at[:2], PLAIN_Z, rng, float(rng.uniform(0.8, 1.5)))


def plant_tree(b: MeshBuilder, at: Array, z: float, rng: np.random.Generator, size: float) -> None:
    """A trunk and a crown of twigs: cards with leaves cut out, lit as parts of a round crown."""
    trunk = 2.5 * size**0.5 + 0.4
    bark = tx.BARK, (0.33, 0.27, 0.21), int(rng.integers(1 << 16))
    b.post(at, z, z + trunk + 1.0, 0.15 * size + 0.05, *bark, sides=7, taper=0.7)
    radii, middle = np.array([1.75, 1.75, 2.1]) * size, np.array([*at, z + trunk + 2.1 * size * 0.75])
    n = int(64 * size)
    outward = _unit(rng.normal(size=(n, 3)))
    centre = outward * radii * rng.uniform(0.45, 1.0, (n, 1)) ** 0.6
    one = _unit(np.cross(outward, rng.normal(size=(n, 3))))
    two = _unit(np.cross(outward * 0.7 + rng.normal(size=(n, 3)) * 0.5, one))
    centre = centre + middle
    half = 0.85
    square = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corners = np.stack([centre + x * one + y * two for x, y in square], axis=1)
    base = CROWNS[int(rng.integers(4))]
    depth = 0.62 + 0.38 * np.linalg.norm((centre - middle) / radii, axis=1)
    colour = base * depth[:, None] * rng.uniform(0.8, 1.15, (n, 1))
    b.quads(
        corners, np.broadcast_to(square, (n, 4, 2)), tx.LEAVES, colour, rng.integers(1 << 16, size=n), normals=outward
    )


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


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
    b = MeshBuilder()
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
    beside = PAVEMENT_M + 0.05  # no house stands on a street or its pavements
    shapes = [shapely.LineString(r.line[:, :2]).buffer(r.half_width + beside, cap_style="flat") for r in streets.roads]
    shapes += [shapely.Polygon(j.ring).buffer(PAVEMENT_M + 0.6) for j in streets.junctions]
    taken = build_houses(b, streets, shapes, rng)
    plant_trees(b, streets, taken, rng)
    _furniture(b, streets, rng)
    lamps = tuple(_signal(b, post.pose, post.width) for post in streets.posts)
    groups = np.array([streets.lanes[post.lane_id].light_group for post in streets.posts], np.int64)
    marks = [_marks_of(road) for road in streets.roads]  # rectangles (u along the line, d to its left), see road_paint
    table = np.full((len(marks), max(map(len, marks)), 9), 1e9)
    for k, rows in enumerate(marks):
        table[k, : len(rows)] = rows
    return Scenery(b.mesh(), table, lamps, groups)


def _fan(b: MeshBuilder, middle: list[float], ring: Array, material: int) -> None:
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


def _road(b: MeshBuilder, road: TownRoad, index: int) -> None:
    cuts = _stations(road.line)
    s, h = arc_lengths(road.line)[cuts], road.half_width
    for left, right in itertools.pairwise(np.linspace(h, -h, 5)):
        a, z = (lifted(curves.offset(road.line[cuts], d), 0.0) for d in (left, right))
        b.strip(a, z, s, left, right, tx.ROAD, WHITE, index)
    _kerb(b, curves.offset(road.line, -h), PAVEMENT_M)
    _kerb(b, curves.reverse(curves.offset(road.line, h)), PAVEMENT_M)


def _kerb(b: MeshBuilder, edge: Array, pavement_m: float) -> None:
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


def _island(b: MeshBuilder, center: Array, radius: float, rng: np.random.Generator) -> None:
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


def _plain(b: MeshBuilder, middle: Array, reach: float) -> None:
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


def _furniture(b: MeshBuilder, streets: Streets, rng: np.random.Generator) -> None:
    """Street lamps, signs, litter bins, post boxes."""
    for road, side in itertools.product(streets.roads, (0, 1)):
        line = road.both_ways[side]
        end = arc_lengths(line)[-1] - 4.0
        for s in np.arange(10.0 + 15.0 * side, end, 30.0):
            foot = curves.pose_beside(line, s, road.half_width + 0.45)
            arm = curves.advance(foot, 0.0, 1.9)
            b.post(foot, KERB_M, 7.2, 0.09, *LAMP_POST, taper=0.6)
            b.tube((*foot[:2], 7.1), (*arm[:2], 7.5), 0.05, *LAMP_POST, sides=5)
            b.box((*arm[:2], 7.45), (0.5, 0.5, 0.14), tx.METAL, (0.5, 0.5, 0.5))
        for s in np.arange(22.0, end, 27.0):
            kind = rng.random()
            at = curves.pose_beside(line, s + float(rng.uniform(-5, 5)), road.half_width + 0.5)
            if kind < 0.5:
                b.post(at, KERB_M, 2.75, 0.035, tx.METAL, (0.55, 0.55, 0.55), sides=5)
                facing, seed = _against_heading(at), int(rng.integers(99))
                centre = np.array([*at[:2], 2.45]) + 0.05 * facing
                b.disc(centre, facing, 0.32, tx.SIGN, WHITE, seed, sides=14, uv_scale=1 / 0.32)
            elif kind < 0.8:
                b.post(at, KERB_M, 1.0, 0.24, tx.METAL, (0.16, 0.28, 0.18), sides=8)
            else:
                b.box((*at[:2], 0.75), (0.5, 0.45, 1.25), tx.METAL, (0.62, 0.10, 0.09))


def _against_heading(pose: Array) -> Array:
    """(3,) against the pose's heading: towards who comes."""
    return np.array([-np.cos(pose[2]), -np.sin(pose[2]), 0.0])


def _signal(b: MeshBuilder, pose: Array, width: float) -> Mesh:
    """A mast with an arm over the approach's lanes; returns its lamps, in thirds red, yellow, green per head."""
    arm_length = width + 1.2
    b.post(pose, KERB_M, 6.1, 0.12, *MAST, sides=7)
    b.tube((*pose[:2], 5.9), (*curves.advance(pose, 0.0, arm_length)[:2], 6.1), 0.07, *MAST)
    facing, lamps = _against_heading(pose), MeshBuilder()
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


# Cars, trucks, buses, pedestrians and cyclists as meshes in their own frame: x forward, y left, z up from the road.

CAR_PAINT = parse_colours(
    "62 64 66, 12 12 13, 85 85 84, 36 38 40, 50 8 9, 11 20 42, 18 30 24, 70 62 50, 74 72 70, 60 30 10"
)
BUS_PAINT = parse_colours("72 12 10, 10 30 55, 80 66 12")
CLOTHES = parse_colours("20 24 40, 55 12 14, 14 14 15, 66 64 58, 18 38 30, 75 55 18, 36 20 38, 30 45 62")
SKIN = parse_colours("80 62 50, 55 38 28, 70 52 40, 36 24 18")
HAIR = parse_colours("10 7 5, 30 20 10, 5 5 5, 50 42 30")
HEAD_LIGHT, TAIL_LIGHT, PLATE = (0.95, 0.95, 0.88), (0.62, 0.05, 0.05), (0.86, 0.84, 0.70)
WINDSCREEN = (0.14, 0.15, 0.17)
GLASS_UV = [(0.08, 0.05), (0.44, 0.05), (0.44, 0.95), (0.08, 0.95)]
SIDES = (-1.0, 1.0)  # right, left
STRIDE_M = 1.4  # a pedestrian's two steps

Corners = list[tuple[float, float, float]]


def track_mesh(track: TownTrack, step: int) -> Mesh:
    """The track's mesh at one step, in the world."""
    look = track.look % 64
    if walker := WALKERS.get(track.category):
        walked = np.nancumsum(np.r_[0.0, np.hypot(*np.diff(track.poses[:, :2], axis=0).T)])
        moving = walked[min(step + 1, len(walked) - 1)] - walked[max(step - 1, 0)] > 0.05
        template = walker(look, int(walked[step] / STRIDE_M * 16) % 16 if moving else 0)
    else:
        template = VEHICLES.get(track.category, _car)(*track.size, look)
    return template.placed(track.poses[step])


def _pick(palette: Array, look: int) -> Array:
    colour: Array = palette[look % len(palette)]
    return colour


def _panel(
    low: tuple[float, float],
    high: tuple[float, float],
    y: tuple[float, float],
    y_high: tuple[float, float] | None = None,
) -> Corners:
    """A face across the vehicle: its edges at (x, z) `low` and `high` go from one y to the other."""
    (a, z), (a_high, z_high) = y, y_high or y
    return [(low[0], a, low[1]), (low[0], z, low[1]), (high[0], z_high, high[1]), (high[0], a_high, high[1])]


def _level(rear: float, front: float, half_width: float, z: float) -> Corners:
    return [(rear, -half_width, z), (front, -half_width, z), (front, half_width, z), (rear, half_width, z)]


def _lamps(b: MeshBuilder, side: float, w: float, head: tuple[float, ...], tail: tuple[float, ...]) -> None:
    """Lamps: x and z below, x and z above, and from where to where inwards of half the width w."""
    for (x, z, x_high, z_high, inner, outer), light in ((head, HEAD_LIGHT), (tail, TAIL_LIGHT)):
        b.face(_panel((x, z), (x_high, z_high), (side * (w - inner), side * (w - outer))), tx.GLOW, light)


def _underside_and_wheels(
    b: MeshBuilder, length: float, width: float, axles: tuple[float, ...], track: float, radius: float
) -> None:
    """The dark under a vehicle, where no sky reaches, and its wheels."""
    b.face(_level(-0.48 * length, 0.48 * length, 0.48 * width, 0.02), tx.DARK, (0.10, 0.10, 0.10))
    for x, side in itertools.product(axles, SIDES):
        y, axis = side * track, (0.0, side, 0.0)
        b.disc((x, y + side * 0.004, radius + 0.03), axis, radius * 1.2, tx.DARK, (0.05, 0.05, 0.05), sides=14)
        b.disc((x, y + side * 0.012, radius), axis, radius, tx.WHEEL, sides=14, uv_scale=0.34 / radius)
        inside, outside = ((x, y + side * out, radius) for out in (-0.22, 0.01))
        b.tube(inside, outside, radius, tx.DARK, (0.07, 0.07, 0.07), sides=10)


@lru_cache(maxsize=1024)
def _car(length: float, width: float, height: float, look: int) -> Mesh:
    b, paint = MeshBuilder(), _pick(CAR_PAINT, look)
    f, r, w, h = length / 2, -length / 2, width / 2, height
    estate = height > 1.6 or look % 3 == 0
    belt = 0.60 * h
    hull = [(f - 0.02, 0.22), (f, 0.48), (f - 0.06, 0.66), (f - 0.28, 0.74), (f - 1.12, belt)]
    hull += [(r + (0.10 if estate else 0.55), belt + 0.02), (r + 0.04, belt - 0.02), (r, 0.55), (r + 0.05, 0.24)]
    for low, high in itertools.pairwise(hull):
        b.face(_panel(low, high, (w, -w)), tx.DARK if min(low[1], high[1]) < 0.3 else tx.METAL, 0.96 * paint)
    ring = np.array(hull)
    for side in SIDES:
        a = np.insert(ring, 1, side * w, axis=1)
        points = np.stack([np.broadcast_to([0.0, side * w, 0.45], a.shape), a, np.roll(a, -1, axis=0)], axis=1)
        uv = np.stack([points[..., 0] - r, points[..., 2]], axis=-1)
        b.triangles(points, uv, tx.PAINTED, paint, look, extent=(length, height))
    base_f, base_r = f - 1.08, r + (0.12 if estate else 0.52)
    roof_f, roof_r = f - 1.85, r + (0.42 if estate else 1.15)
    inner, top = w - 0.06, w - 0.24
    for side in SIDES:
        low_edge, top_edge = (
            [(x, side * inner, belt) for x in (base_r, base_f)],
            [(x, side * top, h) for x in (roof_f, roof_r)],
        )
        b.face(low_edge + top_edge, tx.CABIN, paint, look, uv=[(0, 0), (1, 0), (1, 1), (0, 1)])
    for x0, x1 in ((base_f, roof_f), (base_r, roof_r)):
        glass = _panel((x0, belt), (x1, h), (-inner, inner), (-top, top))
        b.face(glass, tx.CABIN, WINDSCREEN, look, uv=GLASS_UV)
    b.face(_level(roof_r, roof_f, top, h), tx.METAL, paint)
    for side in SIDES:
        _lamps(b, side, w, (f + 0.004, 0.56, f - 0.05, 0.70, 0.38, 0.04), (r - 0.006, 0.60, r + 0.02, 0.82, 0.38, 0.04))
        b.box((base_f - 0.15, side * (w + 0.08), belt + 0.06), (0.12, 0.16, 0.13), tx.METAL, paint)
    for x in (f + 0.006, r - 0.008):
        b.face(_panel((x, 0.42), (x, 0.53), (-0.26, 0.26)), tx.GLOW, PLATE)
    b.face(_panel((f + 0.004, 0.57), (f - 0.04, 0.67), (-0.5, 0.5)), tx.DARK, (0.06, 0.06, 0.06))
    b.face(_level(r + 0.1, f - 0.1, w, 0.2), tx.DARK, (0.04, 0.04, 0.04))
    _underside_and_wheels(b, length, width, (f - 0.85, r + 0.85), w, 0.33)
    return b.mesh()


@lru_cache(maxsize=1024)
def _truck(length: float, width: float, height: float, look: int) -> Mesh:
    b, paint = MeshBuilder(), _pick(CAR_PAINT, look)
    f, r, w = length / 2, -length / 2, width / 2
    cab = f - 1.9
    b.box(((cab + f) / 2, 0.0, 1.0), (1.9, width * 0.92, 1.1), tx.METAL, paint)
    b.box(((cab + f) / 2 - 0.05, 0.0, 1.95), (1.8, width * 0.92, 0.8), tx.CABIN, paint, look, taper=0.92)
    glass = _panel((f - 0.02, 1.5), (f - 0.11, 2.25), (w * 0.8, -w * 0.8), (w * 0.76, -w * 0.76))
    b.face(glass, tx.CABIN, WINDSCREEN, look, uv=GLASS_UV)
    box_f = cab - 0.15
    for side in SIDES:
        wall = [(r, 0.85), (box_f, 0.85), (box_f, height), (r, height)]
        b.face([(x, side * w, z) for x, z in wall], tx.CARGO, paint, look)
        _lamps(b, side, w, (f + 0.004, 0.62, f + 0.004, 0.85, 0.5, 0.15), (r - 0.006, 0.9, r - 0.006, 1.2, 0.3, 0.08))
    for x in (r, box_f):
        b.face(_panel((x, 0.85), (x, height), (-w, w)), tx.CARGO, paint, look)
    b.face(_level(r, box_f, w, height), tx.METAL, (0.8, 0.8, 0.8))
    b.box((0.0, 0.0, 0.68), (length * 0.94, width * 0.5, 0.36), tx.DARK, (0.07, 0.07, 0.07))
    _underside_and_wheels(b, length, width, (f - 1.0, r + 1.3), w - 0.02, 0.45)
    return b.mesh()


@lru_cache(maxsize=1024)
def _bus(length: float, width: float, height: float, look: int) -> Mesh:
    b, paint = MeshBuilder(), _pick(BUS_PAINT, look)
    f, r, w = length / 2, -length / 2, width / 2
    for (x0, y0), (x1, y1) in itertools.pairwise([(f, w), (r, w), (r, -w), (f, -w), (f, w)]):
        b.face([(x0, y0, 0.3), (x1, y1, 0.3), (x1, y1, height), (x0, y0, height)], tx.BUS_SIDE, paint, look)
    b.face(_level(r, f, w, height), tx.METAL, (0.85, 0.85, 0.84))
    for side in SIDES:
        _lamps(b, side, w, *((x, 0.6, x, 0.85, 0.45, 0.12) for x in (f + 0.006, r - 0.006)))
    _underside_and_wheels(b, length, width, (f - 2.4, r + 3.0), w, 0.48)
    return b.mesh()


@lru_cache(maxsize=1024)
def _person(look: int, phase: int) -> Mesh:
    """A walker, 1.75 m; legs and arms swing with `phase` in sixteenths of a stride."""
    b, shirt, trousers = MeshBuilder(), _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
    swing = 0.32 * np.sin(2 * np.pi * phase / 16)
    for side, s in ((-1.0, swing), (1.0, -swing)):
        y = side * 0.10
        b.tube((0.0, y, 0.90), (s, y, 0.08), 0.09, tx.CLOTH, trousers, look, sides=6, taper=0.75)
        b.box((s + 0.05, y, 0.05), (0.27, 0.10, 0.10), tx.DARK, (0.1, 0.09, 0.08))
        b.tube((0.0, side * 0.22, 1.42), (-s * 0.8, side * 0.25, 0.88), 0.055, tx.CLOTH, shirt, look, sides=5)
    b.box((0.0, 0.0, 1.17), (0.24, 0.40, 0.62), tx.CLOTH, shirt, look, taper=0.95)
    _head(b, 0.0, look)
    return b.mesh()


def _head(b: MeshBuilder, x: float, look: int) -> None:
    b.post((x, 0.0), 1.60 - 0.14, 1.60 + 0.02, 0.085, tx.CLOTH, _pick(SKIN, look), look, sides=8, taper=1.15)
    b.post((x, 0.0), 1.60 + 0.02, 1.60 + 0.14, 0.10, tx.CLOTH, _pick(HAIR, look // 4), look, sides=8, taper=0.45)


@lru_cache(maxsize=1024)
def _cyclist(look: int, phase: int) -> Mesh:
    """A rider on a bicycle; pedals turn with `phase`."""
    b, shirt, trousers = MeshBuilder(), _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
    for x in (-0.52, 0.52):
        b.disc((x, 0.0, 0.345), (0.0, 1.0, 0.0), 0.345, tx.SPOKES, (0.08, 0.08, 0.08), sides=14)
    for x, z, x_high, z_high in (
        *((-0.52, 0.345, -0.1, 0.85), (-0.05, 0.3, 0.42, 0.85), (-0.15, 0.8, 0.42, 0.82)),
        *((-0.05, 0.3, -0.18, 0.9), (0.52, 0.345, 0.40, 1.0)),
    ):
        b.tube((x, 0, z), (x_high, 0, z_high), 0.022, tx.METAL, _pick(CAR_PAINT, look + 3), sides=5)
    b.tube((0.38, -0.28, 1.0), (0.38, 0.28, 1.0), 0.02, tx.DARK, (0.1, 0.1, 0.1), sides=5)
    for side in SIDES:
        turn = 2 * np.pi * phase / 16 + (np.pi if side > 0 else 0.0)
        pedal = (-0.02 + 0.17 * np.cos(turn), side * 0.12, 0.32 + 0.17 * np.sin(turn))
        knee = (0.22, side * 0.11, 0.72 + 0.08 * np.sin(turn))
        b.tube((-0.16, side * 0.09, 0.95), knee, 0.085, tx.CLOTH, trousers, look)
        b.tube(knee, pedal, 0.06, tx.CLOTH, trousers, look)
        b.tube((0.12, side * 0.20, 1.38), (0.38, side * 0.25, 1.02), 0.05, tx.CLOTH, shirt, look, sides=5)
    b.tube((-0.18, 0.0, 0.92), (0.12, 0.0, 1.42), 0.17, tx.CLOTH, shirt, look, sides=7)
    _head(b, 0.2, look)
    return b.mesh()


WALKERS = {"PEDESTRIAN": _person, "BICYCLIST": _cyclist}
VEHICLES = {"BUS": _bus, "BOX_TRUCK": _truck}  # and cars
