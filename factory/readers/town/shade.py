"""Light and surface colour per pixel: what the rasteriser found visible, shaded once per visible triangle."""

import math

from factory.readers.town import textures as tx
from factory.readers.town.textures import RGB, chance, grain, inside, noise, visible
from tasks.kernels.compiled import drawing_kernel
from tasks.world.arrays import F32, Array, Ints, ShortInts


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
            share = marks[m, 5] / marks[m, 4]
            seen = visible(marks[m, 5], fu)
            cover *= (
                seen * inside((u - marks[m, 2]) % marks[m, 4], 0.0, marks[m, 5], max(fu, 0.01)) + (1 - seen) * share
            )
        if marks[m, 6] > 0:
            share = marks[m, 7] / marks[m, 6]
            seen = visible(marks[m, 7], fd)
            cover *= (
                seen * inside((d - marks[m, 0]) % marks[m, 6], 0.0, marks[m, 7], max(fd, 0.01)) + (1 - seen) * share
            )
        if cover > best:
            best, yellow = cover, marks[m, 8]
    return best, yellow


@drawing_kernel
def road_surface(x: float, y: float, u: float, d: float, marks: Array, fu: float, fd: float) -> RGB:
    """Asphalt with worn lane paint; the gutter beside the kerb is darker."""
    fp = max(fu, fd)
    r, g, b = tx.asphalt(x, y, fp)
    track = 1.0 - 0.06 * math.cos(d * 3.59) * visible(1.0, fd)
    r, g, b = r * track, g * track, b * track
    cover, yellow = road_paint(u, d, marks, fu, fd)
    if cover > 0.0:
        wear = (
            0.92
            - 0.25 * max(0.0, noise(x / 0.13, y / 0.13, 31) - 0.55) * visible(0.13, fp)
            - 0.15 * noise(x / 2.0, y / 2.0, 32)
        )
        cover *= wear
        r += ((0.86 + 0.02 * yellow) - r) * cover
        g += ((0.86 - 0.16 * yellow) - g) * cover
        b += ((0.83 - 0.60 * yellow) - b) * cover
    return r, g, b


@drawing_kernel
def sky(dx: float, dy: float, dz: float, sun: Array, seed: int) -> RGB:
    """The sky in a direction: gradient, clouds on a high plane, a glow around the sun."""
    up = max(0.0, dz)
    blend = math.sqrt(up)
    r, g, b = 0.84 - 0.52 * blend, 0.89 - 0.37 * blend, 0.95 - 0.13 * blend
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
    r, g, b = r + (light - r) * cover, g + (light - g) * cover, b + (light * 1.01 - b) * cover
    glow = max(0.0, dx * sun[0] + dy * sun[1] + dz * sun[2]) ** 24 * 0.25
    return min(1.0, r + glow), min(1.0, g + glow), min(1.0, b + glow * 0.8)


