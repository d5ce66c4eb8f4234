"""Cars, trucks, buses, pedestrians and cyclists as meshes in their own frame: x forward, y left, z up from the road."""

import itertools
from functools import lru_cache

import numpy as np

from factory.readers.town import textures as tx
from factory.readers.town.mesh import Builder, Mesh
from factory.readers.town.traffic import Track

CAR_PAINT = (
    (0.62, 0.64, 0.66),
    (0.12, 0.12, 0.13),
    (0.85, 0.85, 0.84),
    (0.36, 0.38, 0.40),
    (0.50, 0.08, 0.09),
    (0.11, 0.20, 0.42),
    (0.18, 0.30, 0.24),
    (0.70, 0.62, 0.50),
    (0.74, 0.72, 0.70),
    (0.60, 0.30, 0.10),
)
CLOTHES = (
    (0.20, 0.24, 0.40),
    (0.55, 0.12, 0.14),
    (0.14, 0.14, 0.15),
    (0.66, 0.64, 0.58),
    (0.18, 0.38, 0.30),
    (0.75, 0.55, 0.18),
    (0.36, 0.20, 0.38),
    (0.30, 0.45, 0.62),
)
HEAD_LIGHT, TAIL_LIGHT, PLATE = (0.95, 0.95, 0.88), (0.62, 0.05, 0.05), (0.86, 0.84, 0.70)
STRIDE_M = 1.4  # a pedestrian's two steps


def figure(track: Track, step: int) -> Mesh:
    """The track's mesh at one step, in the world."""
    pose = track.poses[step]
    if track.category in ("PEDESTRIAN", "BICYCLIST"):
        walked = np.nancumsum(np.r_[0.0, np.hypot(*np.diff(track.poses[:, :2], axis=0).T)])
        moving = walked[min(step + 1, len(walked) - 1)] - walked[max(step - 1, 0)] > 0.05
        phase = int(walked[step] / STRIDE_M * 16) % 16 if moving else 0
        template = (
            _person(track.look % 64, phase) if track.category == "PEDESTRIAN" else _cyclist(track.look % 64, phase)
        )
    elif track.category == "BUS":
        template = _bus(*track.size, track.look % 64)
    elif track.category == "BOX_TRUCK":
        template = _truck(*track.size, track.look % 64)
    else:
        template = _car(*track.size, track.look % 64)
    return template.placed(pose)


def _pick(palette: tuple[tuple[float, float, float], ...], look: int) -> tuple[float, float, float]:
    return palette[look % len(palette)]


def _ground_shade(b: Builder, length: float, width: float) -> None:
    """The dark under a vehicle, where no sky reaches."""
    f, w = 0.48 * length, 0.48 * width
    b.face([(-f, -w, 0.02), (f, -w, 0.02), (f, w, 0.02), (-f, w, 0.02)], tx.DARK, (0.10, 0.10, 0.10))


def _wheels(b: Builder, axles: tuple[float, ...], half_width: float, radius: float) -> None:
    for x in axles:
        for side in (-1.0, 1.0):
            y = side * half_width
            axis = np.array([0.0, side, 0.0])
            b.disc(
                np.array([x, y + side * 0.004, radius + 0.03]),
                axis,
                radius * 1.2,
                tx.DARK,
                (0.05, 0.05, 0.05),
                sides=14,
            )
            b.disc(np.array([x, y + side * 0.012, radius]), axis, radius, tx.WHEEL, sides=14, uv_scale=0.34 / radius)
            b.tube(
                (x, y - side * 0.22, radius),
                (x, y + side * 0.01, radius),
                radius,
                tx.DARK,
                (0.07, 0.07, 0.07),
                sides=10,
            )


