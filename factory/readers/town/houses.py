"""Houses with their awnings and balconies, and trees of leaf cards."""

import numpy as np
import shapely

from factory.readers.town import curves
from factory.readers.town import textures as tx
from factory.readers.town.mesh import Builder, lifted
from factory.readers.town.streets import PAVEMENT_M, Streets
from tasks.world.arrays import Array

KERB_M = 0.12  # height
PLAIN_Z = -0.06  # the lawn around, below the road


def build_houses(
    b: Builder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator
) -> list[shapely.Geometry]:
    """Rows of houses along both sides of every street; returns what is taken now."""
    streets_area = shapely.unary_union(taken)
    shapely.prepare(streets_area)
    built: list[shapely.Geometry] = []
    for road in streets.roads:
        tall = 3.1 * (5 if "avenue" in road.name else 3 if road.name == "narrow street" else 2)
        for line in (road.line, curves.reverse(road.line)):
            s_line = curves.arc_length(line)
            s = float(rng.uniform(0.0, 6.0))
            while s < s_line[-1] - 8.0:
                width, depth = float(rng.uniform(9.0, 19.0)), float(rng.uniform(9.0, 13.0))
                setback = float(rng.choice([0.0, 0.0, 0.4, 2.5]))
                front = curves.advance(
                    curves.at(line, s_line, s + width / 2), 0.0, -(road.half_width + PAVEMENT_M + 0.15 + setback)
                )
                corners = np.array(
                    [
                        curves.advance(front, x, -y)[:2]
                        for x, y in ((-width / 2, 0), (width / 2, 0), (width / 2, depth), (-width / 2, depth))
                    ]
                )
                plot = shapely.Polygon(corners)
                if (
                    not streets_area.intersects(plot)
                    and not any(plot.intersects(other) for other in built[-40:])
                    and not any(plot.intersects(other) for other in built)
                ):
                    built.append(plot)
                    _house(b, corners, tall * float(rng.uniform(0.75, 1.35)) + 1.2, int(rng.integers(1 << 20)), rng)
                s += width + float(rng.choice([0.0, 0.0, 0.3, 7.0]))
    return taken + built


def _house(b: Builder, corners: Array, height: float, seed: int, rng: np.random.Generator) -> None:
    """Four walls and a roof; corners (4, 2) start with the front's, from the street's left to right as driven."""
    low, top = lifted(corners, PLAIN_Z), lifted(corners, height)
    for i in range(4):
        j = (i + 1) % 4
        b.face([low[j], low[i], top[i], top[j]], tx.FACADE, seed=seed if i % 2 == 0 else seed + 1)
    if tx.chance(seed, 1, 78) < 0.45 and height < 14.0:
        ridge = (top[[0, 1]] + top[[3, 2]]) / 2 + [0, 0, 0.32 * float(np.hypot(*(corners[3] - corners[0])))]
        colour = ((0.46, 0.22, 0.15), (0.28, 0.27, 0.29), (0.38, 0.25, 0.18))[seed % 3]
        b.face([top[0], top[1], ridge[1], ridge[0]], tx.ROOF_TILES, colour, seed)
        b.face([top[2], top[3], ridge[0], ridge[1]], tx.ROOF_TILES, colour, seed)
        for a, z, peak in ((top[1], top[2], ridge[1]), (top[3], top[0], ridge[0])):
            b.triangles(
                np.array([[a, z, peak]]),
                np.array([[(0, 0), (6, 0), (3, 3)]], float),
                tx.ISLAND_STONE,
                (0.62, 0.56, 0.48),
            )
        chimney = ridge[0] * 0.7 + ridge[1] * 0.3
        b.box(
            (float(chimney[0]), float(chimney[1]), float(chimney[2])),
            (0.8, 0.6, 1.8),
            tx.ISLAND_STONE,
            (0.45, 0.28, 0.22),
        )
    else:
        b.face(list(top), tx.FLAT_ROOF, (0.45, 0.45, 0.45))
    along = (corners[1] - corners[0]) / np.hypot(*(corners[1] - corners[0]))
    outward = (corners[0] - corners[3]) / np.hypot(*(corners[0] - corners[3]))
    ground = 3.3 + tx.chance(seed, 2, 77) * 0.9
    if tx.chance(seed, 6, 77) < 0.55:
        width = float(np.hypot(*(corners[1] - corners[0])))
        for k in range(int(width / 4.6)):
            if rng.random() < 0.45:
                a, z = corners[1] - along * (4.6 * k + 0.2), corners[1] - along * (4.6 * k + 4.3)
                colour = np.array([(0.55, 0.12, 0.12), (0.14, 0.32, 0.24), (0.16, 0.22, 0.42), (0.78, 0.70, 0.52)])[
                    int(rng.integers(4))
                ]
                edge = [
                    [*(p + outward * out), h]
                    for p, out, h in (
                        (a, 1.1, ground - 1.35),
                        (z, 1.1, ground - 1.35),
                        (z, 0.02, ground - 0.85),
                        (a, 0.02, ground - 0.85),
                    )
                ]
                b.face(np.array(edge), tx.CLOTH, colour, seed)
                lip = [edge[0], edge[1], [*edge[1][:2], edge[1][2] - 0.25], [*edge[0][:2], edge[0][2] - 0.25]]
                b.face(np.array(lip), tx.CLOTH, colour * 0.85, seed)
    elif height > 8.0:
        floor = 2.9 + tx.chance(seed, 3, 77) * 0.5
        width = float(np.hypot(*(corners[1] - corners[0])))
        for z in np.arange(ground + 0.1, height - 3.0, floor):
            for x in np.arange(2.0, width - 3.0, 5.4):
                if rng.random() < 0.6:
                    _balcony(b, corners[1] - along * x, -along, outward, float(z))


