"""A vocabulary: K human trajectories of 4 s in the ego frame, and how one is picked from many windows."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import Array, FloatArray, Indices
from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import HEADING, to_local, wrap_angle

OF_LOG = -1  # stands for the log itself where a trajectory has its row in the vocabulary
FIRST_START = -2  # for the first of a clip's own start states; -3 for the second ...
MOST_LLOYD_STEPS = 30  # fewer when no window changes its centre
STRIP_M = 4.0  # as wide as a lane
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


# What a file of another meaning is given away by: it has the same shape, and its numbers are finite.
#
# Each sign is a median or a quantile over the trajectories that move, so that single odd ones (a car that reverses, a
# tracker's jump) refuse no file. The numbers beside the limits are those of three sets, from the least to the most:
# 8,192 clustered human trajectories (GTRS), 2,000 kinematic ones, the windows of nine logs (Argoverse 2, nuScenes).
# No sign tells a set that is mirrored together with its headings, 2 s in 40 rows, and one that never moves a metre.

MOVING_MPS = 1.0
MOVING_SHARE = 0.25  # of the rows of a trajectory that says anything
FIRST_STEP = (0.5, 1.5)  # over the mean of the three after it; 1.0
SIDEWAYS_RAD = 0.8  # from x to where motion begins; 0.0
TURN_RAD = 0.2  # of the motion over a trajectory that tells how headings turn
LEAST_TURNING = 3  # trajectories; else all that move are looked at
OFF_MOTION_RAD = 0.1  # of headings, where trajectories turn; 0 to 0.05
TOP_SPEED_MPS = 40.0  # of a tenth of them; 12 to 17
VELOCITY_S = 0.5  # over which a velocity is taken
CHANGE_MPS = (
    3.0  # of the velocity within a second, of a tenth of them; 1.7 to 2.0, and 5.9 where 40 rows of logs hold 8 s
)
LEAST_DRIVES = 20  # whose tenth says anything of how people drive


def refuse_other_meaning(trajectories: FloatArray, source: str, human: bool = True) -> None:
    """Raises ValueError that names `source`, what gives away that its numbers mean something else, and what helps.

    trajectories: finite (K, N, 3) x [m], y [m], heading [rad] at 4 s / N .. 4 s, or (K, N, 2) without headings.
    human: they are driven as people drive, and are no states of anybody's choice.
    """
    values = np.asarray(trajectories, np.float64)
    step_s = HORIZON_STEPS * STEP_S / values.shape[1]
    places = np.pad(values[..., :2], ((0, 0), (1, 0), (0, 0)))  # from the start
    moved = np.diff(places, axis=1)
    moves = np.hypot(moved[..., 0], moved[..., 1]) > MOVING_MPS * step_s
    moves[:, 0] = False  # the step from the start may be the very fault
    drives = moves.mean(axis=1) >= MOVING_SHARE
    if not drives.any():
        return
    places, moved, moves = places[drives], moved[drives], moves[drives]
    sign = _first_row_sign(places, moved, step_s) or _start_sign(moved, moves)
    if not sign and values.shape[2] == 3:
        sign = _heading_sign(values[drives, :, 2], moved[:, 1:], moves[:, 1:])
    if sign := sign or _speed_sign(places, step_s, human):
        raise ValueError(f"{source}: {sign}")


def _first_row_sign(places: Array, moved: Array, step_s: float) -> str | None:
    lengths = np.hypot(moved[..., 0], moved[..., 1])
    after = lengths[:, 1:4].mean(axis=1)
    begins = after > MOVING_MPS * step_s
    if not begins.any():
        return None
    share = float(np.median(lengths[begins, 0] / after[begins]))
    if FIRST_STEP[0] <= share <= FIRST_STEP[1]:
        return None
    first_m, last_m = (float(np.median(np.hypot(*places[begins, row].T))) for row in (1, -1))
    said = f"the first row lies {first_m:,.2f} m from the start, {share:,.1f} times as far as rows after it lie apart"
    rows = f"Rows are {step_s:.1f} .. 4.0 s"
    if share < FIRST_STEP[0]:
        return f"{said}: it is the row of now. {rows}: leave it out and add the one of 4.0 s"
    if last_m < min(first_m, FIRST_STEP[1] * float(np.median(lengths[begins, -3:]))):
        return f"{said}, and the last one {last_m:,.2f} m: time runs backwards. {rows}: turn their order"
    return f"{said}. {rows} from the start, in the ego's own frame there, not the world's (x = y = heading = 0 at 0 s)"


def _start_sign(moved: Array, moves: Array) -> str | None:
    x, y = moved[np.arange(len(moved)), np.argmax(moves, axis=1)].T
    off = float(np.median(np.abs(np.arctan2(y, x))))
    if off <= SIDEWAYS_RAD:
        return None
    how = "does x point backwards?" if off > np.pi * 0.75 else "are x and y swapped?"
    return f"motion begins {np.degrees(off):.0f} deg off x, which is forward, and y is left: {how}"


def _heading_sign(headings: Array, moved: Array, moves: Array) -> str | None:
    """headings (K, N), moved (K, N - 1, 2) and moves (K, N - 1) between their rows."""
    along, each = np.arctan2(moved[..., 1], moved[..., 0]), np.arange(len(moved))
    first, last = np.argmax(moves, axis=1), moves.shape[1] - 1 - np.argmax(moves[:, ::-1], axis=1)
    turns = np.abs(wrap_angle(along[each, last] - along[each, first])) > TURN_RAD
    if turns.sum() < LEAST_TURNING:
        turns[:] = True
    headings, along, moves = headings[turns], along[turns], moves[turns]

    def off_motion(read: Array) -> float:
        between = read[:, :-1] + wrap_angle(np.diff(read, axis=1)) / 2.0
        off = np.where(moves, np.abs(wrap_angle(along - between)), np.nan)
        return float(np.median(np.nanmedian(off, axis=1)))

    as_given = off_motion(headings)
    if as_given <= OFF_MOTION_RAD:
        return None
    readings = {
        "they are in degrees": np.radians(headings),
        "they turn the wrong way: clockwise, or y is to the right": -headings,
        "they point backwards": headings + np.pi,
        "they count clockwise from y": np.pi / 2.0 - headings,
        "they count from y": headings + np.pi / 2.0,
        "they are the world's, not those from the start": headings - headings[:, :1],
    }
    best = min(readings, key=lambda reading: off_motion(readings[reading]))
    why = f": {best}" if off_motion(readings[best]) < as_given / 3.0 else ""
    said = f"headings are {np.degrees(as_given):.0f} deg off the direction of motion (median, where it turns){why}"
    return f"{said}. Expected radians from x, which is forward, counter-clockwise to y, which is left"


def _speed_sign(places: Array, step_s: float, human: bool) -> str | None:
    steps, second = round(VELOCITY_S / step_s), round(1.0 / step_s)
    velocities = (places[:, steps:] - places[:, :-steps]) / VELOCITY_S
    expected = f"Expected metres, in rows {step_s:.1f} s apart"
    speed = float(np.quantile(np.hypot(velocities[..., 0], velocities[..., 1]).max(axis=1), 0.9))
    if speed > TOP_SPEED_MPS:
        return f"a tenth of them drive faster than {speed:,.0f} m/s. {expected}: another unit, or more than 4 s?"
    if not human or len(places) < LEAST_DRIVES:
        return None
    changed = velocities[:, second:] - velocities[:, :-second]
    change = float(np.quantile(np.hypot(changed[..., 0], changed[..., 1]).max(axis=1), 0.9))
    if change <= CHANGE_MPS:
        return None
    said = f"a tenth of them change their velocity by more than {change:.1f} m/s within a second, people by 2 m/s"
    return f"{said}. {expected}: do they hold 8 s, or another unit?"


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

    @cached_property
    def along_strips(self) -> tuple[Indices, Array]:
        """Rows (K,), and their trajectories: those that end near each other follow each other.

        Much of what one trajectory looks up in a scene the next one finds in the processor's caches.
        """
        x, y = self.trajectories[:, -1, 0], self.trajectories[:, -1, 1]
        rows = np.lexsort((x, np.floor(y / STRIP_M)))
        return rows, self.trajectories[rows]


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
