"""All that the fit has learned so far: plain arrays, to be stored and handed back."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tasks.kernels.compiled import kernel, numpy_division_kernel
from tasks.render.scene.body import BEFORE_M, BodyView, distance_before_bodies
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians, rotations_of
from tasks.render.splatting.gradient import Gradients
from tasks.world.arrays import F32, Array, Bools, FloatArray, Ints, ShortInts

# Adam (Kingma and Ba 2015) for rows of an array, each with a count of steps of its own.
#
# Only rows that a photo shows are stepped: what is out of sight keeps still, and its moments wait for it. The mean of
# gradients is short, 0.3 where usually 0.9: a row's next photo is another one, from elsewhere. On four data sets that
# brings 0.06 to 0.5 dB of held-out photos (docs/reconstruction.md).

BETA1, BETA2, EPSILON = 0.3, 0.999, 1e-15


@dataclass
class AdamArray:
    """An array that is learned, with its moments."""

    values: F32  # (N, C)
    first: F32  # (N, C) running mean of the gradient
    second: F32  # (N, C) running mean of its square
    steps: ShortInts  # (N,) how often each row was stepped

    @classmethod
    def unstepped(cls, values: FloatArray) -> "AdamArray":
        """Never stepped yet; `values` (N, C)."""
        start = np.array(values, np.float32, order="C")
        return cls(start, np.zeros_like(start), np.zeros_like(start), np.zeros(len(start), np.int32))

    def step(self, rows: Ints, gradient: F32, rate: float, scale: F32 | None = None) -> None:
        """Moves `rows` (M,), none twice, against `gradient` (M, C) by `rate`, times `scale` (M,) where given."""
        sizes = np.ones(len(rows), np.float32) if scale is None else scale
        unbiased = _unbiased(int(self.steps.max(initial=0) + 1).bit_length())
        adam_step(self.values, self.first, self.second, self.steps, rows, gradient, np.float32(rate), sizes, unbiased)

    def take(self, rows: Ints) -> "AdamArray":
        """The rows (M,), moments and all."""
        return AdamArray(self.values[rows], self.first[rows], self.second[rows], self.steps[rows])

    def forget(self, rows: Ints) -> None:
        """What `rows` are now has nothing to do with what they were."""
        self.first[rows], self.second[rows], self.steps[rows] = 0.0, 0.0, 0


@cache
def _unbiased(bits: int) -> F32:
    """(2^bits, 2) by the count of steps: what m and the root of v are multiplied by to lose their start's bias."""
    counts = np.maximum(np.arange(2**bits), 1)
    return np.stack([1.0 / (1.0 - BETA1**counts), 1.0 / np.sqrt(1.0 - BETA2**counts)], axis=1).astype(np.float32)


@numpy_division_kernel
def adam_step(
    values: Any, first: Any, second: Any, steps: Any, rows: Any, gradient: Any, rate: Any, sizes: Any, unbiased: Any
) -> None:
    """One step of `AdamArray`, in place: x -= rate size m / (sqrt(v) + eps), m and v without their start's bias."""
    keep1, keep2 = np.float32(BETA1), np.float32(BETA2)
    take1, take2, least = np.float32(1.0 - BETA1), np.float32(1.0 - BETA2), np.float32(EPSILON)
    for k in range(rows.shape[0]):
        i = rows[k]
        steps[i] += 1
        size, root = rate * sizes[k] * unbiased[steps[i], 0], unbiased[steps[i], 1]
        for c in range(values.shape[1]):
            g = gradient[k, c]
            m = keep1 * first[i, c] + take1 * g
            v = keep2 * second[i, c] + take2 * g * g
            first[i, c], second[i, c] = m, v
            values[i, c] -= size * m / (np.sqrt(v) * root + least)


