"""A vocabulary: K human trajectories of 4 s in the ego frame, and how one is picked from many windows."""

import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import Array, Indices
from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import HEADING, to_local

OF_LOG = -1  # stands for the log itself where a trajectory has its row in the vocabulary
FIRST_START = -2  # for the first of a clip's own start states; -3 for the second ...
MOST_LLOYD_STEPS = 30  # fewer when no window changes its centre
CHUNK_ROWS = 4096  # windows whose distances to all centres are held at once: 4096 x 8192 x 8 B = 0.27 GB


def trajectories_digest(trajectories: Array) -> str:
    """16 hex digits of a (K, 40, 3) float64 array: its shape and its bytes, little-endian."""
    sha = hashlib.sha256(repr(trajectories.shape).encode())
    sha.update(np.ascontiguousarray(trajectories, dtype="<f8").tobytes())
    return sha.hexdigest()[:16]


def checked_trajectories(values: NDArray[np.generic], source: str) -> Array:
    """`values` as float64 (K, 40, 3). Raises ValueError that names `source` and what is wrong with it."""
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"{source}: trajectories are {values.dtype}, expected a floating point type")
    if values.ndim != 3 or values.shape[1:] != (HORIZON_STEPS, 3) or len(values) == 0:
        raise ValueError(f"{source}: trajectories have shape {values.shape}, expected (K >= 1, {HORIZON_STEPS}, 3)")
    trajectories = values.astype(np.float64)
    broken = np.flatnonzero(~np.isfinite(trajectories).all(axis=(1, 2)))
    if len(broken):
        raise ValueError(f"{source}: {len(broken)} trajectories hold NaN or infinity, the first is number {broken[0]}")
    return trajectories


@dataclass(frozen=True)
class Vocabulary:
    """K trajectories: x [m], y [m], heading [rad] in the ego frame at 0.1 .. 4.0 s.

    Raises ValueError on a wrong shape or type and on values that are not finite.
    """

    trajectories: Array  # (K, 40, 3)
    source: str = "vocabulary"  # for messages only
    digest: str = field(init=False)  # 16 hex digits of the trajectories

    def __post_init__(self) -> None:
        trajectories = checked_trajectories(np.asarray(self.trajectories), self.source)
        trajectories.setflags(write=False)
        object.__setattr__(self, "trajectories", trajectories)
        object.__setattr__(self, "digest", trajectories_digest(trajectories))

    def __len__(self) -> int:
        return len(self.trajectories)


def human_windows(ego_states: Array, starts: Indices) -> Array:
    """What the driver of `ego_states` (S, 11) did in the 4 s after each of `starts`, (W, 40, 3) in the ego frame there.

    Raises ValueError where a window reaches beyond the last state.
    """
    if len(starts) and int(starts.max()) + HORIZON_STEPS >= len(ego_states):
        raise ValueError(f"a window from step {int(starts.max())} needs {HORIZON_STEPS} more of {len(ego_states)}")
    poses = ego_states[:, : HEADING + 1]
    windows = [to_local(poses[start], poses[start + 1 : start + 1 + HORIZON_STEPS]) for start in starts]
    return np.array(windows).reshape(-1, HORIZON_STEPS, 3)


def cluster(windows: Array, k: int, seed: int) -> Array:
    """The k windows (k, 40, 3) that stand for all (N, 40, 3), in their order: k-means on the (x, y) courses.

    Each centre is replaced by its nearest window, because a mean of drives need not be drivable. seed: of the k-means++
    start (Philox). Raises ValueError for fewer than k distinct windows.
    """
    windows = checked_trajectories(windows, "windows to cluster")
    points = windows[:, :, :2].reshape(len(windows), -1)
    distinct = len(np.unique(points, axis=0))
    if not 1 <= k <= distinct:
        raise ValueError(f"k = {k} trajectories cannot be chosen from {distinct} distinct windows")
    centers = points[_spread_start(points, k, seed)]
    owner = np.full(len(points), -1)
    for _ in range(MOST_LLOYD_STEPS):
        nearest, _ = _nearest_center(points, centers)
        if np.array_equal(nearest, owner):
            break
        owner = nearest
        sums = np.zeros_like(centers)
        np.add.at(sums, owner, points)
        members = np.bincount(owner, minlength=k)
        kept = members > 0  # an emptied centre stays where it is
        centers[kept] = sums[kept] / members[kept, None]
    return windows[_one_window_each(points, centers)]


