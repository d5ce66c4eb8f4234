"""A z-buffered triangle rasteriser in homogeneous coordinates (Olano and Greer 1997): needs no clipping.

Vertices become rows (x, y, w) of a 3x3 matrix whose inverse gives the edge functions e_i, affine in the image, with
e_i = barycentric_i / w: inside where all are >= 0, 1/w = sum e_i, attribute/w = sum attribute_i e_i.
Visible is the largest `key`, interpolated the same way: 1/w for a camera, height above a plane for the sun's view.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from factory.datasets.town import textures as tx
from factory.datasets.town.textures import (
    LEAVES,
    RGB,
    SPOKES,
    TREELINE,
    chance,
    grain,
    inside,
    mixed,
    noise,
    opaque_at,
    toned,
    visible,
)
from tasks.kernels.compiled import numpy_division_kernel
from tasks.world.arrays import F32, Array, Ints, ShortInts

NEAR_M = 0.15


class Mesh(NamedTuple):
    """T triangles; z is height above the road, x and y world or object coordinates. Kernels take it whole."""

    vertices: Array  # (T, 3, 3) m
    uv: Array  # (T, 3, 2) surface coordinates, mostly metres
    normals: Array  # (T, 3) unit
    material: Ints  # (T,) textures.py
    colour: Array  # (T, 3) 0..1
    extent: Array  # (T, 2) size of the whole face [m]
    seed: Ints  # (T,)

    def placed(self, pose: Array) -> "Mesh":
        """The object mesh standing on the road at pose (x, y, heading)."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return self._replace(vertices=self.vertices @ turn + [pose[0], pose[1], 0.0], normals=self.normals @ turn)


@numpy_division_kernel
def rasterise(mesh: Mesh, view: Array, keys: F32, ids: ShortInts) -> Array:
    """Draws triangles into `keys` and `ids` (H, W), the visible one's number.

    Sample (row, column) lies at (column + 0.5, row + 0.5). The view (4, 4) takes a world point (1) to x, y, w, key; it
    is seen at (x / w, y / w). Returns each triangle's 1/w, u/w, v/w as a x + b y + c, (T, 9); 0 out of the view.
    """
    vertices, uv, material, seed = mesh.vertices, mesh.uv, mesh.material, mesh.seed
    planes = np.zeros((vertices.shape[0], 9))
    height, width = keys.shape
    h = np.empty((3, 4))
    e = np.empty((3, 3))
    for t in range(vertices.shape[0]):
        n_behind = 0
        for i in range(3):
            x, y, z = vertices[t, i, 0], vertices[t, i, 1], vertices[t, i, 2]
            for k in range(4):
                h[i, k] = view[k, 0] * x + view[k, 1] * y + view[k, 2] * z + view[k, 3]
            if h[i, 2] < NEAR_M:
                n_behind += 1
        if n_behind == 3:
            continue
        x_low, x_high, y_low, y_high = 1e9, -1e9, 1e9, -1e9
        for i in range(3):
            if h[i, 2] >= NEAR_M:
                px, py = h[i, 0] / h[i, 2], h[i, 1] / h[i, 2]
                x_low, x_high, y_low, y_high = min(x_low, px), max(x_high, px), min(y_low, py), max(y_high, py)
            j = (i + 1) % 3
            if (h[i, 2] < NEAR_M) != (h[j, 2] < NEAR_M):
                along = (NEAR_M - h[i, 2]) / (h[j, 2] - h[i, 2])
                px = (h[i, 0] + along * (h[j, 0] - h[i, 0])) / NEAR_M
                py = (h[i, 1] + along * (h[j, 1] - h[i, 1])) / NEAR_M
                x_low, x_high, y_low, y_high = min(x_low, px), max(x_high, px), min(y_low, py), max(y_high, py)
        if x_high < 0 or y_high < 0 or x_low > width or y_low > height:
            continue
        row_low, row_high = max(0, math.ceil(y_low - 0.5)), min(height - 1, math.floor(y_high - 0.5))
        left, right = max(0, math.ceil(x_low - 0.5)), min(width - 1, math.floor(x_high - 0.5))
        if row_low > row_high or left > right:
            continue
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            e[i, 0] = h[a, 1] * h[b, 2] - h[a, 2] * h[b, 1]
            e[i, 1] = h[a, 2] * h[b, 0] - h[a, 0] * h[b, 2]
            e[i, 2] = h[a, 0] * h[b, 1] - h[a, 1] * h[b, 0]
        det = h[0, 0] * e[0, 0] + h[0, 1] * e[0, 1] + h[0, 2] * e[0, 2]
        if abs(det) < 1e-12:
            continue
        e /= det
        kx, ky, kc = 0.0, 0.0, 0.0
        for i in range(3):
            kx += e[i, 0] * h[i, 3]
            ky += e[i, 1] * h[i, 3]
            kc += e[i, 2] * h[i, 3]
        kind = material[t]
        cut_out = kind in (LEAVES, TREELINE, SPOKES)
        p = planes[t]
        for i in range(3):
            for k in range(3):
                p[k] += e[i, k]
                p[3 + k] += e[i, k] * uv[t, i, 0]
                p[6 + k] += e[i, k] * uv[t, i, 1]
        for row in range(row_low, row_high + 1):
            y = row + 0.5
            start, stop = float(left), float(right)
            for i in range(3):
                value = e[i, 1] * y + e[i, 2]
                if e[i, 0] > 0:
                    start = max(start, -value / e[i, 0] - 0.5)
                elif e[i, 0] < 0:
                    stop = min(stop, -value / e[i, 0] - 0.5)
                elif value < 0:
                    stop = -1.0
            if stop < start:
                continue
            key_row = ky * y + kc
            for column in range(math.ceil(start), math.floor(stop) + 1):
                x = column + 0.5
                key = np.float32(kx * x + key_row)
                if key > keys[row, column]:
                    if cut_out:
                        w = 1.0 / (p[0] * x + p[1] * y + p[2])
                        u, v = (p[3] * x + p[4] * y + p[5]) * w, (p[6] * x + p[7] * y + p[8]) * w
                        if not opaque_at(kind, u, v, seed[t]):
                            continue
                    keys[row, column] = key
                    ids[row, column] = t
    return planes