@lru_cache(maxsize=512)
def _car(length: float, width: float, height: float, look: int) -> Mesh:
    b = Builder()
    paint = _pick(CAR_PAINT, look)
    f, r, w, h = length / 2, -length / 2, width / 2, height
    estate = height > 1.6 or look % 3 == 0
    belt = 0.60 * h
    hull = [
        (f - 0.02, 0.22),
        (f, 0.48),
        (f - 0.06, 0.66),
        (f - 0.28, 0.74),
        (f - 1.12, belt),
        (r + 0.10 if estate else r + 0.55, belt + 0.02),
        (r + 0.04, belt - 0.02),
        (r, 0.55),
        (r + 0.05, 0.24),
    ]
    for (x0, z0), (x1, z1) in itertools.pairwise(hull):
        shade = 0.96 * np.array(paint)
        b.face(
            [(x0, w, z0), (x0, -w, z0), (x1, -w, z1), (x1, w, z1)], tx.DARK if z0 < 0.3 or z1 < 0.3 else tx.METAL, shade
        )
    ring = np.array(hull)
    for side in (-1.0, 1.0):
        hub = np.array([0.0, side * w, 0.45])
        a = np.column_stack([ring[:, 0], np.full(len(ring), side * w), ring[:, 1]])
        points = np.stack([np.broadcast_to(hub, (len(a), 3)), a, np.roll(a, -1, axis=0)], axis=1)
        uv = np.stack([points[..., 0] - r, points[..., 2]], axis=-1)
        b.triangles(points, uv, tx.PAINTED, paint, look, (length, height))
    base_f, base_r = f - 1.08, r + (0.12 if estate else 0.52)
    roof_f, roof_r = f - 1.85, r + (0.42 if estate else 1.15)
    inner = w - 0.06
    top = w - 0.24
    for side in (-1.0, 1.0):
        b.face(
            [
                (base_r, side * inner, belt),
                (base_f, side * inner, belt),
                (roof_f, side * top, h),
                (roof_r, side * top, h),
            ],
            tx.CABIN,
            paint,
            look,
            [(0, 0), (1, 0), (1, 1), (0, 1)],
        )
    for x0, x1 in ((base_f, roof_f), (base_r, roof_r)):
        b.face(
            [(x0, -inner, belt), (x0, inner, belt), (x1, top, h), (x1, -top, h)],
            tx.CABIN,
            (0.14, 0.15, 0.17),
            look,
            [(0.08, 0.05), (0.44, 0.05), (0.44, 0.95), (0.08, 0.95)],
        )
    b.face([(roof_r, -top, h), (roof_f, -top, h), (roof_f, top, h), (roof_r, top, h)], tx.METAL, paint)
    for side in (-1.0, 1.0):
        lo, hi = side * (w - 0.38), side * (w - 0.04)
        b.face(
            [(f + 0.004, lo, 0.56), (f + 0.004, hi, 0.56), (f - 0.05, hi, 0.70), (f - 0.05, lo, 0.70)],
            tx.GLOW,
            HEAD_LIGHT,
        )
        b.face(
            [(r - 0.006, lo, 0.60), (r - 0.006, hi, 0.60), (r + 0.02, hi, 0.82), (r + 0.02, lo, 0.82)],
            tx.GLOW,
            TAIL_LIGHT,
        )
        b.box((base_f - 0.15, side * (w + 0.08), belt + 0.06), (0.12, 0.16, 0.13), tx.METAL, paint)
    for x in (f + 0.006, r - 0.008):
        b.face([(x, -0.26, 0.42), (x, 0.26, 0.42), (x, 0.26, 0.53), (x, -0.26, 0.53)], tx.GLOW, PLATE)
    b.face(
        [(f + 0.004, -0.5, 0.57), (f + 0.004, 0.5, 0.57), (f - 0.04, 0.5, 0.67), (f - 0.04, -0.5, 0.67)],
        tx.DARK,
        (0.06, 0.06, 0.06),
    )
    b.face([(r + 0.1, -w, 0.2), (f - 0.1, -w, 0.2), (f - 0.1, w, 0.2), (r + 0.1, w, 0.2)], tx.DARK, (0.04, 0.04, 0.04))
    _ground_shade(b, length, width)
    _wheels(b, (f - 0.85, r + 0.85), w, 0.33)
    return b.mesh()


