"""Builds meshes: the few solids that the town is made of."""

from typing import Any

import numpy as np

from factory.readers.town.raster import Mesh
from tasks.world.arrays import Array

WHITE = (1.0, 1.0, 1.0)
UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def merged(parts: list[Mesh]) -> Mesh:
    """All triangles of all parts, in order."""
    return Mesh(*map(np.concatenate, zip(*parts)))


def lifted(xy: Array, z: float) -> Array:
    """Points (..., >= 2) at height z, (..., 3)."""
    return np.concatenate([xy[..., :2], np.full((*xy.shape[:-1], 1), z)], axis=-1)


def cross(a: Array, b: Array) -> Array:
    """Vector product of (..., 3) and (..., 3): bit for bit that of np.cross, which takes ten times as long for one."""
    (ax, ay, az), (bx, by, bz) = (a[..., 0], a[..., 1], a[..., 2]), (b[..., 0], b[..., 1], b[..., 2])
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = ay * bz - az * by
    product[..., 1] = az * bx - ax * bz
    product[..., 2] = ax * by - ay * bx
    return product


def shades(percentages: str) -> Array:
    """(N, 3) colours, 0..1, from "red green blue, red green blue, ..." in percent."""
    return np.array([colour.split() for colour in percentages.split(",")], np.float64) / 100


class Builder:
    """Collects faces. The `surface` of a solid: material, colour and seed, as `triangles` takes them."""

    def __init__(self) -> None:
        self._parts: list[Mesh] = []

    def mesh(self) -> Mesh:
        return merged(self._parts)

    def triangles(
        self,
        points: Any,  # (T, 3, 3)
        uv: Any,  # (T, 3, 2)
        material: int,
        colour: Any = WHITE,  # (3,), or (T, 3)
        seed: Any = 0,  # or (T,)
        *,
        extent: tuple[float, float] = (0.0, 0.0),
        normals: Array | None = None,  # (T, 3)
    ) -> None:
        points, n = np.asarray(points, np.float64), len(points)
        if normals is None:
            across = cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        colours, extents = np.full((n, 3), colour, np.float64), np.full((n, 2), extent, np.float64)
        materials, seeds = np.full(n, material, np.int64), np.full(n, seed, np.int64)
        self._parts.append(Mesh(points, np.asarray(uv, np.float64), normals, materials, colours, extents, seeds))

    def quads(
        self,
        corners: Array,  # (Q, 4, 3)
        uv: Array,  # (Q, 4, 2)
        material: int,
        colour: Any = WHITE,
        seed: Any = 0,
        *,
        extent: tuple[float, float] = (0.0, 0.0),
        normals: Array | None = None,
    ) -> None:
        """Faces of four corners, each split along its 0-2 diagonal."""
        order, n = [0, 1, 2, 0, 2, 3], len(corners)
        points, coordinates = corners[:, order].reshape(-1, 3, 3), uv[:, order].reshape(-1, 3, 2)
        colours, seeds = np.full((n, 3), colour).repeat(2, axis=0), np.full(n, seed).repeat(2)
        normals = None if normals is None else normals.repeat(2, axis=0)
        self.triangles(points, coordinates, material, colours, seeds, extent=extent, normals=normals)

    def strip(self, left: Array, right: Array, u: Array, v_left: float, v_right: float, *surface: Any) -> None:
        """A ribbon between two polylines (N, 3); u along, v across."""
        a, z = (np.column_stack([line, u, np.full(len(u), v)]) for line, v in ((left, v_left), (right, v_right)))
        cells = np.stack([a[:-1], z[:-1], z[1:], a[1:]], axis=1)
        self.quads(cells[..., :3], cells[..., 3:], *surface)

    def face(self, corners: Any, *surface: Any, uv: Any = None, **more: Any) -> None:
        """One quad (4, 3); without `uv` its coordinates are metres along the first edge and across it."""
        c = np.asarray(corners, np.float64)
        width, height = (float(np.linalg.norm(c[k] - c[0])) for k in (1, 3))
        coordinates = np.asarray(uv or [(0, 0), (width, 0), (width, height), (0, height)], np.float64)
        self.quads(c[None], coordinates[None], *surface, extent=(width, height), **more)

    def box(self, centre: Any, size: Any, *surface: Any, taper: float = 1.0) -> None:
        """An upright box (no floor); the top is `taper` times the bottom."""
        half, around = np.array(size) / 2, np.array([(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)])
        low, top = (np.array(centre) + half * around * scale for scale in ((1, 1, 1), (taper, taper, -1)))
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
            self.face([low[i], low[j], top[j], top[i]], *surface)
        self.face(top, *surface)

    def tube(self, foot: Any, head: Any, radius: float, *surface: Any, sides: int = 6, taper: float = 1.0) -> None:
        """A prism between two points with smooth normals."""
        a, b = np.asarray(foot, np.float64), np.asarray(head, np.float64)
        length = float(np.linalg.norm(b - a))
        axis = (b - a) / length
        one = cross(axis, UP if abs(axis[2]) < 0.9 else AHEAD)
        one /= np.linalg.norm(one)
        angle = np.arange(sides + 1) * 2 * np.pi / sides
        ring, u = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * cross(axis, one), angle * radius
        low = np.column_stack([a + radius * ring, u, np.zeros(sides + 1)])
        top = np.column_stack([b + radius * taper * ring, u, np.full(sides + 1, length)])
        cells = np.stack([low[:-1], low[1:], top[1:], top[:-1]], axis=1)
        self.quads(cells[..., :3], cells[..., 3:], *surface, normals=(ring[:-1] + ring[1:]) / 2)

    def post(self, at: Any, low: float, high: float, radius: float, *surface: Any, **form: Any) -> None:
        """An upright tube at `at` (x, y, ...) between two heights."""
        self.tube((*at[:2], low), (*at[:2], high), radius, *surface, **form)

    def disc(
        self, centre: Any, axis: Any, radius: float, *surface: Any, sides: int = 10, uv_scale: float = 1.0
    ) -> None:
        """A disc facing along `axis`; u to its right, v up, offsets from the centre times `uv_scale`."""
        axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        one = cross(UP, axis)
        one = one / np.linalg.norm(one) if np.linalg.norm(one) > 1e-6 else np.array([1.0, 0.0, 0.0])
        angle = np.arange(sides + 1) * 2 * np.pi / sides
        flat = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        rim = centre + flat[:, :1] * one + flat[:, 1:] * cross(axis, one)
        points = np.stack([np.broadcast_to(centre, (sides, 3)), rim[:-1], rim[1:]], axis=1)
        uv = np.stack([np.zeros((sides, 2)), flat[:-1], flat[1:]], axis=1) * uv_scale
        self.triangles(points, uv, *surface, normals=np.broadcast_to(axis, (sides, 3)).copy())
