"""Houses with their awnings and balconies, and trees of leaf cards."""

import numpy as np
import shapely

from factory.readers.town import curves
from factory.readers.town import textures as tx
from factory.readers.town.mesh import Builder, lifted, shades
from factory.readers.town.streets import PAVEMENT_M, Streets
from tasks.world.arrays import Array
from tasks.world.polygons import arc_lengths

KERB_M = 0.12  # height
PLAIN_Z = -0.06  # the lawn around, below the road
AWNINGS = shades("55 12 12, 14 32 24, 16 22 42, 78 70 52")
CROWNS = shades("27 38 13, 22 33 14, 33 40 14, 40 36 13")
TILES = shades("46 22 15, 28 27 29, 38 25 18")
CONCRETE, RAILING = (tx.ISLAND_STONE, (0.66, 0.64, 0.6)), (tx.DARK, (0.16, 0.16, 0.17))


def build_houses(
    b: Builder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator
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
                front = curves.beside(line, s + width / 2, road.half_width + PAVEMENT_M + 0.15 + setback)
                plan = ((-width / 2, 0), (width / 2, 0), (width / 2, depth), (-width / 2, depth))
                corners = np.array([curves.advance(front, x, -y)[:2] for x, y in plan])
                plot = shapely.Polygon(corners)
                if not any(plot.intersects(other) for other in (streets_area, *built)):
                    built.append(plot)
                    _house(b, corners, tall * float(rng.uniform(0.75, 1.35)) + 1.2, int(rng.integers(1 << 20)), rng)
                s += width + float(rng.choice([0.0, 0.0, 0.3, 7.0]))
    return taken + built


def _house(b: Builder, corners: Array, height: float, seed: int, rng: np.random.Generator) -> None:
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


def _balcony(b: Builder, corner: Array, along: Array, outward: Array, z: float) -> None:
    """A slab of 2.4 x 1.0 m with a railing."""
    p = [corner, corner + along * 2.4, corner + along * 2.4 + outward, corner + outward]
    b.face([(*q, z) for q in p], *CONCRETE)
    for a, e in ((p[1], p[2]), (p[2], p[3]), (p[3], p[0])):
        b.face([(*a, z - 0.15), (*e, z - 0.15), (*e, z), (*a, z)], *CONCRETE)
        b.tube((*a, z + 1.0), (*e, z + 1.0), 0.03, *RAILING, sides=4)
        for t in np.linspace(0.0, 1.0, 7):
            b.post(a + (e - a) * t, z, z + 1.0, 0.012, *RAILING, sides=3)


def plant_trees(b: Builder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator) -> None:
    """Street trees in the pavement, garden trees and hedges between and behind the houses."""
    blocked = shapely.unary_union([g.buffer(1.5) for g in taken])
    shapely.prepare(blocked)
    for road in streets.roads:
        for line in road.both_ways:
            length = arc_lengths(line)[-1]
            for s in np.arange(12.0, length - 4.0, 13.0 if road.name == "narrow street" else 9.5):
                if rng.random() < 0.62:
                    at = curves.beside(line, s + float(rng.uniform(-2, 2)), road.half_width + 0.75)
                    plant_tree(b, at[:2], KERB_M, rng, float(rng.uniform(0.65, 1.0)))
            for s in np.arange(3.0, length, 7.0):
                at = curves.beside(line, s, road.half_width + PAVEMENT_M + float(rng.uniform(2.5, 24.0)))
                if rng.random() < 0.8 and not blocked.contains(shapely.Point(at[:2])):
                    plant_tree(b, at[:2], PLAIN_Z, rng, float(rng.uniform(0.8, 1.5)))


def plant_tree(b: Builder, at: Array, z: float, rng: np.random.Generator, size: float) -> None:
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
