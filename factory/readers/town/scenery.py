"""What stands still: road surfaces with paint, kerbs, pavements, houses, trees, lamps, signs, signal masts."""

import itertools
from dataclasses import dataclass

import numpy as np
import shapely

from factory.readers.town import curves
from factory.readers.town import textures as tx
from factory.readers.town.houses import KERB_M, PLAIN_Z, build_houses, plant_tree, plant_trees
from factory.readers.town.mesh import Builder, Mesh, lifted
from factory.readers.town.streets import CROSSING_GAP_M, CROSSING_M, PAVEMENT_M, STOP_LINE_M, Road, Streets
from factory.readers.town.traffic import GREEN, RED, YELLOW
from tasks.world.arrays import Array, Ints

LAMPS = {RED: (0, (0.95, 0.10, 0.06)), YELLOW: (1, (0.98, 0.75, 0.10)), GREEN: (2, (0.12, 0.90, 0.45))}
LAMP_OFF = (0.07, 0.07, 0.06)


@dataclass(frozen=True)
class Scenery:
    """The town's standing geometry."""

    mesh: Mesh
    marks: Array  # (roads, M, 9) lane paint, shade.road_paint
    lamps: tuple[Mesh, ...]  # per signal post, its lamps: thirds red, yellow, green
    lamp_groups: Ints  # (posts,) signal group


def lamps_lit(lamps: Mesh, state: int) -> Mesh:
    """The lamps of one post in a state."""
    third = np.arange(len(lamps)) % 30 // 10
    lit, colour = LAMPS[state]
    colours = np.where((third == lit)[:, None], colour, LAMP_OFF)
    return Mesh(lamps.vertices, lamps.uv, lamps.normals, lamps.material, colours, lamps.extent, lamps.seed)


def build_scenery(streets: Streets, rng: np.random.Generator) -> Scenery:
    """Everything that does not move; houses and trees by `rng`."""
    b = Builder()
    marks = _road_marks(streets.roads)
    for k, road in enumerate(streets.roads):
        _road(b, road, k)
    for junction in streets.junctions:
        fan = np.stack(
            [np.broadcast_to(junction.center, junction.ring[1:].shape), junction.ring[:-1], junction.ring[1:]], 1
        )
        b.triangles(lifted(fan, 0.0), fan, tx.ASPHALT)
        for kerb in junction.kerbs:
            _kerb(b, kerb, min(PAVEMENT_M, 2.6) if junction.name == "branch" else PAVEMENT_M)
        if junction.island_radius:
            _island(b, junction.center, junction.island_radius, rng)
    everything = np.vstack([road.line[:, :2] for road in streets.roads])
    middle, reach = (everything.min(0) + everything.max(0)) / 2, np.ptp(everything, axis=0).max() / 2 + 260.0
    _plain(b, middle, reach)
    taken = _reserved(streets)
    taken = build_houses(b, streets, taken, rng)
    plant_trees(b, streets, taken, rng)
    _furniture(b, streets, rng)
    lamps = tuple(_signal(b, post.pose, post.width) for post in streets.posts)
    groups = np.array([streets.lanes[post.lane_id].light_group for post in streets.posts], np.int64)
    return Scenery(b.mesh(), marks, lamps, groups)


def _stations(line: Array) -> Ints:
    """Indices of a 1 m curve at which a ribbon is cut: denser in bends."""
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line[:, 2])))])
    wanted = np.cumsum(
        np.concatenate([[0.0], np.maximum(np.diff(turned) / 0.03, np.hypot(*np.diff(line[:, :2], axis=0).T) / 10.0)])
    )
    picks = np.searchsorted(wanted, np.arange(0.0, wanted[-1], 1.0))
    return np.unique(np.append(picks, len(line) - 1))


