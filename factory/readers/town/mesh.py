"""Triangles with texture coordinates and materials, and the few solids that the town is made of."""

from dataclasses import dataclass, fields

import numpy as np

from tasks.world.arrays import Array, Ints


@dataclass(frozen=True)
class Mesh:
    """T triangles; z is height above the road, x and y world or object coordinates."""

    vertices: Array  # (T, 3, 3) m
    uv: Array  # (T, 3, 2) surface coordinates, mostly metres
    normals: Array  # (T, 3) unit
    material: Ints  # (T,) textures.py
    colour: Array  # (T, 3) 0..1
    extent: Array  # (T, 2) size of the whole face [m]
    seed: Ints  # (T,)

    def __len__(self) -> int:
        return len(self.material)

    def placed(self, pose: Array, z: float = 0.0) -> "Mesh":
        """The object mesh standing at pose (x, y, heading)."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        vertices = self.vertices @ turn + np.array([pose[0], pose[1], z])
        return Mesh(vertices, self.uv, self.normals @ turn, self.material, self.colour, self.extent, self.seed)


def merged(parts: list[Mesh]) -> Mesh:
    """All triangles of all parts, in order."""
    return Mesh(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Mesh)))


def lifted(xy: Array, z: float) -> Array:
    """Points (..., >= 2) at height z, (..., 3)."""
    return np.concatenate([xy[..., :2], np.full((*xy.shape[:-1], 1), z)], axis=-1)


Colour = tuple[float, float, float] | Array


class Builder:
    """Collects faces."""

    def __init__(self) -> None:
        self._parts: list[Mesh] = []

    def mesh(self) -> Mesh:
        return merged(self._parts)

    def add(self, mesh: Mesh) -> None:
        self._parts.append(mesh)

    def triangles(
        self,
        points: Array,  # (T, 3, 3)
        uv: Array,  # (T, 3, 2)
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int | Ints = 0,
        extent: tuple[float, float] = (0.0, 0.0),
        normals: Array | None = None,
    ) -> None:
        n = len(points)
        if normals is None:
            cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
        self._parts.append(
            Mesh(
                np.asarray(points, np.float64),
                np.asarray(uv, np.float64),
                normals,
                np.full(n, material, np.int64),
                np.broadcast_to(np.asarray(colour, np.float64), (n, 3)).copy(),
                np.broadcast_to(np.asarray(extent, np.float64), (n, 2)).copy(),
                np.broadcast_to(np.asarray(seed, np.int64), (n,)).copy(),
            )
        )

    def quads(
        self,
        corners: Array,
        uv: Array,
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int | Ints = 0,
        extent: tuple[float, float] = (0.0, 0.0),
        normals: Array | None = None,
    ) -> None:
        """Faces of four corners (Q, 4, 3) with uv (Q, 4, 2), each split along its 0-2 diagonal."""
        order = [0, 1, 2, 0, 2, 3]
        points = corners[:, order].reshape(-1, 3, 3)
        colour, seed = np.asarray(colour), np.asarray(seed)
        self.triangles(
            points,
            uv[:, order].reshape(-1, 3, 2),
            material,
            np.repeat(colour, 2, axis=0) if colour.ndim == 2 else colour,
            np.repeat(seed, 2) if seed.ndim == 1 else seed,
            extent,
            None if normals is None else np.repeat(normals, 2, axis=0),
        )

    def strip(
        self,
        left: Array,
        right: Array,
        u: Array,
        v_left: float,
        v_right: float,
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int = 0,
    ) -> None:
        """A ribbon between two polylines (N, 3); u along, v across."""
        corners = np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=1)
        n = len(corners)
        uu = np.stack([u[:-1], u[:-1], u[1:], u[1:]], axis=1)
        vv = np.broadcast_to([v_left, v_right, v_right, v_left], (n, 4))
        self.quads(corners, np.stack([uu, vv], axis=-1), material, colour, seed)

    def face(
        self,
        corners: list[tuple[float, float, float]] | Array,
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int = 0,
        uv: list[tuple[float, float]] | None = None,
        extent: tuple[float, float] | None = None,
    ) -> None:
        """One quad; without `uv` its coordinates are metres along the first edge and across it."""
        c = np.asarray(corners, np.float64)
        width, height = float(np.linalg.norm(c[1] - c[0])), float(np.linalg.norm(c[3] - c[0]))
        coords = np.asarray(uv if uv is not None else [(0, 0), (width, 0), (width, height), (0, height)], np.float64)
        self.quads(c[None], coords[None], material, colour, seed, extent if extent is not None else (width, height))

    def box(
        self,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int = 0,
        taper: float = 1.0,
    ) -> None:
        """An upright box (no floor); the top is `taper` times the bottom."""
        x, y, z = centre
        a, b, h = size[0] / 2, size[1] / 2, size[2] / 2
        low = [(x + sx * a, y + sy * b, z - h) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        top = [(x + sx * a * taper, y + sy * b * taper, z + h) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        for i in range(4):
            j = (i + 1) % 4
            self.face([low[i], low[j], top[j], top[i]], material, colour, seed, extent=(0.0, 0.0))
        self.face(top, material, colour, seed, extent=(0.0, 0.0))

    def tube(
        self,
        foot: tuple[float, float, float],
        head: tuple[float, float, float],
        radius: float,
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int = 0,
        sides: int = 6,
        taper: float = 1.0,
    ) -> None:
        """A prism between two points with smooth normals."""
        a, b = np.asarray(foot, np.float64), np.asarray(head, np.float64)
        axis = (b - a) / np.linalg.norm(b - a)
        one = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        one /= np.linalg.norm(one)
        two = np.cross(axis, one)
        angle = np.arange(sides + 1) * 2 * np.pi / sides
        ring = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * two
        low, top = a + radius * ring, b + radius * taper * ring
        corners = np.stack([low[:-1], low[1:], top[1:], top[:-1]], axis=1)
        u, length = angle * radius, float(np.linalg.norm(b - a))
        uv = np.stack(
            [np.stack([u[:-1], u[1:], u[1:], u[:-1]], axis=1), np.broadcast_to([0, 0, length, length], (sides, 4))],
            axis=-1,
        )
        self.quads(corners, uv, material, colour, seed, normals=(ring[:-1] + ring[1:]) / 2)

    def disc(
        self,
        centre: Array,
        axis: Array,
        radius: float,
        material: int,
        colour: Colour = (1.0, 1.0, 1.0),
        seed: int = 0,
        sides: int = 10,
        uv_scale: float = 1.0,
    ) -> None:
        """A disc facing along `axis`; u to its right, v up, offsets from the centre times `uv_scale`."""
        axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        one = np.cross([0.0, 0.0, 1.0], axis)
        one = one / np.linalg.norm(one) if np.linalg.norm(one) > 1e-6 else np.array([1.0, 0.0, 0.0])
        two = np.cross(axis, one)
        angle = np.arange(sides + 1) * 2 * np.pi / sides
        flat = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        rim = centre + flat[:, :1] * one + flat[:, 1:] * two
        points = np.stack([np.broadcast_to(centre, (sides, 3)), rim[:-1], rim[1:]], axis=1)
        uv = np.stack([np.zeros((sides, 2)), flat[:-1], flat[1:]], axis=1) * uv_scale
        self.triangles(points, uv, material, colour, seed, normals=np.broadcast_to(axis, (sides, 3)).copy())
