"""Random small maps: overlapping, nested, adjoining and sliver-like polygons with holes, exact or crooked."""

import numpy as np
import shapely
from hypothesis import strategies as st

from tasks.world.road_map import MapLayer, MapPolygon

LAYERS = tuple(MapLayer)


def star(rng: np.random.Generator, center: np.ndarray, radius: float, step: float) -> np.ndarray:
    """A closed ring around a centre, snapped to multiples of `step` (0: not at all)."""
    n = int(rng.integers(3, 12))
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, n))
    reach = radius * rng.uniform(0.4, 1.0, n)
    ring = center + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if step:
        ring = np.round(ring / step) * step
    return np.concatenate([ring, ring[:1]])[:: rng.choice([-1, 1])]


def strip(rng: np.random.Generator, center: np.ndarray, radius: float, step: float) -> np.ndarray:
    """A lane-like quadrilateral, sometimes next to no width."""
    width = rng.choice([3.5, 3.5, 1.0, 1e-3, 1e-7])
    angle = rng.choice([0.0, np.pi / 2.0, rng.uniform(-4.0, 4.0)])
    ahead = np.array([np.cos(angle), np.sin(angle)])
    side = np.array([-ahead[1], ahead[0]]) * width
    ring = center + np.stack([-radius * ahead, radius * ahead, radius * ahead + side, -radius * ahead + side])
    if step:
        ring = np.round(ring / step) * step
    return np.concatenate([ring, ring[:1]])


def polygon(rng: np.random.Generator, token: str, radius: float, step: float) -> MapPolygon | None:
    """One polygon, None when it came out invalid."""
    center = np.round(rng.uniform(-25.0, 25.0, 2) * 2.0) / 2.0
    ring = star(rng, center, radius, step) if rng.random() < 0.6 else strip(rng, center, radius, step)
    holes = [star(rng, center, radius / 4.0, step) for _ in range(int(rng.random() < 0.4))]
    if not shapely.Polygon(ring, holes).is_valid:
        holes = []
    if not shapely.Polygon(ring).is_valid:
        return None
    return MapPolygon(token, LAYERS[rng.integers(len(LAYERS))], ring, tuple(holes))


def halves(rng: np.random.Generator, whole: MapPolygon, step: float) -> list[MapPolygon]:
    """A quadrilateral beside each edge of a polygon, sharing that edge."""
    found = []
    for i in range(len(whole.ring) - 1):
        a, b = whole.ring[i : i + 2]
        out = np.array([b[1] - a[1], a[0] - b[0]]) / 4.0
        if step:
            out = np.round(out / step) * step
        ring = np.stack([a, b, b + out, a + out, a])
        if shapely.Polygon(ring).is_valid:
            found.append(MapPolygon(f"{whole.token}_{i}", LAYERS[rng.integers(len(LAYERS))], ring))
    return found


@st.composite
def small_maps(draw: st.DrawFn, step: float | None = None) -> list[MapPolygon]:
    """Up to 90 valid polygons within some 60 m; step: of their coordinates [m], None: drawn, 0: none."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if step is None:
        step = draw(st.sampled_from([0.0, 0.0, 0.25, 1.0]))
    found: list[MapPolygon] = []
    for i in range(draw(st.sampled_from([0, 1, 2, 5, 20, 70]))):
        made = polygon(rng, f"p{i}", float(rng.choice([2.0, 8.0, 30.0])), step)
        if made is None:
            continue
        found.append(made)
        if rng.random() < 0.2:  # the same rings play another part too
            found.append(MapPolygon(f"again{i}", LAYERS[rng.integers(len(LAYERS))], made.ring, made.holes))
        if rng.random() < 0.2:
            found += halves(rng, made, step)
    return found