# Builds meshes: the few solids that the town is made of.

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


def parse_colours(percentages: str) -> Array:
    """(N, 3) colours, 0..1, from "red green blue, red green blue, ..." in percent."""
    return np.array([colour.split() for colour in percentages.split(",")], np.float64) / 100


class MeshBuilder:
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


# Light and surface colour per pixel: what the rasteriser found visible, shaded once per visible triangle.


class Sun(NamedTuple):
    """Direction and the orthographic projection along it, in which `key` is height towards the sun."""

    direction: Array  # (3,) unit, towards the sun
    projection: Array  # (4, 4)


class LitScene(NamedTuple):
    """One instant of a drive, ready to be seen: all triangles and the sun's depth map. Kernels take it whole."""

    mesh: Mesh
    shadow: F32
    sun: Sun
    marks: Array
    sky_seed: int


@numpy_division_kernel
def dashed(x: float, period: float, dash: float, footprint: float) -> float:
    """Share of a pixel at x that lies on dashes, one at the start of each period; a pattern too fine is its mean."""
    seen = visible(dash, footprint)
    return seen * inside(x % period, 0.0, dash, max(footprint, 0.01)) + (1 - seen) * (dash / period)


@numpy_division_kernel
def road_paint(u: float, d: float, marks: Array, fu: float, fd: float) -> tuple[float, float]:
    """(coverage, yellowness) of the paint at arc length u and offset d of a road.

    Marks (M, 9): d from, d to, u from, u to, u period, u dash, d period, d dash (period 0: solid), yellow.
    """
    best, yellow = 0.0, 0.0
    for m in range(marks.shape[0]):
        if d < marks[m, 0] - fd or d > marks[m, 1] + fd or u < marks[m, 2] - fu or u > marks[m, 3] + fu:
            continue
        cover = inside(d, marks[m, 0], marks[m, 1], max(fd, 0.01)) * inside(u, marks[m, 2], marks[m, 3], max(fu, 0.01))
        if marks[m, 1] - marks[m, 0] < fd:
            cover *= min(1.0, 2 * (marks[m, 1] - marks[m, 0]) / fd)
        if marks[m, 4] > 0:
            cover *= dashed(u - marks[m, 2], marks[m, 4], marks[m, 5], fu)
        if marks[m, 6] > 0:
            cover *= dashed(d - marks[m, 0], marks[m, 6], marks[m, 7], fd)
        if cover > best:
            best, yellow = cover, marks[m, 8]
    return best, yellow