def _balcony(b: Builder, corner: Array, along: Array, outward: Array, z: float) -> None:
    """A slab of 2.4 x 1.0 m with a railing."""
    p = [corner, corner + along * 2.4, corner + along * 2.4 + outward, corner + outward]
    b.face([(*q, z) for q in p], tx.ISLAND_STONE, (0.66, 0.64, 0.6))
    for i in (1, 2, 3):
        a, e = p[i], p[(i + 1) % 4]
        b.face([(*a, z - 0.15), (*e, z - 0.15), (*e, z), (*a, z)], tx.ISLAND_STONE, (0.66, 0.64, 0.6))
        b.tube((*a, z + 1.0), (*e, z + 1.0), 0.03, tx.DARK, (0.16, 0.16, 0.17), sides=4)
        for t in np.linspace(0.0, 1.0, 7):
            q = a + (e - a) * t
            b.tube((*q, z), (*q, z + 1.0), 0.012, tx.DARK, (0.16, 0.16, 0.17), sides=3)


def plant_trees(b: Builder, streets: Streets, taken: list[shapely.Geometry], rng: np.random.Generator) -> None:
    """Street trees in the pavement, garden trees and hedges between and behind the houses."""
    blocked = shapely.unary_union([g.buffer(1.5) for g in taken])
    shapely.prepare(blocked)
    for road in streets.roads:
        step = 13.0 if road.name == "narrow street" else 9.5
        for line in (road.line, curves.reverse(road.line)):
            s_line = curves.arc_length(line)
            for s in np.arange(12.0, s_line[-1] - 4.0, step):
                if rng.random() < 0.62:
                    at = curves.advance(
                        curves.at(line, s_line, s + float(rng.uniform(-2, 2))), 0.0, -(road.half_width + 0.75)
                    )
                    plant_tree(b, at[:2], KERB_M, rng, float(rng.uniform(0.65, 1.0)))
            for s in np.arange(3.0, s_line[-1], 7.0):
                back = float(rng.uniform(2.5, 24.0))
                at = curves.advance(curves.at(line, s_line, s), 0.0, -(road.half_width + PAVEMENT_M + back))
                if rng.random() < 0.8 and not blocked.contains(shapely.Point(at[:2])):
                    plant_tree(b, at[:2], PLAIN_Z, rng, float(rng.uniform(0.8, 1.5)))


def plant_tree(b: Builder, at: Array, z: float, rng: np.random.Generator, size: float) -> None:
    """A trunk and a crown of twigs: cards with leaves cut out, lit as parts of a round crown."""
    x, y = float(at[0]), float(at[1])
    trunk = 2.5 * size**0.5 + 0.4
    b.tube(
        (x, y, z),
        (x, y, z + trunk + 1.0),
        0.15 * size + 0.05,
        tx.BARK,
        (0.33, 0.27, 0.21),
        int(rng.integers(1 << 16)),
        7,
        0.7,
    )
    radius, tall = 1.75 * size, 2.1 * size
    n = int(64 * size)
    outward = rng.normal(size=(n, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    centre = outward * np.array([radius, radius, tall]) * rng.uniform(0.45, 1.0, (n, 1)) ** 0.6
    one = np.cross(outward, rng.normal(size=(n, 3)))
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two = np.cross(outward * 0.7 + rng.normal(size=(n, 3)) * 0.5, one)
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    half = 0.85
    centre = centre + np.array([x, y, z + trunk + tall * 0.75])
    corners = np.stack(
        [
            centre - half * one - half * two,
            centre + half * one - half * two,
            centre + half * one + half * two,
            centre - half * one + half * two,
        ],
        1,
    )
    uv = np.broadcast_to(np.array([(-half, -half), (half, -half), (half, half), (-half, half)]), (n, 4, 2))
    base = np.array([(0.27, 0.38, 0.13), (0.22, 0.33, 0.14), (0.33, 0.40, 0.14), (0.40, 0.36, 0.13)])[
        int(rng.integers(4))
    ]
    depth = 0.62 + 0.38 * np.linalg.norm((centre - [x, y, z + trunk + tall * 0.75]) / [radius, radius, tall], axis=1)
    colour = base * depth[:, None] * rng.uniform(0.8, 1.15, (n, 1))
    b.quads(corners, uv, tx.LEAVES, colour, rng.integers(1 << 16, size=n), normals=outward)