@drawing_kernel
def surface_colour(
    kind: int,
    u: float,
    v: float,
    x: float,
    y: float,
    fu: float,
    fv: float,
    r: float,
    g: float,
    b: float,
    extent_u: float,
    extent_v: float,
    seed: int,
    marks: Array,
) -> RGB:
    """Colour before light of a material; (r, g, b) is the triangle's own colour, `extent` the size of its face [m]."""
    fp = max(fu, fv)
    if kind == tx.ROAD:
        return road_surface(x, y, u, v, marks[seed], fu, fv)
    if kind == tx.ASPHALT:
        return tx.asphalt(x, y, fp)
    if kind == tx.PAVING:
        return tx.paving(u, v, 51, fp)
    if kind == tx.GRASS:
        return tx.grass(x, y, fp)
    if kind == tx.FACADE:
        return tx.facade(u, v, extent_u, extent_v, seed, fu, fv)
    if kind == tx.LEAVES:
        tone = 0.85 + 0.3 * chance(math.floor(u / 0.17), math.floor(v / 0.17), seed)
        return r * tone, g * tone, b * tone
    if kind == tx.KERB:
        joint = 0.7 if u % 1.0 < 0.02 and fu < 0.2 else 1.0
        tone = (0.62 + 0.14 * grain(u, v, 61, fp) + 0.08 * (noise(u / 1.0, v, 62) - 0.5)) * joint
        return tone, tone * 0.98, tone * 0.94
    if kind == tx.BARK:
        tone = 0.7 + 0.6 * noise(u / 0.05, v / 0.35, seed) * visible(0.05, fp) + 0.3 * noise(u / 0.3, v / 1.0, seed + 1)
        return r * tone, g * tone, b * tone
    if kind == tx.ROOF_TILES:
        row = math.floor(v / 0.32)
        column = math.floor(u / 0.25 + 0.5 * (row % 2))
        tone = 1.0 + visible(0.3, fp) * (
            0.35 * (chance(int(column), int(row), seed) - 0.5) - 0.4 * max(0.0, 1 - (v / 0.32 - row) * 4)
        )
        return r * tone, g * tone, b * tone
    if kind == tx.CABIN:  # u: 0 rear .. 1 front, v: 0 sill .. 1 roof edge
        pillar = max(inside(u, 0.47, 0.53, fu), 1 - inside(u, 0.05, 0.96, fu), 1 - inside(v, 0.06, 0.88, fv))
        glass = 0.10 + 0.16 * v + 0.12 * noise(u * 5.0, v * 2.0 + seed % 97, 71)
        return (
            glass * 0.9 + (r - glass * 0.9) * pillar,
            glass + (g - glass) * pillar,
            glass * 1.12 + (b - glass * 1.12) * pillar,
        )
    if kind == tx.WHEEL:  # u, v: offsets from the hub [m]
        radius = math.sqrt(u * u + v * v)
        spoke = math.cos(math.atan2(v, u) * 5.0)
        if radius < 0.20:
            tone = 0.62 if spoke > -0.2 or radius < 0.06 or radius > 0.18 else 0.16
        else:
            tone = 0.09 if radius < 0.36 else 0.05
        return tone, tone, tone * 1.02
    if kind == tx.PAINTED:  # u along, v up: door gaps and handles
        gap = 0.0
        if extent_u > 0:
            for at in (0.30, 0.49, 0.68):
                gap = max(
                    gap,
                    inside(u, at * extent_u - 0.012, at * extent_u + 0.012, max(fu, 0.008))
                    * min(1.0, 0.024 / max(fu, 0.008)),
                )
            handle = inside(v, 0.72, 0.76, fv) * max(
                inside(u, 0.36 * extent_u, 0.40 * extent_u, fu), inside(u, 0.55 * extent_u, 0.59 * extent_u, fu)
            )
            gap = max(gap, 0.7 * handle, 0.55 * inside(v, -1.0, 0.32, fv))
        tone = (1.0 - 0.75 * gap) * (0.94 + 0.12 * v)
        return r * tone, g * tone, b * tone
    if kind == tx.CARGO:
        stripe = inside(v, 0.9, 1.25, fv)
        rib = 1.0 - 0.10 * visible(0.3, fu) * (1.0 if u % 0.6 < 0.05 else 0.0)
        logo = (
            1.0
            if 1.0 < u < extent_u - 1.2 and 1.5 < v < 2.1 and chance(int(u / 0.15), int(v / 0.2), seed) > 0.5
            else 0.0
        )
        mix = max(stripe, 0.8 * logo * visible(0.2, fp))
        return (0.86 + (r - 0.86) * mix) * rib, (0.86 + (g - 0.86) * mix) * rib, (0.85 + (b - 0.85) * mix) * rib
    if kind == tx.BUS_SIDE:
        window = inside(v, 1.15, 2.35, fv) * inside(u % 1.45, 0.06, 1.39, fu)
        glass = 0.12 + 0.2 * noise(u / 0.5, v / 0.6, seed)
        return r + (glass - r) * window, g + (glass * 1.05 - g) * window, b + (glass * 1.15 - b) * window
    if kind == tx.SIGN:  # round face: u, v offsets over radius
        radius = math.sqrt(u * u + v * v)
        if radius > 0.74:
            return 0.78, 0.08, 0.08
        digit = abs(v) < 0.38 and 0.08 < abs(u) < 0.5 and chance(int((u + 1) * 6), int((v + 1) * 6), seed) > 0.42
        tone = 0.08 if digit else 0.93
        return tone, tone, tone
    if kind == tx.TREELINE:
        tone = 0.75 + 0.5 * noise(u / 0.9, v / 0.7, 45) + 0.25 * noise(u / 5.0, v / 3.0, 46)
        return r * tone, g * tone, b * tone
    if kind == tx.CLOTH:
        tone = 0.88 + 0.24 * noise(u / 0.06, v / 0.09, seed)
        return r * tone, g * tone, b * tone
    if kind == tx.ISLAND_STONE or kind == tx.FLAT_ROOF:
        tone = 0.9 + 0.2 * noise(u / 0.6, v / 0.6, 81) + 0.2 * grain(u, v, 82, fp)
        return r * tone, g * tone, b * tone
    return r, g, b