@numpy_division_kernel
def road_surface(x: float, y: float, u: float, d: float, marks: Array, fu: float, fd: float) -> RGB:
    """Asphalt with worn lane paint; the gutter beside the kerb is darker."""
    fp = max(fu, fd)
    colour = toned(tx.asphalt(x, y, fp), 1.0 - 0.06 * math.cos(d * 3.59) * visible(1.0, fd))
    cover, yellow = road_paint(u, d, marks, fu, fd)
    if cover > 0.0:
        fresh = 0.92 - 0.25 * max(0.0, noise(x / 0.13, y / 0.13, 31) - 0.55) * visible(0.13, fp)
        wear = fresh - 0.15 * noise(x / 2.0, y / 2.0, 32)
        colour = mixed(colour, (0.86 + 0.02 * yellow, 0.86 - 0.16 * yellow, 0.83 - 0.60 * yellow), cover * wear)
    return colour


@numpy_division_kernel
def sky(dx: float, dy: float, dz: float, sun: Array, seed: int) -> RGB:
    """The sky in a direction: gradient, clouds on a high plane, a glow around the sun."""
    up = max(0.0, dz)
    blend = math.sqrt(up)
    blue = 0.84 - 0.52 * blend, 0.89 - 0.37 * blend, 0.95 - 0.13 * blend
    plane = 1.4 / (up + 0.12)
    u, v = dx * plane, dy * plane
    cloud, size = 0.0, 0.5
    scale = 0.9
    for k in range(4):
        cloud += size * noise(u * scale + 17.0, v * scale, seed + k)
        size *= 0.52
        scale *= 2.13
    cover = min(1.0, max(0.0, (cloud - 0.46) * 4.0))
    light = 0.97 - 0.22 * max(0.0, cloud - 0.62) * 3
    r, g, b = mixed(blue, (light, light, light * 1.01), cover)
    glow = max(0.0, dx * sun[0] + dy * sun[1] + dz * sun[2]) ** 24 * 0.25
    return min(1.0, r + glow), min(1.0, g + glow), min(1.0, b + glow * 0.8)