# The road as lidar knows it: a smooth height field, and Gaussians that lie flat on it.
#
# Seen from one lane only, a road explains its photos just as well with paint that floats or stands; from a metre to
# the side that paint breaks. Road Gaussians therefore keep to the surface, thin, with their third axis along its
# normal.

CELL_M = 0.5
SMOOTH_CELLS = 1.5
BESIDE_M = 15.0  # how far from where the cameras were a road is looked for
BELOW_M = (0.8, 3.0)  # of the cameras
NEAR_PLANE_M = 0.12  # what is further from the local plane is no road
PLANE_REACH_M = 15.0
LEAST_POINTS = 30
ALONG_M = 4.0  # a plane is fitted about this often
SLACK_M = 0.02  # how far a road Gaussian may leave the lidar's surface
THICKNESS_M = 0.005  # of a road Gaussian
# Standard deviation: a rasteriser draws a Gaussian as it looks at its middle, and one that reaches from afar to beneath
# the camera hangs as a veil before what is above the horizon.
LONGEST_M = 0.8


@dataclass(frozen=True)
class Road:
    """Heights on a grid; NaN where no road is known."""

    corner: Array  # (2,) x, y of the first node [m]
    heights: Array  # (X, Y) [m], every CELL_M
    slopes: Array  # (X, Y, 2) d height / d x, d y


def fit_road(points: Array, eyes: Array) -> Road | None:
    """The road under the cameras: lidar `points` (M, 3), camera centres `eyes` (V, 3); None where there is none.

    Around each few metres of the way a plane is fitted to what lies below the cameras, and fitted again to what is
    near it; points near any plane make the height field.
    """
    points = points[np.argsort(points[:, 0], kind="stable")]
    on_road = np.zeros(len(points), bool)
    for eye in _spaced(eyes):
        reach = eye[0] + np.array([-1.0, 1.0]) * max(PLANE_REACH_M, BESIDE_M)
        first, last = np.searchsorted(points[:, 0], reach)  # of most streets a few
        east, north, height = (points[first:last, axis] - (eye[0], eye[1], 0.0)[axis] for axis in range(3))
        away, below = east * east + north * north, eye[2] - height
        looked_at = (away < PLANE_REACH_M**2) & (below > BELOW_M[0]) & (below < BELOW_M[1])
        plane = _plane(east[looked_at], north[looked_at], height[looked_at])
        if plane is not None:
            off = height - (plane[0] * east + plane[1] * north + plane[2])
            on_road[first:last] |= (away < BESIDE_M**2) & (np.abs(off) < NEAR_PLANE_M)
    if on_road.sum() < LEAST_POINTS:
        return None
    return _height_field(points[on_road])


def _spaced(eyes: Array) -> Sequence[Array]:
    kept = [eyes[0]]
    for eye in eyes:
        if np.linalg.norm(np.array(kept)[:, :2] - eye[:2], axis=1).min() >= ALONG_M:
            kept.append(eye)
    return kept


def _plane(east: Array, north: Array, height: Array) -> Array | None:
    """height = a east + b north + c, (3,), of points (M,) each, by trimmed least squares from the median on."""
    if len(height) < LEAST_POINTS:
        return None
    design = np.stack([east, north, np.ones(len(height))])
    plane = np.array([0.0, 0.0, float(np.median(height))])
    for limit in (0.6, 0.4, 0.25, 0.15, NEAR_PLANE_M):
        near = np.abs(height - plane @ design) < limit
        if near.sum() < LEAST_POINTS:
            return None
        kept = design[:, near]
        plane = np.linalg.lstsq(kept @ kept.T, kept @ height[near], rcond=None)[0]
    return np.asarray(plane)