@drawing_kernel
def lit_by_sun(x: float, y: float, z: float, sun_view: Array, shadow: F32, bias: float) -> float:
    """0 in shade .. 1 in the sun: four taps of the sun's depth map, blended; outside it: sun."""
    sx = sun_view[0, 0] * x + sun_view[0, 1] * y + sun_view[0, 2] * z + sun_view[0, 3] - 0.5
    sy = sun_view[1, 0] * x + sun_view[1, 1] * y + sun_view[1, 2] * z + sun_view[1, 3] - 0.5
    key = sun_view[3, 0] * x + sun_view[3, 1] * y + sun_view[3, 2] * z + sun_view[3, 3] + bias
    column, row = math.floor(sx), math.floor(sy)
    if row < 0 or column < 0 or row + 1 >= shadow.shape[0] or column + 1 >= shadow.shape[1]:
        return 1.0
    a, b = sx - column, sy - row
    top = (1 - a) * (1.0 if key > shadow[row, column] else 0.0) + a * (1.0 if key > shadow[row, column + 1] else 0.0)
    low = (1 - a) * (1.0 if key > shadow[row + 1, column] else 0.0) + a * (
        1.0 if key > shadow[row + 1, column + 1] else 0.0
    )
    return (1 - b) * top + b * low


@drawing_kernel
def shade(
    ids: ShortInts,  # (2H, 2W) visible triangle, -1: sky
    planes: Array,  # (T, 9)
    normals: Array,  # (T, 3)
    material: Ints,
    colour: Array,  # (T, 3)
    extent: Array,  # (T, 2)
    seed: Ints,
    marks: Array,  # (roads, M, 9)
    origin: Array,  # (3,) the camera in the world
    rays: Array,  # (3, 3): world direction of sample (x, y), depth 1 = rays @ (x, y, 1)
    sun: Array,  # (3,) unit, towards the sun
    sun_view: Array,  # (4, 4)
    shadow: F32,
    sky_seed: int,
    image: F32,  # (H, W, 3) out, RGB in [0, 255]
) -> None:
    """Each cell is the mean of its 2 x 2 samples; a triangle that covers several of them is shaded once."""
    height, width = image.shape[:2]
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
                    r, g, b = sky(dx / length, dy / length, dz / length, sun, sky_seed)
                else:
                    p = planes[t]
                    depth = 1.0 / (p[0] * x + p[1] * y + p[2])
                    u, v = (p[3] * x + p[4] * y + p[5]) * depth, (p[6] * x + p[7] * y + p[8]) * depth
                    fu = 2 * depth * (abs(p[3] - u * p[0]) + abs(p[4] - u * p[1])) + 1e-6
                    fv = 2 * depth * (abs(p[6] - v * p[0]) + abs(p[7] - v * p[1])) + 1e-6
                    wx, wy, wz = origin[0] + dx * depth, origin[1] + dy * depth, origin[2] + dz * depth
                    kind = material[t]
                    r, g, b = surface_colour(
                        kind,
                        u,
                        v,
                        wx,
                        wy,
                        fu,
                        fv,
                        colour[t, 0],
                        colour[t, 1],
                        colour[t, 2],
                        extent[t, 0],
                        extent[t, 1],
                        seed[t],
                        marks,
                    )
                    if kind != tx.GLOW:
                        nx, ny, nz = normals[t, 0], normals[t, 1], normals[t, 2]
                        if kind != tx.LEAVES and nx * dx + ny * dy + nz * dz > 0:
                            nx, ny, nz = -nx, -ny, -nz
                        facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
                        if kind == tx.LEAVES:
                            facing = 0.35 + 0.5 * facing
                        direct = 0.0
                        if facing > 0 and kind != tx.TREELINE:
                            direct = facing * lit_by_sun(
                                wx + 0.1 * nx, wy + 0.1 * ny, wz + 0.1 * nz, sun_view, shadow, 0.25
                            )
                        ambient = 0.56 + 0.16 * nz
                        r *= ambient * 0.93 + 0.86 * direct
                        g *= ambient + 0.80 * direct
                        b *= ambient * 1.10 + 0.70 * direct
                    haze = 1.0 - math.exp(-depth / 2200.0)
                    r, g, b = r + (0.84 - r) * haze, g + (0.88 - g) * haze, b + (0.93 - b) * haze
                red += count * r
                green += count * g
                blue += count * b
            image[row, column, 0] = min(255.0, max(0.0, red * 63.75))
            image[row, column, 1] = min(255.0, max(0.0, green * 63.75))
            image[row, column, 2] = min(255.0, max(0.0, blue * 63.75))