@numpy_division_kernel
def surface_colour(scene: LitScene, t: int, u: float, v: float, x: float, y: float, fu: float, fv: float) -> RGB:
    """Colour before light of triangle t at (u, v), world (x, y), in a pixel with the footprint (fu, fv)."""
    mesh = scene.mesh
    kind, seed, width, height = mesh.material[t], mesh.seed[t], mesh.extent[t, 0], mesh.extent[t, 1]
    colour = mesh.colour[t, 0], mesh.colour[t, 1], mesh.colour[t, 2]
    fp, tone = max(fu, fv), 1.0
    if kind == tx.ROAD:
        return road_surface(x, y, u, v, scene.marks[seed], fu, fv)
    if kind == tx.ASPHALT:
        return tx.asphalt(x, y, fp)
    if kind == tx.PAVING:
        return tx.paving(u, v, 51, fp)
    if kind == tx.GRASS:
        return tx.grass(x, y, fp)
    if kind == tx.FACADE:
        return tx.facade(u, v, width, height, seed, fu, fv)
    if kind == tx.KERB:
        joint = 0.7 if u % 1.0 < 0.02 and fu < 0.2 else 1.0
        tone = (0.62 + 0.14 * grain(u, v, 61, fp) + 0.08 * (noise(u / 1.0, v, 62) - 0.5)) * joint
        return tone, tone * 0.98, tone * 0.94
    if kind == tx.CABIN:  # u: 0 rear .. 1 front, v: 0 sill .. 1 roof edge
        pillar = max(inside(u, 0.47, 0.53, fu), 1 - inside(u, 0.05, 0.96, fu), 1 - inside(v, 0.06, 0.88, fv))
        glass = 0.10 + 0.16 * v + 0.12 * noise(u * 5.0, v * 2.0 + seed % 97, 71)
        return mixed((glass * 0.9, glass, glass * 1.12), colour, pillar)
    if kind == tx.WHEEL:  # u, v: offsets from the hub [m]
        radius = math.sqrt(u * u + v * v)
        spoke = math.cos(math.atan2(v, u) * 5.0)
        if radius < 0.20:
            tone = 0.62 if spoke > -0.2 or radius < 0.06 or radius > 0.18 else 0.16
        else:
            tone = 0.09 if radius < 0.36 else 0.05
        return tone, tone, tone * 1.02
    if kind == tx.CARGO:
        rib = 1.0 - 0.10 * visible(0.3, fu) * (1.0 if u % 0.6 < 0.05 else 0.0)
        lettered = 1.0 < u < width - 1.2 and 1.5 < v < 2.1 and chance(int(u / 0.15), int(v / 0.2), seed) > 0.5
        logo = 0.8 * visible(0.2, fp) if lettered else 0.0
        return toned(mixed((0.86, 0.86, 0.85), colour, max(inside(v, 0.9, 1.25, fv), logo)), rib)
    if kind == tx.BUS_SIDE:
        window = inside(v, 1.15, 2.35, fv) * inside(u % 1.45, 0.06, 1.39, fu)
        glass = 0.12 + 0.2 * noise(u / 0.5, v / 0.6, seed)
        return mixed(colour, (glass, glass * 1.05, glass * 1.15), window)
    if kind == tx.SIGN:  # round face: u, v offsets over radius
        if math.sqrt(u * u + v * v) > 0.74:
            return 0.78, 0.08, 0.08
        digit = abs(v) < 0.38 and 0.08 < abs(u) < 0.5 and chance(int((u + 1) * 6), int((v + 1) * 6), seed) > 0.42
        return toned((1.0, 1.0, 1.0), 0.08 if digit else 0.93)
    if kind == tx.LEAVES:
        tone = 0.85 + 0.3 * chance(math.floor(u / 0.17), math.floor(v / 0.17), seed)
    elif kind == tx.BARK:
        tone = 0.7 + 0.6 * noise(u / 0.05, v / 0.35, seed) * visible(0.05, fp) + 0.3 * noise(u / 0.3, v / 1.0, seed + 1)
    elif kind == tx.ROOF_TILES:
        row = math.floor(v / 0.32)
        column = math.floor(u / 0.25 + 0.5 * (row % 2))
        edge = 0.4 * max(0.0, 1 - (v / 0.32 - row) * 4)
        tone = 1.0 + visible(0.3, fp) * (0.35 * (chance(int(column), int(row), seed) - 0.5) - edge)
    elif kind == tx.PAINTED:  # u along, v up: door gaps and handles
        gap, sharp = 0.0, max(fu, 0.008)
        for at in (0.30, 0.49, 0.68):
            gap = max(gap, inside(u, at * width - 0.012, at * width + 0.012, sharp) * min(1.0, 0.024 / sharp))
        handles = inside(u, 0.36 * width, 0.40 * width, fu), inside(u, 0.55 * width, 0.59 * width, fu)
        handle = inside(v, 0.72, 0.76, fv) * max(handles[0], handles[1])
        gap = max(gap, 0.7 * handle, 0.55 * inside(v, -1.0, 0.32, fv))
        tone = (1.0 - 0.75 * gap) * (0.94 + 0.12 * v)
    elif kind == tx.TREELINE:
        tone = 0.75 + 0.5 * noise(u / 0.9, v / 0.7, 45) + 0.25 * noise(u / 5.0, v / 3.0, 46)
    elif kind == tx.CLOTH:
        tone = 0.88 + 0.24 * noise(u / 0.06, v / 0.09, seed)
    elif kind == tx.ISLAND_STONE or kind == tx.FLAT_ROOF:
        tone = 0.9 + 0.2 * noise(u / 0.6, v / 0.6, 81) + 0.2 * grain(u, v, 82, fp)
    return toned(colour, tone)


