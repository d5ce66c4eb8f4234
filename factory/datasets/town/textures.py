"""Procedural textures as compiled functions of surface coordinates (u, v) [m]: nothing depends on the camera.

Every pattern knows the pixel's footprint on the surface (fu, fv) [m] and fades out below it, so that pictures do not
alias and one place has one colour from near and far. Colours are (r, g, b) in 0..1, before light.
"""

import math

from tasks.kernels.compiled import numpy_division_kernel

# Materials
ASPHALT, ROAD, PAVING, KERB, GRASS, FACADE, ROOF_TILES, FLAT_ROOF, BARK, LEAVES, PAINTED, CABIN = range(12)
WHEEL, GLOW, METAL, CLOTH, SIGN, TREELINE, CARGO, BUS_SIDE, SPOKES, ISLAND_STONE, DARK = range(12, 23)

RGB = tuple[float, float, float]
WALLS = (  # colours: three of brick, four of plaster, concrete panels
    *((0.55, 0.30, 0.23), (0.46, 0.33, 0.26), (0.66, 0.54, 0.40)),
    *((0.80, 0.74, 0.62), (0.72, 0.60, 0.42), (0.62, 0.66, 0.68), (0.74, 0.55, 0.47)),
    (0.60, 0.59, 0.57),
)
MORTAR, TRIM, SHUTTER = (0.62, 0.59, 0.55), (1.0, 0.97, 0.92), (0.85, 0.85, 0.82)


@numpy_division_kernel
def toned(colour: RGB, tone: float) -> RGB:
    """The colour, lighter or darker by a factor."""
    return colour[0] * tone, colour[1] * tone, colour[2] * tone


@numpy_division_kernel
def mixed(colour: RGB, other: RGB, share: float) -> RGB:
    """The colour with that share of the other."""
    r, g, b = colour
    return r + (other[0] - r) * share, g + (other[1] - g) * share, b + (other[2] - b) * share


@numpy_division_kernel
def chance(x: int, y: int, seed: int) -> float:
    """A fixed random number in [0, 1) of an integer cell."""
    h = (x * 374761393 + y * 668265263 + seed * 1442695041) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 668265263) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@numpy_division_kernel
def noise(u: float, v: float, seed: int) -> float:
    """Value noise in [0, 1) with cells of size 1."""
    iu, iv = math.floor(u), math.floor(v)
    a, b = u - iu, v - iv
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    x, y = int(iu), int(iv)
    top = chance(x, y, seed) * (1 - a) + chance(x + 1, y, seed) * a
    low = chance(x, y + 1, seed) * (1 - a) + chance(x + 1, y + 1, seed) * a
    return top * (1 - b) + low * b


@numpy_division_kernel
def visible(size: float, footprint: float) -> float:
    """How much of a pattern of that size survives a pixel of that footprint (1 near, 0 far)."""
    return min(1.0, max(0.0, 1.6 * size / footprint - 0.8))


@numpy_division_kernel
def inside(x: float, low: float, high: float, footprint: float) -> float:
    """Share of a pixel of that footprint at x that lies in [low, high]."""
    return (
        min(1.0, max(0.0, (min(x, high) - max(x, low)) / footprint + 0.5))
        if x < low or x > high
        else min(1.0, min(x - low, high - x) / footprint + 0.5)
    )


@numpy_division_kernel
def grain(u: float, v: float, seed: int, footprint: float) -> float:
    """Three octaves of fine noise around 0: stones of 6, 2 and 0.7 cm."""
    out = 0.0
    size = 0.06
    for k in range(3):
        seen = visible(size, footprint)
        if seen <= 0.0:
            break
        out += seen * (noise(u / size, v / size, seed + k) - 0.5)
        size *= 0.35
    return out


