"""Cars, trucks, buses, pedestrians and cyclists as meshes in their own frame: x forward, y left, z up from the road."""

import itertools
from functools import lru_cache

import numpy as np

from factory.readers.town import textures as tx
from factory.readers.town.mesh import Builder, shades
from factory.readers.town.raster import Mesh
from factory.readers.town.traffic import TownTrack
from tasks.world.arrays import Array

CAR_PAINT = shades("62 64 66, 12 12 13, 85 85 84, 36 38 40, 50 8 9, 11 20 42, 18 30 24, 70 62 50, 74 72 70, 60 30 10")
BUS_PAINT = shades("72 12 10, 10 30 55, 80 66 12")
CLOTHES = shades("20 24 40, 55 12 14, 14 14 15, 66 64 58, 18 38 30, 75 55 18, 36 20 38, 30 45 62")
SKIN = shades("80 62 50, 55 38 28, 70 52 40, 36 24 18")
HAIR = shades("10 7 5, 30 20 10, 5 5 5, 50 42 30")
HEAD_LIGHT, TAIL_LIGHT, PLATE = (0.95, 0.95, 0.88), (0.62, 0.05, 0.05), (0.86, 0.84, 0.70)
WINDSCREEN = (0.14, 0.15, 0.17)
GLASS_UV = [(0.08, 0.05), (0.44, 0.05), (0.44, 0.95), (0.08, 0.95)]
SIDES = (-1.0, 1.0)  # right, left
STRIDE_M = 1.4  # a pedestrian's two steps

Corners = list[tuple[float, float, float]]


def figure(track: TownTrack, step: int) -> Mesh:
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


def _lamps(b: Builder, side: float, w: float, head: tuple[float, ...], tail: tuple[float, ...]) -> None:
    """Lamps: x and z below, x and z above, and from where to where inwards of half the width w."""
    for (x, z, x_high, z_high, inner, outer), light in ((head, HEAD_LIGHT), (tail, TAIL_LIGHT)):
        b.face(_panel((x, z), (x_high, z_high), (side * (w - inner), side * (w - outer))), tx.GLOW, light)


def _ground(b: Builder, length: float, width: float, axles: tuple[float, ...], track: float, radius: float) -> None:
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
    b, paint = Builder(), _pick(CAR_PAINT, look)
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
    _ground(b, length, width, (f - 0.85, r + 0.85), w, 0.33)
    return b.mesh()


@lru_cache(maxsize=1024)
def _truck(length: float, width: float, height: float, look: int) -> Mesh:
    b, paint = Builder(), _pick(CAR_PAINT, look)
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
    _ground(b, length, width, (f - 1.0, r + 1.3), w - 0.02, 0.45)
    return b.mesh()


@lru_cache(maxsize=1024)
def _bus(length: float, width: float, height: float, look: int) -> Mesh:
    b, paint = Builder(), _pick(BUS_PAINT, look)
    f, r, w = length / 2, -length / 2, width / 2
    for (x0, y0), (x1, y1) in itertools.pairwise([(f, w), (r, w), (r, -w), (f, -w), (f, w)]):
        b.face([(x0, y0, 0.3), (x1, y1, 0.3), (x1, y1, height), (x0, y0, height)], tx.BUS_SIDE, paint, look)
    b.face(_level(r, f, w, height), tx.METAL, (0.85, 0.85, 0.84))
    for side in SIDES:
        _lamps(b, side, w, *((x, 0.6, x, 0.85, 0.45, 0.12) for x in (f + 0.006, r - 0.006)))
    _ground(b, length, width, (f - 2.4, r + 3.0), w, 0.48)
    return b.mesh()


@lru_cache(maxsize=1024)
def _person(look: int, phase: int) -> Mesh:
    """A walker, 1.75 m; legs and arms swing with `phase` in sixteenths of a stride."""
    b, shirt, trousers = Builder(), _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
    swing = 0.32 * np.sin(2 * np.pi * phase / 16)
    for side, s in ((-1.0, swing), (1.0, -swing)):
        y = side * 0.10
        b.tube((0.0, y, 0.90), (s, y, 0.08), 0.09, tx.CLOTH, trousers, look, sides=6, taper=0.75)
        b.box((s + 0.05, y, 0.05), (0.27, 0.10, 0.10), tx.DARK, (0.1, 0.09, 0.08))
        b.tube((0.0, side * 0.22, 1.42), (-s * 0.8, side * 0.25, 0.88), 0.055, tx.CLOTH, shirt, look, sides=5)
    b.box((0.0, 0.0, 1.17), (0.24, 0.40, 0.62), tx.CLOTH, shirt, look, taper=0.95)
    _head(b, 0.0, look)
    return b.mesh()


def _head(b: Builder, x: float, look: int) -> None:
    b.post((x, 0.0), 1.60 - 0.14, 1.60 + 0.02, 0.085, tx.CLOTH, _pick(SKIN, look), look, sides=8, taper=1.15)
    b.post((x, 0.0), 1.60 + 0.02, 1.60 + 0.14, 0.10, tx.CLOTH, _pick(HAIR, look // 4), look, sides=8, taper=0.45)


@lru_cache(maxsize=1024)
def _cyclist(look: int, phase: int) -> Mesh:
    """A rider on a bicycle; pedals turn with `phase`."""
    b, shirt, trousers = Builder(), _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
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