def _spread_start(points: Array, k: int, seed: int) -> Indices:
    """k-means++ (Arthur and Vassilvitskii 2007): each next start is drawn with probability ~ squared distance."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    chosen = [int(rng.integers(len(points)))]
    distance = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < k:
        mass = np.cumsum(distance)
        pick = min(int(np.searchsorted(mass, rng.random() * mass[-1], side="right")), len(points) - 1)
        chosen.append(pick)
        distance = np.minimum(distance, ((points - points[pick]) ** 2).sum(axis=1))
    return np.array(chosen)


def _nearest_center(points: Array, centers: Array) -> tuple[Indices, Array]:
    """Index of each point's nearest centre (the first of equals) and the squared distance to it."""
    owner = np.empty(len(points), dtype=np.intp)
    distance = np.empty(len(points))
    norms = (centers**2).sum(axis=1)
    for start in range(0, len(points), CHUNK_ROWS):
        rows = points[start : start + CHUNK_ROWS]
        squared = norms - 2.0 * rows @ centers.T
        owner[start : start + CHUNK_ROWS] = squared.argmin(axis=1)
        distance[start : start + CHUNK_ROWS] = squared.min(axis=1) + (rows**2).sum(axis=1)
    return owner, distance


def _one_window_each(points: Array, centers: Array) -> Indices:
    """A different window for every centre: the nearest of its own members, for an empty centre the nearest left."""
    owner, distance = _nearest_center(points, centers)
    order = np.lexsort((distance, owner))
    first = order[np.unique(owner[order], return_index=True)[1]]
    taken = np.zeros(len(points), dtype=bool)
    taken[first] = True
    for center in np.setdiff1d(np.arange(len(centers)), owner):
        to_center = np.where(taken, np.inf, ((points - centers[center]) ** 2).sum(axis=1))
        taken[int(to_center.argmin())] = True
    return np.flatnonzero(taken)


# A vocabulary without data: trajectories of a point on a curve with random speeds, accelerations and curvatures.
#
# For the synthetic town and for first looks, where no file of clustered human trajectories is at hand. Real runs name
# a file of human trajectories or build one from their own TRAIN clips.

MAX_SPEED_MPS = 18.0
ACCEL_STD_MPS2 = 1.0  # of the one-second pieces
LATERAL_ACCEL_MAX_MPS2 = 2.5
CURVATURE_MAX_1PM = 0.12  # about the turning circle of a large car
STRAIGHT_SHARE = 0.4  # most human driving is nearly straight: those draw a tenth of the curvature


def kinematic_trajectories(k: int, seed: int) -> Array:
    """(k, 40, 3) x [m], y [m], heading [rad] in the ego frame at 0.1 .. 4.0 s; equal (k, seed) give equal numbers.

    Speed: uniform start, acceleration constant over each second, never below 0. Curvature: linear between knots at
    whole seconds, bounded by the turning circle and by the lateral acceleration. x' = v cos(heading),
    y' = v sin(heading), heading' = v * curvature, integrated at the step's middle.
    """
    rng = np.random.Generator(np.random.Philox(key=np.uint64(seed)))
    seconds = int(HORIZON_STEPS * STEP_S)
    start_speed = rng.uniform(0.0, MAX_SPEED_MPS, k)
    accel = np.repeat(rng.normal(0.0, ACCEL_STD_MPS2, (k, seconds)), HORIZON_STEPS // seconds, axis=1)
    knots = rng.normal(0.0, 0.4, (k, seconds + 1)) * np.where(rng.random((k, 1)) < STRAIGHT_SHARE, 0.1, 1.0)

    speed = np.empty((k, HORIZON_STEPS + 1))
    speed[:, 0] = start_speed
    for step in range(HORIZON_STEPS):
        speed[:, step + 1] = np.clip(speed[:, step] + accel[:, step] * STEP_S, 0.0, MAX_SPEED_MPS)
    middle_speed = (speed[:, 1:] + speed[:, :-1]) / 2.0

    at = (np.arange(HORIZON_STEPS) + 0.5) * STEP_S
    left = np.minimum(at.astype(int), seconds - 1)
    share = at - left
    unit = knots[:, left] * (1.0 - share) + knots[:, left + 1] * share
    bound = np.minimum(CURVATURE_MAX_1PM, LATERAL_ACCEL_MAX_MPS2 / np.maximum(middle_speed, 0.1) ** 2)
    curvature = np.clip(unit, -1.0, 1.0) * bound

    turn = curvature * middle_speed * STEP_S
    heading = np.cumsum(turn, axis=1)
    along = heading - turn / 2.0
    x = np.cumsum(middle_speed * np.cos(along) * STEP_S, axis=1)
    y = np.cumsum(middle_speed * np.sin(along) * STEP_S, axis=1)
    return np.stack([x, y, heading], axis=-1)