@numpy_division_kernel
def asphalt(x: float, y: float, footprint: float) -> RGB:
    """Worn asphalt in world coordinates: broad tones, repairs, cracks, grain."""
    tone = 0.335 + 0.07 * (noise(x / 9.0, y / 9.0, 1) - 0.5) + 0.07 * (noise(x / 1.7, y / 1.7, 2) - 0.5)
    patch_u, patch_v = (x * 0.8 + y * 0.6) / 7.0, (y * 0.8 - x * 0.6) / 11.0
    if chance(math.floor(patch_u), math.floor(patch_v), 5) < 0.22:
        tone *= 0.86
    blotch = noise(x / 0.45, y / 0.45, 3) - 0.5
    tone += 0.05 * visible(0.45, footprint) * blotch
    seen = visible(0.10, footprint)
    if seen > 0.0:
        bend_x, bend_y = x + 0.5 * noise(x / 0.9, y / 0.9, 7), y + 0.5 * noise(x / 0.9, y / 0.9, 8)
        ridge = abs(noise(bend_x / 2.6, bend_y / 2.6, 4) - 0.5)
        if ridge < 0.018 and noise(x / 14.0, y / 14.0, 6) > 0.42:
            tone -= 0.11 * seen * (1 - ridge / 0.018)
        tone += 0.05 * grain(x, y, 11, footprint)
    return tone, tone * 1.005, tone * 1.02


@numpy_division_kernel
def paving(u: float, v: float, seed: int, footprint: float) -> RGB:
    """Concrete slabs of 60 x 40 cm."""
    row = math.floor(v / 0.4)
    shifted = u + 0.3 * (row % 2)
    column = math.floor(shifted / 0.6)
    seen = visible(0.4, footprint)
    tone = (
        0.56
        + 0.09 * seen * (chance(int(column), int(row), seed) - 0.5)
        + 0.06 * (noise(u / 2.3, v / 2.3, seed + 1) - 0.5)
    )
    du, dv = shifted - column * 0.6, v - row * 0.4
    joint = max(
        1 - min(du, 0.6 - du) / max(0.008, footprint * 0.7), 1 - min(dv, 0.4 - dv) / max(0.008, footprint * 0.7)
    )
    if joint > 0:
        tone -= 0.2 * joint * visible(0.1, footprint)
    tone += 0.05 * grain(u, v, seed + 2, footprint)
    spot = noise(u / 0.25, v / 0.25, seed + 4)
    if spot > 0.86:
        tone -= 0.3 * (spot - 0.86) * visible(0.2, footprint) * 2
    return tone * 1.01, tone * 0.985, tone * 0.94


@numpy_division_kernel
def grass(x: float, y: float, footprint: float) -> RGB:
    """A lawn with tufts and bare spots."""
    broad = noise(x / 6.0, y / 6.0, 21)
    tuft = (noise(x / 0.5, y / 0.5, 22) - 0.5) * visible(0.5, footprint)
    blade = (noise(x / 0.09, y / 0.09, 23) - 0.5) * visible(0.09, footprint)
    blade += (noise(x / 0.03, y / 0.03, 24) - 0.5) * visible(0.03, footprint)
    tone = 0.85 + 0.3 * tuft + 0.25 * blade
    bare = min(1.0, max(0.0, (broad - 0.62) * 5))
    return (0.27 + 0.12 * bare) * tone, (0.36 - 0.02 * bare) * tone, (0.15 + 0.07 * bare) * tone


@numpy_division_kernel
def wall(u: float, v: float, style: int, seed: int, footprint: float) -> RGB:
    """Brick, plaster or concrete panels, as in WALLS, stained from above."""
    stain = 1.0 + 0.16 * (noise(u / 1.3, v / 4.0, seed) - 0.5) + 0.10 * (noise(u / 0.4, v / 0.9, seed + 1) - 0.5)
    if style <= 2:
        row = math.floor(v / 0.085)
        shifted = u + 0.12 * (row % 2)
        column = math.floor(shifted / 0.24)
        seen = visible(0.085, footprint)
        tone = stain * (1 + 0.2 * seen * (chance(int(column), int(row), seed) - 0.5))
        du, dv = shifted - column * 0.24, v - row * 0.085
        mortar = max(inside(du, 0.0, 0.014, footprint), inside(dv, 0.0, 0.014, footprint)) * visible(0.06, footprint)
        return mixed(toned(WALLS[style], tone), MORTAR, mortar)
    rough = toned(WALLS[style], stain + 0.1 * grain(u, v, seed + 3, footprint))
    return toned(rough, 0.75) if style == 7 and (u % 3.0 < 0.03 or v % 1.6 < 0.03) and footprint < 0.3 else rough