@numpy_division_kernel
def lit_by_sun(x: float, y: float, z: float, scene: LitScene) -> float:
    """0 in shade .. 1 in the sun: four taps of the sun's depth map, blended; outside it: sun."""
    view, shadow = scene.sun.projection, scene.shadow
    sx = view[0, 0] * x + view[0, 1] * y + view[0, 2] * z + view[0, 3] - 0.5
    sy = view[1, 0] * x + view[1, 1] * y + view[1, 2] * z + view[1, 3] - 0.5
    key = view[3, 0] * x + view[3, 1] * y + view[3, 2] * z + view[3, 3] + 0.25
    column, row = math.floor(sx), math.floor(sy)
    if row < 0 or column < 0 or row + 1 >= shadow.shape[0] or column + 1 >= shadow.shape[1]:
        return 1.0
    a, b = sx - column, sy - row
    top = (1 - a) * (key > shadow[row, column]) + a * (key > shadow[row, column + 1])
    low = (1 - a) * (key > shadow[row + 1, column]) + a * (key > shadow[row + 1, column + 1])
    return (1 - b) * top + b * low


@numpy_division_kernel
def lit(scene: LitScene, t: int, colour: RGB, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> RGB:
    """The colour of triangle t at world (x, y, z) in the light there, seen along (dx, dy, dz)."""
    kind, sun = scene.mesh.material[t], scene.sun.direction
    if kind == tx.GLOW:
        return colour
    nx, ny, nz = scene.mesh.normals[t, 0], scene.mesh.normals[t, 1], scene.mesh.normals[t, 2]
    if kind != tx.LEAVES and nx * dx + ny * dy + nz * dz > 0:
        nx, ny, nz = -nx, -ny, -nz
    facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
    if kind == tx.LEAVES:
        facing = 0.35 + 0.5 * facing
    direct = 0.0
    if facing > 0 and kind != tx.TREELINE:
        direct = facing * lit_by_sun(x + 0.1 * nx, y + 0.1 * ny, z + 0.1 * nz, scene)
    ambient, (r, g, b) = 0.56 + 0.16 * nz, colour
    return r * (ambient * 0.93 + 0.86 * direct), g * (ambient + 0.80 * direct), b * (ambient * 1.10 + 0.70 * direct)


@numpy_division_kernel
def shade(scene: LitScene, ids: ShortInts, planes: Array, origin: Array, rays: Array) -> F32:
    """(H, W, 3) RGB in [0, 255] of the triangles (2H, 2W) that a camera at `origin` (3,) in the world sees.

    Each cell is the mean of its 2 x 2 samples; a triangle that covers several of them is shaded once. The world's
    direction of sample (x, y), at depth 1, is rays (3, 3) @ (x, y, 1).
    """
    height, width = ids.shape[0] // 2, ids.shape[1] // 2
    image = np.empty((height, width, 3), np.float32)
    for row in range(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(4):
                t = ids[2 * row + (k >> 1), 2 * column + (k & 1)]
                count, sum_x, sum_y, fresh = 0, 0.0, 0.0, True
                for j in range(4):
                    if ids[2 * row + (j >> 1), 2 * column + (j & 1)] == t:
                        if j < k:
                            fresh = False
                        count += 1
                        sum_x += 2 * column + (j & 1) + 0.5
                        sum_y += 2 * row + (j >> 1) + 0.5
                if not fresh:
                    continue
                x, y = sum_x / count, sum_y / count
                dx = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
                dy = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
                dz = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                if t < 0:
                    r, g, b = sky(dx / length, dy / length, dz / length, scene.sun.direction, scene.sky_seed)
                else:
                    p = planes[t]
                    depth = 1.0 / (p[0] * x + p[1] * y + p[2])
                    u, v = (p[3] * x + p[4] * y + p[5]) * depth, (p[6] * x + p[7] * y + p[8]) * depth
                    fu = 2 * depth * (abs(p[3] - u * p[0]) + abs(p[4] - u * p[1])) + 1e-6
                    fv = 2 * depth * (abs(p[6] - v * p[0]) + abs(p[7] - v * p[1])) + 1e-6
                    wx, wy, wz = origin[0] + dx * depth, origin[1] + dy * depth, origin[2] + dz * depth
                    colour = lit(scene, t, surface_colour(scene, t, u, v, wx, wy, fu, fv), wx, wy, wz, dx, dy, dz)
                    r, g, b = mixed(colour, (0.84, 0.88, 0.93), 1.0 - math.exp(-depth / 2200.0))  # haze
                red += count * r
                green += count * g
                blue += count * b
            for channel, value in enumerate((red, green, blue)):
                image[row, column, channel] = min(255.0, max(0.0, value * 63.75))
    return image