def _height_field(points: Array) -> Road:
    corner = points[:, :2].min(axis=0) - 2.0 * CELL_M
    size = np.ceil((points[:, :2].max(axis=0) - corner) / CELL_M).astype(int) + 3
    cells = np.rint((points[:, :2] - corner) / CELL_M).astype(int)
    flat = cells[:, 0] * size[1] + cells[:, 1]
    count = np.bincount(flat, minlength=size.prod()).reshape(size).astype(float)
    base = float(points[:, 2].mean())
    total = np.bincount(flat, points[:, 2] - base, minlength=size.prod()).reshape(size)
    weight = gaussian_filter(count, SMOOTH_CELLS, mode="constant")
    known = weight > 0.02
    heights = np.where(known, gaussian_filter(total, SMOOTH_CELLS, mode="constant") / np.maximum(weight, 1e-9), np.nan)
    slope_x, slope_y = np.gradient(heights, CELL_M)
    slopes = np.stack([slope_x, slope_y], axis=-1)
    return Road(corner, np.where(np.isfinite(slopes).all(axis=-1), heights + base, np.nan), np.nan_to_num(slopes))


@kernel
def _interpolate_height(heights: Any, slopes: Any, corner: Any, x: float, y: float) -> Any:
    """Height and slopes at a place; NaN beyond the road."""
    u, v = (x - corner[0]) / CELL_M, (y - corner[1]) / CELL_M
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i + 1 >= heights.shape[0] or j + 1 >= heights.shape[1]:
        return np.nan, 0.0, 0.0
    a, b = u - i, v - j
    z, sx, sy = 0.0, 0.0, 0.0
    for side in range(4):
        p, q = i + side // 2, j + side % 2
        share = (a if side // 2 else 1.0 - a) * (b if side % 2 else 1.0 - b)
        z += share * heights[p, q]
        sx += share * slopes[p, q, 0]
        sy += share * slopes[p, q, 1]
    return z, sx, sy


@kernel
def _above(means: Any, heights: Any, slopes: Any, corner: Any) -> Any:
    out = np.empty(means.shape[0])
    for i in range(means.shape[0]):
        z, _, _ = _interpolate_height(heights, slopes, corner, means[i, 0], means[i, 1])
        out[i] = means[i, 2] - z
    return out


def height_above_road(means: FloatArray, road: Road) -> Array:
    """How far points (N, 3) lie above the road [m]; NaN beyond it."""
    return np.asarray(_above(means, road.heights, road.slopes, road.corner))


@kernel
def _first_below(eye: Any, rays: Any, lengths: Any, heights: Any, slopes: Any, corner: Any) -> Any:
    """Whether each of unit `rays` (M, 3) from `eye` is above the known road at one of `lengths` and not at the next."""
    found = np.zeros(rays.shape[0], np.bool_)
    for i in range(rays.shape[0]):
        over = False
        for length in lengths:
            x, y = eye[0] + length * rays[i, 0], eye[1] + length * rays[i, 1]
            off = eye[2] + length * rays[i, 2] - _interpolate_height(heights, slopes, corner, x, y)[0]
            if over and off <= 0.0:
                found[i] = True
                break
            over = off > 0.0
    return found


RAY_FROM_M, STEPS = 0.5, 60  # where a ray is followed from, and in how many steps


def rays_meet_road(road: Road, eye: Array, rays: Array, reach_m: float) -> Bools:
    """Which rays (M, 3) from `eye` (3,) go below the known road within `reach_m`, not where it is unknown."""
    unit, lengths = rays / np.linalg.norm(rays, axis=1, keepdims=True), np.geomspace(RAY_FROM_M, reach_m, STEPS)
    found = np.zeros(len(rays), bool)
    down = np.flatnonzero(unit[:, 2] * reach_m < np.nanmax(road.heights) - eye[2])  # others stay above all of it
    found[down] = _first_below(np.ascontiguousarray(eye), unit[down], lengths, road.heights, road.slopes, road.corner)
    return found


@kernel
def _lay(
    means: Any,
    quats: Any,
    log_scales: Any,
    rows: Any,
    heights: Any,
    slopes: Any,
    corner: Any,
    thick: float,
    longest: float,
) -> None:
    for k in range(rows.shape[0]):
        i = rows[k]
        z, sx, sy = _interpolate_height(heights, slopes, corner, means[i, 0], means[i, 1])
        if z != z:
            continue
        means[i, 2] = min(max(means[i, 2], z - SLACK_M), z + SLACK_M)
        for axis in range(3):
            log_scales[i, axis] = min(log_scales[i, axis], thick if axis == 2 else longest)
        # Turn the third axis onto the normal the shortest way: q' = (1 + a.n, a x n) q.
        w, x, y, s = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        length = np.sqrt(w * w + x * x + y * y + s * s)
        w, x, y, s = w / length, x / length, y / length, s / length
        ax, ay, az = 2.0 * (x * s + w * y), 2.0 * (y * s - w * x), 1.0 - 2.0 * (x * x + y * y)
        norm = 1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
        nx, ny, nz = -sx * norm, -sy * norm, norm
        if ax * nx + ay * ny + az * nz < 0.0:  # the other face of the disc
            nx, ny, nz = -nx, -ny, -nz
        tw, tx, ty, tz = 1.0 + ax * nx + ay * ny + az * nz, ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        norm = 1.0 / np.sqrt(tw * tw + tx * tx + ty * ty + tz * tz)
        tw, tx, ty, tz = tw * norm, tx * norm, ty * norm, tz * norm
        quats[i, 0] = tw * w - tx * x - ty * y - tz * s
        quats[i, 1] = tw * x + tx * w + ty * s - tz * y
        quats[i, 2] = tw * y - tx * s + ty * w + tz * x
        quats[i, 3] = tw * s + tx * y - ty * x + tz * w


def lay_flat(means: F32, quats: F32, log_scales: F32, rows: Ints, road: Road) -> None:
    """Puts Gaussians at `rows` onto the road, in place: at most SLACK_M off it, no thicker than THICKNESS_M and
    no longer than LONGEST_M, their third axis along its normal. Those beyond the road stay as they are."""
    _lay(means, quats, log_scales, rows, road.heights, road.slopes, road.corner, *np.log([THICKNESS_M, LONGEST_M]))


class LearnedArray(Protocol):
    """As `AdamArray`: an array that steps against a gradient."""

    @property
    def values(self) -> Any: ...

    def step(self, rows: Any, gradient: Any, rate: float, scale: Any = None) -> None: ...

    def forget(self, rows: Ints) -> None: ...


class LearnedState(Protocol):
    """As `FitState`: all that is learned, wherever it lies; owners, exposure, poses and boxes lie on the CPU."""

    iteration: int
    noted: int

    @property
    def learned(self) -> Mapping[str, LearnedArray]: ...

    @property
    def averages(self) -> dict[str, Any]: ...

    @property
    def owner(self) -> ShortInts: ...

    @property
    def wanted(self) -> Any: ...

    def record_view(self, rows: Any, depths: Any, screen: Any) -> Any: ...

    def step_gaussians(self, rows: Any, gradients: Gradients, rates: Mapping[str, float], depths: Any) -> None: ...

    def lay_flat(self, rows: Any, road: Road) -> None: ...

    def keep_round(self, rows: Any, background: float, boxes: float) -> None: ...

    def to_host(self, array: Any) -> F32: ...

    def street_before_bodies(
        self, views: Sequence[BodyView], least_opacity: float
    ) -> tuple[Ints, Array, F32, Array]: ...

    def put_copies(self, copies: "Copies") -> None: ...


BACKGROUND = -1
SHAPES = ("means", "quats", "log_scales", "logits", "colours")  # learned, one row per Gaussian
WORLD = ("sky", "exposure", "poses", "boxes")
PER_GAUSSIAN = ("owner", "road", "nearest", "wanted")  # fields of FitState
COUNTS = ("iteration", "noted")


@dataclass
class FitState:
    """N Gaussians, each in the frame of its owner; stepped in place.

    Of the world are learned: sky (cells, 3), exposure (photos, 12), poses (photos, 6), and boxes (tracks * knots, 4).
    """

    iteration: int
    learned: dict[str, AdamArray]  # SHAPES: (N, C); WORLD: see below
    owner: ShortInts  # (N,) ascending: BACKGROUND or row of a track
    road: Bools  # (N,) lies on the road
    nearest: F32  # (N,) [m] depth in the nearest photo so far; inf: not seen yet
    wanted: F32  # (N,) how much more of it was asked for since the density was last looked at
    averages: dict[str, F32] = field(default_factory=dict)  # of what is learned, by name; empty until it is noted
    noted: int = 0  # how often it was

    def __len__(self) -> int:
        return len(self.owner)

    def gaussians(self) -> Gaussians:
        """All of them, in the frames of their owners."""
        means, quats, log_scales, logits, colours = (self.learned[name].values for name in SHAPES)
        return Gaussians(means, quats, log_scales, opacities_of(logits[:, 0]), colours)

    def record_view(self, rows: Ints, depths: F32, screen: F32) -> F32:
        """Notes what a photo says of `rows` (M,): their depths (M,) in it, their derivatives (M, 2) by the place on it.

        Returns the nearest depths (M,) so far.
        """
        return np.asarray(_record_view(self.nearest, self.wanted, rows, depths, screen))

    def step_gaussians(self, rows: Ints, gradients: Gradients, rates: Mapping[str, float], depths: F32) -> None:
        """Moves `rows` (M,) against the gradients by them, by `rates` of SHAPES, means times `depths` (M,)."""
        for name in SHAPES:
            by = getattr(gradients, name).reshape(len(rows), -1)
            self.learned[name].step(rows, by, rates[name], depths if name == "means" else None)

    def lay_flat(self, rows: Ints, road: Road) -> None:
        """Those of `rows` (M,) that lie on the road stay on it."""
        means, quats, log_scales = (self.learned[name].values for name in ("means", "quats", "log_scales"))
        lay_flat(means, quats, log_scales, rows[self.road[rows]], road)

    def keep_round(self, rows: Ints, background: float, boxes: float) -> None:
        """Of those of `rows` (M,) that lie on no road, no side stays shorter than the longest by more than a factor.

        `background` and `boxes`: that factor of those of either, 0: none.
        """
        most = (np.float32(np.log(factor) if factor > 0.0 else np.inf) for factor in (background, boxes))
        _keep_round(self.learned["log_scales"].values, self.owner, self.road, rows, *most)

    def to_host(self, array: F32) -> F32:
        """An array of this state's kind, as numpy's: itself."""
        return array

    def street_before_bodies(self, views: Sequence[BodyView], least_opacity: float) -> tuple[Ints, Array, F32, Array]:
        """Gaussians of the street, not of its road, that hide more than `least_opacity` and of which some view shows
        that they stand by BEFORE_M or more before the body of a vehicle that drives.

        Their rows (M,), means (M, 3), colours (M, C), and least depth (M,) [m] of those views.
        """
        n = int(np.searchsorted(self.owner, BACKGROUND + 1))
        rows = np.flatnonzero(~self.road[:n] & (opacities_of(self.learned["logits"].values[:n, 0]) > least_opacity))
        means, least_m = self.learned["means"].values[rows].astype(np.float64), np.full(len(rows), np.inf)
        for view in views:
            before_m, depth_m = distance_before_bodies(means, view)
            least_m = np.where(before_m > BEFORE_M, np.minimum(least_m, depth_m), least_m)
        found = np.isfinite(least_m)
        return rows[found], means[found], self.learned["colours"].values[rows[found]], least_m[found]

    def put_copies(self, copies: "Copies") -> None:
        """As they are told."""
        named, targets = copies.named, copies.targets
        self.learned["logits"].values[named, 0] = copies.logits
        self.learned["log_scales"].values[named] += copies.log_shrink[:, None]
        self.keep_rows(copies.rows)
        quats = self.learned["quats"].values[targets]
        turns = rotations_of(quats / np.linalg.norm(quats, axis=1, keepdims=True))
        local = copies.normals * np.exp(self.learned["log_scales"].values[targets])
        self.learned["means"].values[targets] += JITTER * np.einsum("nij,nj->ni", turns, local).astype(np.float32)
        for name in SHAPES:
            self.learned[name].forget(np.concatenate([named, targets]))
        self.keep_rows(copies.order)

    def apply_average(self, road: Road | None) -> None:
        """Puts everything where it was on average, on the road as well."""
        for name, average in self.averages.items():
            self.learned[name].values[:] = average
        if road is not None:
            self.lay_flat(np.arange(len(self)), road)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """By name, for whoever stores them."""
        out: dict[str, NDArray[np.generic]] = {
            f"{name}.{each.name}": getattr(learned, each.name)
            for name, learned in self.learned.items()
            for each in fields(AdamArray)
        }
        out |= {f"{name}.average": average for name, average in self.averages.items()}
        out |= {name: np.array(getattr(self, name)) for name in COUNTS}
        return out | {name: getattr(self, name) for name in PER_GAUSSIAN}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "FitState":
        """The state that `arrays` gave, as a copy of its own. Raises KeyError where one is missing."""
        learned = {
            name: AdamArray(*(np.array(arrays[f"{name}.{each.name}"]) for each in fields(AdamArray)))
            for name in SHAPES + WORLD
        }
        owner, road, nearest, wanted = (np.array(arrays[name]) for name in PER_GAUSSIAN)
        iteration, noted = (int(arrays[name]) for name in COUNTS)
        averages = {name: np.array(arrays[f"{name}.average"], np.float32) for name in (learned if noted else ())}
        return cls(iteration, learned, owner, road, nearest, wanted, averages, noted)

    def keep_rows(self, rows: Ints) -> None:
        """Keeps these Gaussians, in this order; one may be named again and again."""
        for name in SHAPES:
            self.learned[name] = self.learned[name].take(rows)
        for name in PER_GAUSSIAN:
            setattr(self, name, getattr(self, name)[rows])


def add_to_average(held: LearnedState) -> None:
    """Takes what is learned now into its average. Rows must not be moved from the first time on."""
    held.noted += 1
    for name, learned in held.learned.items():
        values = learned.values * 1.0
        average = held.averages.setdefault(name, values * 0.0)
        if name == "quats":  # which, negated, turn the same way
            turned = (average * values).sum(axis=1) < 0.0
            values[turned] = -values[turned]
        average += (values - average) / float(held.noted)


@kernel
def _record_view(nearest: Any, wanted: Any, rows: Any, depths: Any, screen: Any) -> Any:
    out = np.empty(rows.shape[0], np.float32)
    for k in range(rows.shape[0]):
        i, u, v = rows[k], screen[k, 0], screen[k, 1]
        nearest[i] = min(nearest[i], depths[k])
        wanted[i] += np.sqrt(u * u + v * v)
        out[k] = nearest[i]
    return out


@kernel
def _keep_round(log_scales: Any, owner: Any, road: Any, rows: Any, background: Any, boxes: Any) -> None:
    """Raises the shorter sides of `rows` to the longest less `background` or `boxes`, all of them logarithms."""
    for k in range(rows.shape[0]):
        i = rows[k]
        if owner[i] == BACKGROUND and road[i]:
            continue
        least = max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        least -= background if owner[i] == BACKGROUND else boxes
        for axis in range(3):
            log_scales[i, axis] = max(log_scales[i, axis], least)


def opacities_of(logits: F32) -> F32:
    """Opacities (N,) in (0, 1)."""
    return (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)


def logits_of(opacities: FloatArray) -> F32:
    """The inverse of `opacities_of`."""
    return np.log(opacities / (1.0 - opacities)).astype(np.float32)


# Where Gaussians are needed: relocation and growth of 3DGS-MCMC (Kheradmand et al. 2024).
#
# A Gaussian that became transparent is put on top of one that matters, and the number grows by a share until it is
# full. Both of a pair are made weaker and narrower so that the picture stays the same (their equation 9).

MOST_COPIES = 51  # of one Gaussian at once, as in the authors' code
LEAST_OPACITY = 0.005
DEAD_OPACITY = 0.01  # below which a Gaussian is moved elsewhere
JITTER = 0.5  # how far from its source a copy is put, in standard deviations of it


@dataclass(frozen=True)
class Copies:
    """Which Gaussians are copied where; M copies of K Gaussians."""

    named: Ints  # (K,) the rows that are copied
    logits: F32  # (K,) of their opacities from then on
    log_shrink: F32  # (K,) that their logarithmic scales gain
    rows: Ints  # (N',) which row each row is then a copy of; those beyond the last are new
    targets: Ints  # (M,) the rows that copies are put at
    normals: Array  # (M, 3) how far from their sources, in standard deviations over JITTER
    order: Ints  # (N',) of the rows afterwards


def relocate_and_grow(held: LearnedState, settings: FitSettings) -> None:
    """Relocates and grows, in place; a function of seed and iteration alone."""
    rng, n = np.random.Generator(np.random.Philox(key=[settings.seed, 2**32 + held.iteration])), len(held.owner)
    opacities = opacities_of(held.to_host(held.learned["logits"].values[:, 0])).astype(np.float64)
    dead = opacities < DEAD_OPACITY
    weight = np.where(dead, 0.0, opacities * held.to_host(held.wanted))
    if weight.sum() > 0.0:
        free = np.flatnonzero(dead)
        n_new = max(min(settings.most_gaussians, int(n * (1.0 + settings.growth))) - n, 0)
        sources = rng.choice(n, len(free) + n_new, p=weight / weight.sum())
        if len(sources):
            held.put_copies(_copies(held.owner, opacities, np.concatenate([free, n + np.arange(n_new)]), sources, rng))
    held.wanted[:] = 0.0


def _copies(owner: ShortInts, opacities: Array, targets: Ints, sources: Ints, rng: np.random.Generator) -> Copies:
    """Of `sources`, at the rows `targets` (M,)."""
    named, counts = np.unique(sources, return_counts=True)
    shared, shrink = split_opacity(opacities[named], counts + 1)
    rows = np.arange(max(len(owner), int(targets.max()) + 1))
    rows[targets] = sources
    return Copies(
        named,
        logits_of(np.maximum(shared, LEAST_OPACITY)),
        np.log(shrink).astype(np.float32),
        rows,
        targets,
        rng.standard_normal((len(targets), 3)),
        np.argsort(owner[rows], kind="stable"),
    )


@kernel
def _shrink(opacity: float, shared_opacity: float, n: int) -> float:
    total = 0.0
    for i in range(1, n + 1):
        binomial = 1.0
        for k in range(i):
            total += binomial * (-1.0) ** k * shared_opacity ** (k + 1) / math.sqrt(k + 1.0)
            binomial *= (i - 1 - k) / (k + 1.0)
    return opacity / total


@kernel
def split_opacity(opacities: Array, counts: Ints) -> tuple[Array, Array]:
    """Opacity and factor of the scales, (N,) each, of each of `counts` Gaussians that together show what one did."""
    out, shrink = np.empty(len(opacities)), np.empty(len(opacities))
    for i in range(len(opacities)):
        n = min(counts[i], MOST_COPIES)
        out[i] = 1.0 - (1.0 - opacities[i]) ** (1.0 / n)
        shrink[i] = _shrink(opacities[i], out[i], n)
    return out, shrink