@lru_cache(maxsize=128)
def _truck(length: float, width: float, height: float, look: int) -> Mesh:
    b = Builder()
    paint = _pick(CAR_PAINT, look)
    f, r, w = length / 2, -length / 2, width / 2
    cab = f - 1.9
    b.box(((cab + f) / 2, 0.0, 1.0), (1.9, width * 0.92, 1.1), tx.METAL, paint)
    b.box(((cab + f) / 2 - 0.05, 0.0, 1.95), (1.8, width * 0.92, 0.8), tx.CABIN, paint, look, 0.92)
    b.face(
        [(f - 0.02, w * 0.8, 1.5), (f - 0.02, -w * 0.8, 1.5), (f - 0.11, -w * 0.76, 2.25), (f - 0.11, w * 0.76, 2.25)],
        tx.CABIN,
        (0.14, 0.15, 0.17),
        look,
        [(0.08, 0.05), (0.44, 0.05), (0.44, 0.95), (0.08, 0.95)],
    )
    box_r, box_f = r, cab - 0.15
    for side in (-1.0, 1.0):
        b.face(
            [(box_r, side * w, 0.85), (box_f, side * w, 0.85), (box_f, side * w, height), (box_r, side * w, height)],
            tx.CARGO,
            paint,
            look,
        )
        b.face(
            [
                (f + 0.004, side * (w - 0.5), 0.62),
                (f + 0.004, side * (w - 0.15), 0.62),
                (f + 0.004, side * (w - 0.15), 0.85),
                (f + 0.004, side * (w - 0.5), 0.85),
            ],
            tx.GLOW,
            HEAD_LIGHT,
        )
        b.face(
            [
                (r - 0.006, side * (w - 0.3), 0.9),
                (r - 0.006, side * (w - 0.08), 0.9),
                (r - 0.006, side * (w - 0.08), 1.2),
                (r - 0.006, side * (w - 0.3), 1.2),
            ],
            tx.GLOW,
            TAIL_LIGHT,
        )
    for x in (box_r, box_f):
        b.face([(x, -w, 0.85), (x, w, 0.85), (x, w, height), (x, -w, height)], tx.CARGO, paint, look)
    b.face(
        [(box_r, -w, height), (box_f, -w, height), (box_f, w, height), (box_r, w, height)], tx.METAL, (0.8, 0.8, 0.8)
    )
    b.box((0.0, 0.0, 0.68), (length * 0.94, width * 0.5, 0.36), tx.DARK, (0.07, 0.07, 0.07))
    _ground_shade(b, length, width)
    _wheels(b, (f - 1.0, r + 1.3), w - 0.02, 0.45)
    return b.mesh()


@lru_cache(maxsize=64)
def _bus(length: float, width: float, height: float, look: int) -> Mesh:
    b = Builder()
    paint = ((0.72, 0.12, 0.10), (0.10, 0.30, 0.55), (0.80, 0.66, 0.12))[look % 3]
    f, r, w = length / 2, -length / 2, width / 2
    corners = [(f, w), (r, w), (r, -w), (f, -w)]
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        b.face([(x0, y0, 0.3), (x1, y1, 0.3), (x1, y1, height), (x0, y0, height)], tx.BUS_SIDE, paint, look)
    b.face([(r, -w, height), (f, -w, height), (f, w, height), (r, w, height)], tx.METAL, (0.85, 0.85, 0.84))
    for side in (-1.0, 1.0):
        for x, light in ((f + 0.006, HEAD_LIGHT), (r - 0.006, TAIL_LIGHT)):
            lo, hi = side * (w - 0.45), side * (w - 0.12)
            b.face([(x, lo, 0.6), (x, hi, 0.6), (x, hi, 0.85), (x, lo, 0.85)], tx.GLOW, light)
    _ground_shade(b, length, width)
    _wheels(b, (f - 2.4, r + 3.0), w, 0.48)
    return b.mesh()


