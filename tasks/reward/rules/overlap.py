"""Oriented boxes in the plane, one pair at a time: whether they touch, and where their centroid is."""

import math
from typing import NamedTuple

from tasks.kernels.compiled import kernel

ROUNDING_M = 1e-6  # rounding moves the gap between two boxes by less, for coordinates below a million kilometres


class Box(NamedTuple):
    """A rectangle."""

    x: float  # of its centre [m]
    y: float
    heading: float  # [rad]
    cos: float  # of the heading
    sin: float
    length: float  # along the heading [m]
    width: float


@kernel
def apart(first: Box, second: Box) -> bool:
    """Whether two boxes are clear of each other by more than rounding.

    True only where `touching` is False, and nearly always then; without trigonometry.
    """
    dx, dy = second.x - first.x, second.y - first.y
    c = abs(first.cos * second.cos + first.sin * second.sin)
    s = abs(first.cos * second.sin - first.sin * second.cos)
    along1 = 2.0 * abs(first.cos * dx + first.sin * dy) - (first.length + second.length * c + second.width * s)
    across1 = 2.0 * abs(first.cos * dy - first.sin * dx) - (first.width + second.length * s + second.width * c)
    along2 = 2.0 * abs(second.cos * dx + second.sin * dy) - (second.length + first.length * c + first.width * s)
    across2 = 2.0 * abs(second.cos * dy - second.sin * dx) - (second.width + first.length * s + first.width * c)
    return max(max(along1, across1), max(along2, across2)) > ROUNDING_M


@kernel
def touching(first: Box, second: Box) -> bool:
    """Whether two boxes intersect, touching included (separating axes); False where one holds a NaN."""
    dx, dy = second.x - first.x, second.y - first.y
    turn = second.heading - first.heading  # not from the cosines: boxes that share an edge touch to the last bit
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    return (
        2.0 * abs(first.cos * dx + first.sin * dy) <= first.length + second.length * c + second.width * s
        and 2.0 * abs(first.cos * dy - first.sin * dx) <= first.width + second.length * s + second.width * c
        and 2.0 * abs(second.cos * dx + second.sin * dy) <= second.length + first.length * c + first.width * s
        and 2.0 * abs(second.cos * dy - second.sin * dx) <= second.width + first.length * s + first.width * c
    )


@kernel
def centroid(box: Box) -> tuple[float, float]:
    """Centroid of the box's polygon as GEOS computes it, rounding included.

    A fan of triangles from the first corner (FL, RL, RR, FR), each weighted by twice its area; a box without area has
    the mean of its edges weighted by their length, one without extent its centre.
    """
    half_length, half_width = box.length / 2.0, box.width / 2.0
    front_x, front_y = box.cos * half_length, box.sin * half_length
    left_x, left_y = -box.sin * half_width, box.cos * half_width
    xs = (box.x + front_x + left_x, box.x - front_x + left_x, box.x - front_x - left_x, box.x + front_x - left_x)
    ys = (box.y + front_y + left_y, box.y - front_y + left_y, box.y - front_y - left_y, box.y + front_y - left_y)
    total = sum_x = sum_y = 0.0
    for b, c in ((1, 2), (2, 3)):
        area = (xs[b] - xs[0]) * (ys[c] - ys[0]) - (xs[c] - xs[0]) * (ys[b] - ys[0])
        total += area
        sum_x += area * (xs[0] + xs[b] + xs[c])
        sum_y += area * (ys[0] + ys[b] + ys[c])
    if total != 0.0:
        return sum_x / 3.0 / total, sum_y / 3.0 / total
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        edge = math.sqrt((xs[b] - xs[a]) * (xs[b] - xs[a]) + (ys[b] - ys[a]) * (ys[b] - ys[a]))
        total += edge
        sum_x += edge * ((xs[a] + xs[b]) / 2.0)
        sum_y += edge * ((ys[a] + ys[b]) / 2.0)
    return (sum_x / total, sum_y / total) if total > 0.0 else (box.x, box.y)