@numpy_division_kernel
def pane(u: float, v: float, cell: int, seed: int) -> RGB:
    """Glass seen from the street: a dark room, a curtain, a bit of sky; u, v in 0..1 over the pane."""
    kind = chance(cell, 3, seed)
    if kind < 0.35 and abs(u - 0.5) > 0.17 + 0.2 * chance(cell, 5, seed):
        return toned((0.74, 0.70, 0.62), 0.85 + 0.15 * math.sin(u * 60.0))
    if kind > 0.7 and v > 0.3 + 0.6 * chance(cell, 6, seed):
        return 0.62, 0.60, 0.55
    if kind > 0.62 and kind < 0.66:
        return 0.85, 0.74, 0.48
    sky = 0.16 + 0.30 * max(0.0, v - 0.35 + 0.25 * (u - 0.5)) * chance(cell, 4, seed)
    return 0.10 + sky * 0.8, 0.12 + sky * 0.95, 0.15 + sky * 1.1


@numpy_division_kernel
def facade(u: float, v: float, width: float, height: float, seed: int, fu: float, fv: float) -> RGB:
    """A house front: plinth, shops or doors at street level, floors of windows, cornice. Everything by `seed`."""
    ground = 3.3 + chance(seed, 2, 77) * 0.9
    floor_height = 2.9 + chance(seed, 3, 77) * 0.5
    spacing = width / max(1.0, math.floor(width / (2.1 + 1.2 * chance(seed, 4, 77))))
    trim = 0.55 + 0.35 * chance(seed, 5, 77)
    cornice = toned(TRIM, trim)
    colour = wall(u, v, int(chance(seed, 1, 77) * 8), seed, max(fu, fv))
    bay = math.floor(u / spacing)
    x = u - bay * spacing
    if v > ground:
        floor = math.floor((v - ground) / floor_height)
        y = v - ground - floor * floor_height
        if ground + (floor + 1) * floor_height < height - 0.3:
            half = spacing * (0.21 + 0.12 * chance(seed, 7, 77))
            low, high = 0.75 + 0.2 * chance(seed, 8, 77), floor_height - 0.42
            left, right = spacing / 2 - half, spacing / 2 + half
            surround = inside(x, left - 0.14, right + 0.14, fu) * inside(y, low - 0.16, high + 0.16, fv)
            sill = inside(y, low - 0.42, low - 0.16, fv) * inside(x, left - 0.1, right + 0.1, fu)
            colour = toned(mixed(colour, cornice, surround), 1 - 0.28 * sill)
            opening = inside(x, left, right, fu) * inside(y, low, high, fv)
            if opening > 0.0:
                pu, pv = (x - left) / (right - left), (y - low) / (high - low)
                glass = pane(pu, pv, int(bay) * 31 + int(floor), seed)
                frame = 1.0 - inside(x, left + 0.07, right - 0.07, fu) * inside(y, low + 0.07, high - 0.07, fv)
                bars = inside(pu, 0.46, 0.54, fu / (right - left)), inside(pv, 0.66, 0.71, fv / (high - low))
                tone = 0.88 if chance(seed, 9, 77) < 0.7 else 0.22
                glass = mixed(glass, (tone, tone, tone), max(frame, bars[0], bars[1]))
                colour = mixed(colour, toned(glass, 1.0 - 0.55 * inside(y, high - 0.16, high, fv)), opening)
        colour = mixed(colour, (trim * 0.9, trim * 0.88, trim * 0.84), inside(y, 0.0, 0.16, fv))
    elif chance(seed, 6, 77) < 0.55:
        colour = shopfront(u, v, ground, seed, fu, fv)
    else:
        left, right = spacing * 0.25, spacing * 0.75
        is_door = chance(int(bay), 12, seed) < 0.3
        low, high = (0.12, 2.35) if is_door else (1.0, 2.5)
        opening = inside(x, left, right, fu) * inside(v, low, high, fv)
        if is_door:
            hue = chance(int(bay), 13, seed)
            across = inside((x - left) / (right - left) * 2 % 1.0, 0.15, 0.85, fu)
            panel = 0.75 + 0.25 * inside((v * 1.4) % 1.0, 0.12, 0.88, fv * 1.4) * across
            filling = toned((0.16 + 0.34 * hue, 0.20 + 0.10 * hue, 0.30 - 0.2 * hue), panel)
        else:
            filling = pane((x - left) / (right - left), (v - low) / (high - low), int(bay), seed + 1)
            frame = 1.0 - inside(x, left + 0.08, right - 0.08, fu) * inside(v, low + 0.08, high - 0.08, fv)
            filling = mixed(filling, SHUTTER, frame)
        r, g, b = mixed(colour, filling, opening)
        plinth = inside(v, -1.0, 0.5, fv) * (1 - opening)
        colour = r * (1 - 0.4 * plinth), g * (1 - 0.4 * plinth), b * (1 - 0.38 * plinth)
    return mixed(colour, cornice, inside(v, height - 0.45, height + 1.0, fv))