def _road_marks(roads: tuple[Road, ...]) -> Array:
    """(roads, M, 9) paint rectangles in road coordinates (u along the line, d to its left), see shade.road_paint."""
    tables = []
    for road in roads:
        length, h = float(curves.arc_length(road.line)[-1]), road.half_width
        start = STOP_LINE_M if road.crossing_at_start else 0.0
        end = length - (STOP_LINE_M if road.crossing_at_end else 0.0)
        rows: list[list[float]] = []

        def line(d: float, half: float, period: float = 0.0, dash: float = 0.0, yellow: float = 0.0) -> None:
            rows.append([d - half, d + half, start, end, period, dash, 0.0, 0.0, yellow])  # noqa: B023

        if road.strip == "park":
            line(0.0, 0.06, 6.0, 3.0)
        else:
            line(0.11, 0.06, yellow=1.0)
            line(-0.11, 0.06, yellow=1.0)
        for side in (-1.0, 1.0):
            for k in range(1, road.lanes):
                line(side * k * road.lane_width, 0.07, 9.0, 3.5)
            outer = road.lanes * road.lane_width
            if road.strip == "park":
                rows.append(
                    [*sorted((side * outer, side * (outer + 2.1))), 26.0, length - 14.0, 6.4, 0.1, 0.0, 0.0, 0.0]
                )
            line(side * outer, 0.07, *((3.0, 1.0) if road.strip == "park" else (0.0, 0.0)))
        for has, near, sign in ((road.crossing_at_start, 0.0, 1.0), (road.crossing_at_end, length, -1.0)):
            if has:
                a, z = sorted((near + sign * CROSSING_GAP_M, near + sign * (CROSSING_GAP_M + CROSSING_M)))
                rows.append([-h + 0.35, h - 0.35, a, z, 0.0, 0.0, 1.0, 0.5, 0.0])
                a, z = sorted((near + sign * (STOP_LINE_M - 0.35), near + sign * STOP_LINE_M))
                span = (0.25, outer) if sign > 0 else (-outer, -0.25)
                rows.append([*span, a, z, 0.0, 0.0, 0.0, 0.0, 0.0])
        tables.append(rows)
    out = np.full((len(tables), max(map(len, tables)), 9), 1e9)
    for k, rows in enumerate(tables):
        out[k, : len(rows)] = rows
    return out


def _road(b: Builder, road: Road, index: int) -> None:
    cuts = _stations(road.line)
    s, h = curves.arc_length(road.line)[cuts], road.half_width
    offsets = np.linspace(h, -h, 5)
    for left, right in itertools.pairwise(offsets):
        a, z = (lifted(curves.offset(road.line[cuts], d), 0.0) for d in (left, right))
        b.strip(a, z, s, left, right, tx.ROAD, seed=index)
    _kerb(b, curves.offset(road.line, -h), PAVEMENT_M)
    _kerb(b, curves.reverse(curves.offset(road.line, h)), PAVEMENT_M)


def _kerb(b: Builder, edge: Array, pavement_m: float) -> None:
    """Kerb stone and pavement to the right of `edge`."""
    cuts = _stations(edge)
    line, s = edge[cuts], curves.arc_length(edge)[cuts]
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
    s = curves.arc_length(ring)
    b.strip(foot, top, s, 0.0, 0.16, tx.KERB)
    b.strip(top, lifted(inner, 0.22), s, 0.16, 1.4, tx.PAVING)
    fan = np.stack([np.broadcast_to([*center, 0.9], (40, 3)), lifted(inner[:-1], 0.22), lifted(inner[1:], 0.22)], 1)
    b.triangles(fan, fan[..., :2], tx.GRASS)
    for k in range(5):
        turn = 2 * np.pi * k / 5 + 0.4
        plant_tree(b, center + 6.0 * np.array([np.cos(turn), np.sin(turn)]), 0.5, rng, 0.7)
    b.tube(
        (center[0], center[1], 0.6), (center[0], center[1], 5.0), 0.9, tx.ISLAND_STONE, (0.62, 0.60, 0.56), 3, 8, 0.5
    )