@lru_cache(maxsize=1024)
def _person(look: int, phase: int) -> Mesh:
    """A walker, 1.75 m; legs and arms swing with `phase` in sixteenths of a stride."""
    b = Builder()
    shirt, trousers = _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
    skin = ((0.80, 0.62, 0.50), (0.55, 0.38, 0.28), (0.70, 0.52, 0.40), (0.36, 0.24, 0.18))[look % 4]
    swing = 0.32 * np.sin(2 * np.pi * phase / 16)
    for side, s in ((-1.0, swing), (1.0, -swing)):
        foot = (s, side * 0.10, 0.08)
        b.tube((0.0, side * 0.10, 0.90), foot, 0.09, tx.CLOTH, trousers, look, 6, 0.75)
        b.box((s + 0.05, side * 0.10, 0.05), (0.27, 0.10, 0.10), tx.DARK, (0.1, 0.09, 0.08))
        b.tube((0.0, side * 0.22, 1.42), (-s * 0.8, side * 0.25, 0.88), 0.055, tx.CLOTH, shirt, look, 5)
    b.box((0.0, 0.0, 1.17), (0.24, 0.40, 0.62), tx.CLOTH, shirt, look, 0.95)
    _head(b, 0.0, 1.60, skin, look)
    return b.mesh()


def _head(b: Builder, x: float, z: float, skin: tuple[float, float, float], look: int) -> None:
    hair = ((0.10, 0.07, 0.05), (0.30, 0.20, 0.10), (0.05, 0.05, 0.05), (0.50, 0.42, 0.30))[look // 4 % 4]
    b.tube((x, 0.0, z - 0.14), (x, 0.0, z + 0.02), 0.085, tx.CLOTH, skin, look, 8, 1.15)
    b.tube((x, 0.0, z + 0.02), (x, 0.0, z + 0.14), 0.10, tx.CLOTH, hair, look, 8, 0.45)


@lru_cache(maxsize=1024)
def _cyclist(look: int, phase: int) -> Mesh:
    """A rider on a bicycle; pedals turn with `phase`."""
    b = Builder()
    shirt, trousers = _pick(CLOTHES, look), _pick(CLOTHES, look // 8 + 2)
    frame = _pick(CAR_PAINT, look + 3)
    skin = ((0.80, 0.62, 0.50), (0.55, 0.38, 0.28), (0.70, 0.52, 0.40), (0.36, 0.24, 0.18))[look % 4]
    for x in (-0.52, 0.52):
        b.disc(np.array([x, 0.0, 0.345]), np.array([0.0, 1.0, 0.0]), 0.345, tx.SPOKES, (0.08, 0.08, 0.08), sides=14)
    for foot, head in (
        ((-0.52, 0, 0.345), (-0.1, 0, 0.85)),
        ((-0.05, 0, 0.3), (0.42, 0, 0.85)),
        ((-0.15, 0, 0.8), (0.42, 0, 0.82)),
        ((-0.05, 0, 0.3), (-0.18, 0, 0.9)),
        ((0.52, 0, 0.345), (0.40, 0, 1.0)),
    ):
        b.tube(foot, head, 0.022, tx.METAL, frame, sides=5)
    b.tube((0.38, -0.28, 1.0), (0.38, 0.28, 1.0), 0.02, tx.DARK, (0.1, 0.1, 0.1), sides=5)
    turn = 2 * np.pi * phase / 16
    for side, s in ((-1.0, 0.0), (1.0, np.pi)):
        pedal = (-0.02 + 0.17 * np.cos(turn + s), side * 0.12, 0.32 + 0.17 * np.sin(turn + s))
        knee = (0.22, side * 0.11, 0.72 + 0.08 * np.sin(turn + s))
        b.tube((-0.16, side * 0.09, 0.95), knee, 0.085, tx.CLOTH, trousers, look, 6)
        b.tube(knee, pedal, 0.06, tx.CLOTH, trousers, look, 6)
        b.tube((0.12, side * 0.20, 1.38), (0.38, side * 0.25, 1.02), 0.05, tx.CLOTH, shirt, look, 5)
    b.tube((-0.18, 0.0, 0.92), (0.12, 0.0, 1.42), 0.17, tx.CLOTH, shirt, look, 7)
    _head(b, 0.2, 1.60, skin, look)
    return b.mesh()