@numpy_division_kernel
def shopfront(u: float, v: float, ground: float, seed: int, fu: float, fv: float) -> RGB:
    """Shops of 4.6 m: sign with letters, window with goods, door, stall riser."""
    shop = math.floor(u / 4.6)
    x = u - shop * 4.6
    hue = chance(shop, 21, seed)
    sign = 0.15 + 0.65 * chance(shop, 22, seed), 0.15 + 0.4 * hue, 0.15 + 0.5 * chance(shop, 23, seed)
    if v > ground - 0.85:
        letter = 0.0
        y = (v - ground + 0.68) / 0.42
        if 0.0 < y < 1.0 and 0.5 < x < 3.9 and chance(int(x / 0.34), 24, seed + shop) > 0.12:
            stroke = chance(int(x / 0.085), int(y * 4), seed + 9 * shop) > 0.45
            letter = visible(0.12, max(fu, fv)) * 0.85 if stroke and (x / 0.34) % 1.0 < 0.78 else 0.0
        edge = 1.0 - inside(x, 0.1, 4.5, fu) * inside(v, ground - 0.8, ground - 0.12, fv)
        tone = 0.92 if hue < 0.7 else 0.1
        return toned(mixed(sign, (tone, tone, tone * 0.95), letter), 1 - 0.5 * edge)
    door = x > 3.35
    low = 0.1 if door else 0.55
    left, right = (3.5, 4.4) if door else (0.25, 3.3)
    bar = 0.0 if door else inside(x, 1.72, 1.82, fu)
    glass = inside(x, left, right, fu) * inside(v, low, ground - 1.0, fv) * (1 - bar)
    goods = noise(x / 0.35, v / 0.45, seed + shop) * visible(0.35, max(fu, fv)) if v < 1.9 else 0.3
    column, row = math.floor(x / 0.35), math.floor(v / 0.45)
    goods *= 0.2 + 0.8 * chance(column, row, seed + 1)
    warm = chance(column, row, seed + 2) - 0.5
    window = (
        0.12 + goods * (0.52 + 0.25 * warm) + 0.10 * v / ground,
        0.13 + goods * 0.46 + 0.11 * v / ground,
        0.15 + goods * (0.38 - 0.25 * warm) + 0.13 * v / ground,
    )
    return mixed((sign[0] * 0.6 + 0.1, sign[1] * 0.6 + 0.1, sign[2] * 0.6 + 0.1), window, glass)


@numpy_division_kernel
def leaf_here(u: float, v: float, seed: int) -> bool:
    """Is there a leaf at this place of a twig's card (in metres)?"""
    for k in range(2):
        size = 0.17 if k == 0 else 0.24
        iu, iv = math.floor(u / size), math.floor(v / size)
        cx, cy = chance(int(iu), int(iv), seed + 3 + 9 * k), chance(int(iu), int(iv), seed + 4 + 9 * k)
        x, y = u / size - iu - 0.35 - 0.3 * cx, v / size - iv - 0.35 - 0.3 * cy
        turn = 6.283 * chance(int(iu), int(iv), seed + 5)
        along, across = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
        if along * along / 0.20 + across * across / 0.07 < 1.0:
            return True
    return False


@numpy_division_kernel
def opaque_at(material: int, u: float, v: float, seed: int) -> bool:
    """The cut-out materials' masks."""
    if material == LEAVES:
        return u * u + v * v < 0.8 and leaf_here(u, v, seed)
    if material == TREELINE:
        top = 5.0 + 7.0 * noise(u / 16.0, 0.5, 41) + 3.0 * noise(u / 4.0, 0.5, 42) + 1.2 * noise(u / 1.1, 0.5, 43)
        return v < top
    radius = math.sqrt(u * u + v * v)
    spoke = abs(math.atan2(v, u) * 9.0 / math.pi % 1.0 - 0.5) > 0.44
    return 0.29 < radius < 0.345 or (radius < 0.3 and spoke) or radius < 0.04