def _plain(b: Builder, middle: Array, reach: float) -> None:
    """The lawn below everything, and a belt of far trees that ends the view."""
    ticks = np.linspace(-reach, reach, 9)
    cells = [
        [(ticks[i], ticks[j]), (ticks[i + 1], ticks[j]), (ticks[i + 1], ticks[j + 1]), (ticks[i], ticks[j + 1])]
        for i in range(8)
        for j in range(8)
    ]
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
    for road in streets.roads:
        for side, line in enumerate((road.line, curves.reverse(road.line))):
            s_line = curves.arc_length(line)
            for s in np.arange(10.0 + 15.0 * side, s_line[-1] - 4.0, 30.0):
                foot = curves.advance(curves.at(line, s_line, s), 0.0, -(road.half_width + 0.45))
                arm = curves.advance(foot, 0.0, 1.9)
                b.tube((*foot[:2], KERB_M), (*foot[:2], 7.2), 0.09, tx.METAL, (0.36, 0.38, 0.38), sides=6, taper=0.6)
                b.tube((*foot[:2], 7.1), (*arm[:2], 7.5), 0.05, tx.METAL, (0.36, 0.38, 0.38), sides=5)
                b.box((float(arm[0]), float(arm[1]), 7.45), (0.5, 0.5, 0.14), tx.METAL, (0.5, 0.5, 0.5))
            for s in np.arange(22.0, s_line[-1] - 4.0, 27.0):
                kind = rng.random()
                at = curves.advance(
                    curves.at(line, s_line, s + float(rng.uniform(-5, 5))), 0.0, -(road.half_width + 0.5)
                )
                x, y = float(at[0]), float(at[1])
                if kind < 0.5:
                    b.tube((x, y, KERB_M), (x, y, 2.75), 0.035, tx.METAL, (0.55, 0.55, 0.55), sides=5)
                    facing = np.array([-np.cos(at[2]), -np.sin(at[2]), 0.0])
                    b.disc(
                        np.array([x, y, 2.45]) + 0.05 * facing,
                        facing,
                        0.32,
                        tx.SIGN,
                        seed=int(rng.integers(99)),
                        sides=14,
                        uv_scale=1 / 0.32,
                    )
                elif kind < 0.8:
                    b.tube((x, y, KERB_M), (x, y, 1.0), 0.24, tx.METAL, (0.16, 0.28, 0.18), sides=8)
                else:
                    b.box((x, y, 0.75), (0.5, 0.45, 1.25), tx.METAL, (0.62, 0.10, 0.09))


def _signal(b: Builder, pose: Array, width: float) -> Mesh:
    """A mast with an arm over the approach's lanes; returns its lamps, in thirds red, yellow, green per head."""
    foot = pose[:2]
    arm_length = width + 1.2
    tip = curves.advance(pose, 0.0, arm_length)
    grey = (0.30, 0.32, 0.32)
    b.tube((*foot, KERB_M), (*foot, 6.1), 0.12, tx.METAL, grey, sides=7)
    b.tube((*foot, 5.9), (*tip[:2], 6.1), 0.07, tx.METAL, grey, sides=6)
    facing = np.array([-np.cos(pose[2]), -np.sin(pose[2]), 0.0])
    lamps = Builder()
    for left, z in ((0.0, 3.0), *((arm_length - 0.7 - 3.4 * k, 5.7) for k in range(max(1, int(width / 3.4))))):
        at = curves.advance(pose, 0.0, left)
        x, y = float(at[0] + 0.18 * facing[0]), float(at[1] + 0.18 * facing[1])
        one = np.array([-facing[1], facing[0], 0.0])
        front = np.array([x, y, z]) + 0.16 * facing
        plate = [
            front + sx * 0.28 * one + np.array([0, 0, sz * 0.68]) for sx, sz in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        b.face(np.array(plate), tx.DARK, (0.06, 0.06, 0.06))
        b.box((x, y, z), (0.26, 0.26, 1.1), tx.DARK, (0.08, 0.09, 0.08))
        for k in range(3):
            lamps.disc(
                front + 0.02 * facing + np.array([0, 0, 0.38 - 0.38 * k]), facing, 0.15, tx.GLOW, LAMP_OFF, sides=10
            )
    return lamps.mesh()
