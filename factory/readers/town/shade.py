"""Light and surface colour per pixel: what the rasteriser found visible, shaded once per visible triangle."""

import math
from typing import NamedTuple

import numpy as np

from factory.readers.town import textures as tx
from factory.readers.town.raster import Mesh
from factory.readers.town.textures import RGB, chance, grain, inside, mixed, noise, toned, visible
from tasks.kernels.compiled import drawing_kernel
from tasks.world.arrays import F32, Array, ShortInts


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


@drawing_kernel
def dashed(x: float, period: float, dash: float, footprint: float) -> float:
    """Share of a pixel at x that lies on dashes, one at the start of each period; a pattern too fine is its mean."""
    seen = visible(dash, footprint)
    return seen * inside(x % period, 0.0, dash, max(footprint, 0.01)) + (1 - seen) * (dash / period)


@drawing_kernel
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


@drawing_kernel
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


@drawing_kernel
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


@drawing_kernel
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


@drawing_kernel
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


@drawing_kernel
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


@drawing_kernel
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
