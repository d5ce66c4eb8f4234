"""What a log shows of the things around the ego, at its own frames, and the passes that put it right.

Each pass is a function of observations that gives them back with what it did. None of them moves what is whole: a box
is left out, named anew, turned round or put between its neighbours. Then which of the boxes are parts of one vehicle.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps

import numpy as np
from scipy.ndimage import median_filter

from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S, AgentKind, AgentTracks
from tasks.world.frames import LARGEST, PACIFICA, box_corners, touching, wrap_angle
from tasks.world.repair.records import LEFT_OUT, Repair

X, Y, Z, HEADING, LENGTH, WIDTH, HEIGHT, VX, VY = range(9)  # columns of a box, [m], [rad], [m/s]
UNSEEN, TAKEN_OUT, FILLED = -1, -2, -3  # in the place of a row: by the file, by a pass; FILLED is seen

EGO = "ego"  # in repairs
FILLED_S = 0.55  # between two frames of a log, at 2 Hz or where some are missing: boxes are linear in between
SLOW_CLOCK = 0.005  # of 0.1 s between frames: more is said
FILLED_GAP_S = 0.5  # between two frames of a thing; what was taken out in between is put on the line between them
LEAST_SIZE_M = (1e-3, 1e-3, 0.0)  # some data sets have no heights of flat things
LARGEST_SIZE_M = 100.0  # of a box: a train's
MOST = 0.5  # of a thing's frames: more than these say what it is
KNOWN_AFTER_S = 0.6  # a thing unseen for longer may have turned round
TURNED_RAD = 2.6  # from one frame to the next no car turns so far: it is pi, off by what it really turned
MOVING_MPS = 2.0  # faster, motion tells which way a thing looks
REVERSED_MPS, REVERSED_S = 5.0, 1.0  # nobody drives backwards so fast for so long
SPIKE_FRAMES = 2  # as many that lie elsewhere are a fault of theirs, more of them are another thing
USUAL_S = 1.1  # around a step, over which a thing's usual speed is taken
TOP_SPEED_MPS = {  # nobody in traffic is faster; 10 m/s is a sprinter
    AgentKind.VEHICLE: 70.0,
    AgentKind.BICYCLE: 70.0,
    AgentKind.PEDESTRIAN: 10.0,
    AgentKind.GENERIC_OBJECT: 25.0,
    AgentKind.TRAFFIC_CONE: 10.0,
    AgentKind.BARRIER: 10.0,
    AgentKind.CZONE_SIGN: 10.0,
}
LARGEST_ACCEL_MPS2 = 10.0
NOISE_M = 2.5  # from one frame to the next: boxes are corrected as more of a thing comes into view
AT_ONCE = 1 << 18  # pairs of boxes that are looked at in one go
ONE_PLACE = 0.5  # of what two boxes cover together both cover: two things cannot, but one listed twice
SAME_M = 0.1  # nor have two things, however small, their centres as near


@dataclass(frozen=True)
class ObservedTracks:
    """F frames of a log and the N things they show, world frame."""

    times_s: Array  # (F,) increasing
    track_ids: tuple[str, ...]  # (N,) unique
    kinds: tuple[AgentKind, ...]  # (N,)
    boxes: Array  # (F, N, 9) X .. VY above; velocities are 0 where the log has none
    rows: Ints  # (F, N) number of the box in its frame or file; UNSEEN, TAKEN_OUT, FILLED

    @cached_property
    def seen(self) -> Bools:
        """(F, N)"""
        return (self.rows >= 0) | (self.rows == FILLED)

    def __len__(self) -> int:
        return len(self.track_ids)

    def frames(self, n: int) -> Ints:
        """The frames that show thing n."""
        return np.flatnonzero(self.seen[:, n])

    def without(self, frames: Ints, n: int) -> "ObservedTracks":
        """With those frames of thing n taken out."""
        rows = self.rows.copy()
        rows[frames, n] = TAKEN_OUT
        return replace(self, rows=rows)


Repairs = tuple[Repair, ...]


def observed(
    frame_times_s: Array, times_s: Array, ids: Sequence[str | None], kinds: Sequence[AgentKind | None], boxes: Array
) -> tuple[ObservedTracks, Repairs]:
    """n boxes in any order as tracks ordered by id, each of the first kind that its boxes name.

    times_s: (n,) of the frames frame_times_s (F,); boxes: (n, 9). What no id names is left out, things of no known kind
    (None), what has the id of another box of its frame, and a frame of which most things stand elsewhere too.
    """
    done: list[Repair] = []
    in_time = np.argsort(times_s, kind="stable")
    ordered: list[int] = in_time.tolist()
    latest_first = ((ids[row], kinds[row]) for row in reversed(ordered))
    kind_of = {name: kind for name, kind in latest_first if name is not None and kind is not None}
    frame_of = np.searchsorted(frame_times_s, times_s)
    unnamed = set[int]()
    for row in ordered:
        if ids[row] is None:
            done.append(Repair("token", f"box {row}", float(times_s[row]), "no id", LEFT_OUT))
            unnamed.add(int(frame_of[row]))
    for row in ordered:
        if kinds[row] is None and (name := ids[row]) is not None:
            now = kind_of[name].lower() if name in kind_of else LEFT_OUT
            done.append(Repair("class", name, float(times_s[row]), "of no known class", now))
    names = sorted(kind_of)
    column_of = {name: column for column, name in enumerate(names)}
    column = np.array([-1 if (name := ids[row]) is None else column_of.get(name, -1) for row in ordered], int)
    known, column = in_time[column >= 0], column[column >= 0]
    placed, at = np.unique(frame_of[known] * len(names) + column, return_index=True)
    rows = np.full((len(frame_times_s), len(names)), UNSEEN)
    of_things = np.zeros((*rows.shape, 9))
    rows.ravel()[placed], of_things.reshape(-1, 9)[placed] = known[at], boxes[known[at]]
    again = np.setdiff1d(np.arange(len(known)), at)
    frames, things = frame_of[known[again]], column[again]
    other = (boxes[known[again]] != of_things[frames, things]).any(axis=1)
    n_other = np.bincount(frames[other], minlength=len(rows))
    torn = (n_other > 1) & (n_other > MOST * (rows != UNSEEN).sum(axis=1))
    for frame in np.flatnonzero(torn).tolist():  # nothing tells which box is of its own time
        rows[frame] = TAKEN_OUT
        done.append(Repair("twice", "", float(frame_times_s[frame]), "several frames of one stamp", LEFT_OUT))
    for frame, thing in zip(frames[~torn[frames]].tolist(), things[~torn[frames]].tolist()):
        time_s = float(frame_times_s[frame])
        done.append(Repair("twice", names[thing], time_s, "two boxes of one frame", "the first of them"))
        unnamed.add(frame)
    for frame in unnamed:  # what is missing there may be what lost its name, and is put between its neighbours
        rows[frame, rows[frame] == UNSEEN] = TAKEN_OUT
    of_kinds = tuple(kind_of[name] for name in names)
    return ObservedTracks(frame_times_s, tuple(names), of_kinds, of_things, rows), tuple(done)


Pass = Callable[[ObservedTracks, Array], tuple[ObservedTracks, Repairs]]


def settled(one: Pass) -> Pass:
    """The pass, again and again until it finds nothing more: what is taken out changes what is left."""

    @wraps(one)
    def all_of_it(tracks: ObservedTracks, ego_poses: Array) -> tuple[ObservedTracks, Repairs]:
        done: Repairs = ()
        while True:
            tracks, found = one(tracks, ego_poses)
            if not found:
                return tracks, done
            done += found

    return all_of_it


def repaired(tracks: ObservedTracks, ego_poses: Array) -> tuple[ObservedTracks, Repairs]:
    """All passes, one after the other, without the things that are then seen nowhere.

    ego_poses: (F, 3) rear axle x, y [m], heading [rad]; NaN where unknown.
    """
    done: list[Repair] = []
    for one in PASSES:
        tracks, found = one(tracks, ego_poses)
        done += found
    things = sorted(np.flatnonzero(tracks.seen.any(axis=0)), key=lambda n: tracks.track_ids[n])
    return _of_things(tracks, np.array(things, int)), tuple(done)


def _of_things(tracks: ObservedTracks, things: Ints) -> ObservedTracks:
    return replace(
        tracks,
        track_ids=tuple(tracks.track_ids[n] for n in things),
        kinds=tuple(tracks.kinds[n] for n in things),
        boxes=tracks.boxes[:, things],
        rows=tracks.rows[:, things],
    )


def without_impossible_values(tracks: ObservedTracks, _: Array) -> tuple[ObservedTracks, Repairs]:
    """Boxes that cannot be are left out; where most of a thing's are, the thing. What is unseen is 0."""
    sizes, seen = tracks.boxes[..., LENGTH : HEIGHT + 1], tracks.seen
    possible = np.asarray((np.abs(tracks.boxes) <= LARGEST).all(axis=-1))
    possible &= ((sizes >= LEAST_SIZE_M) & (sizes <= LARGEST_SIZE_M)).all(axis=-1)
    done = []
    for n in np.flatnonzero((seen & ~possible).any(axis=0)):
        bad = np.flatnonzero(seen[:, n] & ~possible[:, n])
        was = [_impossible(box) for box in tracks.boxes[bad, n]]
        tracks, found = _left_out(tracks, int(n), bad, "impossible", was)
        done += found
    return replace(tracks, boxes=np.where(tracks.seen[..., None], tracks.boxes, 0.0)), tuple(done)


@settled
def with_jumps_apart(tracks: ObservedTracks, _: Array) -> tuple[ObservedTracks, Repairs]:
    """An identity that jumps is two things; a frame or two that lie elsewhere, and speeds that nothing has, go."""
    done: list[Repair] = []
    steps = _steps(tracks)
    for n in np.flatnonzero(~_even(tracks, steps)).tolist():
        frames = tracks.frames(n)
        apart = np.flatnonzero(_jumps(tracks, n, frames)) + 1
        if len(apart):
            tracks, found = _in_pieces(tracks, n, np.split(frames, apart))
            done += found
    steps = _steps(tracks) if done else steps
    limits = np.array([TOP_SPEED_MPS[kind] for kind in tracks.kinds])
    for n in np.flatnonzero((steps.speeds > limits).any(axis=0)).tolist():
        fast = _too_fast(tracks, n)
        if len(fast):
            limit = TOP_SPEED_MPS[tracks.kinds[n]]
            was = f"{tracks.kinds[n].lower()} faster than {limit:g} m/s"
            tracks, found = _left_out(tracks, n, fast, "jump", [was] * len(fast))
            done += found
    return tracks, tuple(done)


def without_the_ego(tracks: ObservedTracks, ego_poses: Array) -> tuple[ObservedTracks, Repairs]:
    """What is inside the ego for most of its life is the ego."""
    c, s = np.cos(ego_poses[:, None, 2]), np.sin(ego_poses[:, None, 2])
    dx, dy = (tracks.boxes[..., axis] - ego_poses[:, None, axis] for axis in (X, Y))
    along, across = c * dx + s * dy - PACIFICA.rear_axle_to_center, c * dy - s * dx
    inside = tracks.seen & (np.abs(along) < PACIFICA.half_length) & (np.abs(across) < PACIFICA.half_width)
    done = []
    for n in np.flatnonzero(inside.sum(axis=0) > MOST * np.maximum(tracks.seen.sum(axis=0), 1)):
        frames = tracks.frames(int(n))
        tracks, found = _left_out(tracks, int(n), frames, "ego", ["inside the ego"] * len(frames))
        done += found
    return tracks, tuple(done)


@settled
def without_doubles(tracks: ObservedTracks, _: Array) -> tuple[ObservedTracks, Repairs]:
    """Two things of one kind that are in one place for most of the shorter one's life are the longer one.

    It is also where only the shorter one was seen, next to its own frames.
    """
    life = tracks.seen.sum(axis=0)
    done: list[Repair] = []
    gone: set[int] = set()
    for first, second, together in sorted(_pairs_inside(tracks)):
        kept, double = (first, second) if life[first] >= life[second] else (second, first)
        if together <= MOST * life[double] or {kept, double} & gone:
            continue
        gone.add(double)
        alone = np.flatnonzero(tracks.seen[:, double] & ~tracks.seen[:, kept])
        boxes, rows = tracks.boxes.copy(), tracks.rows.copy()
        boxes[alone, kept], rows[alone, kept] = boxes[alone, double], rows[alone, double]
        frames = tracks.frames(double)
        rows[frames, double] = TAKEN_OUT
        span = tracks.times_s[frames[[0, -1]]].tolist()
        was = f"where {tracks.track_ids[kept]} is in {together} of {life[double]} frames"
        done.append(Repair("twice", tracks.track_ids[double], span[0], was, LEFT_OUT, span[1]))
        tracks = replace(tracks, boxes=boxes, rows=rows)
    return tracks, tuple(done)


def with_headings_turned(tracks: ObservedTracks, _: Array) -> tuple[ObservedTracks, Repairs]:
    """Headings of vehicles and bicycles that are off by pi, as motion or else most frames say it."""
    boxes, done = tracks.boxes, list[Repair]()
    drives = np.array([kind in (AgentKind.VEHICLE, AgentKind.BICYCLE) for kind in tracks.kinds], bool)
    for n in np.flatnonzero(drives & ~_looks_ahead(tracks, _steps(tracks))).tolist():
        frames = tracks.frames(n)
        for run in np.split(frames, np.flatnonzero(np.diff(tracks.times_s[frames]) > KNOWN_AFTER_S) + 1):
            wrong = run[_turned_round(tracks, n, run)] if len(run) > 1 else run[:0]
            if len(wrong):
                boxes = boxes.copy() if boxes is tracks.boxes else boxes
                was = boxes[wrong, n, HEADING]
                boxes[wrong, n, HEADING] = wrap_angle(was + np.pi)
                done += [
                    Repair("heading", tracks.track_ids[n], t, f"{a:.2f} rad", f"{b:.2f} rad")
                    for t, a, b in zip(tracks.times_s[wrong].tolist(), was, boxes[wrong, n, HEADING])
                ]
    return replace(tracks, boxes=boxes), tuple(done)


def with_gaps_filled(tracks: ObservedTracks, _: Array) -> tuple[ObservedTracks, Repairs]:
    """Frames of a thing that were taken out between two at most FILLED_GAP_S apart are on the line between these."""
    boxes, rows, done = tracks.boxes.copy(), tracks.rows.copy(), list[Repair]()
    for n in np.flatnonzero((rows == TAKEN_OUT).any(axis=0)):
        frames = tracks.frames(int(n))
        out = np.flatnonzero(rows[:, n] == TAKEN_OUT)
        after = np.searchsorted(frames, out)
        between = (after > 0) & (after < len(frames))
        out, after = out[between], after[between]
        before, behind = frames[after - 1], frames[after]
        short = tracks.times_s[behind] - tracks.times_s[before] <= FILLED_GAP_S + 1e-6
        for f, a, b in zip(out[short], before[short], behind[short]):
            boxes[f, n], rows[f, n] = _between(tracks, int(n), int(f), int(a), int(b)), FILLED
            where = f"between its frames at {tracks.times_s[a]:.1f} and {tracks.times_s[b]:.1f} s"
            done.append(Repair("gap", tracks.track_ids[n], float(tracks.times_s[f]), "no frame", where))
    return replace(tracks, boxes=boxes, rows=rows), tuple(done)


def clock_repairs(frame_times_s: Array) -> tuple[Repair, ...]:
    """What is said of frames (F,) that do not come every 0.1 s: of all of them, and of single gaps."""
    if len(frame_times_s) < 2:
        return ()
    steps = np.diff(frame_times_s)
    usual = float(np.median(steps))
    done = []
    if not abs(usual - STEP_S) <= SLOW_CLOCK * STEP_S:
        done.append(Repair("clock", "", np.nan, f"a frame every {usual:.4f} s", f"every {STEP_S} s"))
    for k in np.flatnonzero((steps > 1.5 * usual) & (steps <= FILLED_S + 1e-6)):
        done.append(Repair("gap", "", float(frame_times_s[k]), f"no frame for {steps[k]:.2f} s", "filled in"))
    return tuple(done)


def increasing(stamps: Array) -> Ints:
    """Indices of the most stamps (F,) that increase strictly, of finite ones; of as many the first in the file."""
    ends, last, after = list[float](), list[int](), dict[int, int]()  # latest beginning of a run of each length
    for k in np.flatnonzero(np.isfinite(stamps))[::-1].tolist():
        length = bisect_left(ends, -stamps[k])
        after[k] = last[length - 1] if length else -1
        ends[length : length + 1], last[length : length + 1] = [-float(stamps[k])], [k]
    chosen, k = list[int](), last[-1] if last else -1
    while k >= 0:
        chosen.append(k)
        k = after[k]
    return np.array(chosen, int)


def whole_frames(times_s: Array, boxes: Array) -> tuple[Bools, Repairs]:
    """(F,) which of F boxes (F, 9) of the ego can be and do not lie away from those around them; what is left out.

    A jump at the end stays: some converters go on with another clock there, and their readers know it.
    """
    seen, repairs = observed(times_s, times_s, [EGO] * len(boxes), [AgentKind.VEHICLE] * len(boxes), boxes)
    seen, impossible = without_impossible_values(seen, boxes[:, :3])
    possible = np.flatnonzero(seen.seen.any(axis=1))
    seen, jumped = with_jumps_apart(seen, boxes[:, :3])
    left = np.asarray(seen.seen.any(axis=1))
    inner = np.flatnonzero(left)
    ends = possible[(possible < inner[0]) | (possible > inner[-1])] if len(inner) else possible
    left[ends] = True
    at_ends = set(times_s[ends].tolist())
    jumped = tuple(repair for repair in jumped if repair.now == LEFT_OUT and repair.time_s not in at_ends)
    return left, (*repairs, *impossible, *jumped)


PASSES: Sequence[Pass] = (
    without_impossible_values,
    with_jumps_apart,
    without_the_ego,
    without_doubles,
    with_headings_turned,
    with_gaps_filled,
)


def _left_out(
    tracks: ObservedTracks, n: int, bad: Ints, what: str, was: Sequence[str]
) -> tuple[ObservedTracks, list[Repair]]:
    """Those frames of thing n left out, each with what it was; where they are most of its frames, all of it."""
    frames, name, times_s = tracks.frames(n), tracks.track_ids[n], tracks.times_s
    if len(bad) > MOST * len(frames):
        whole = Repair(what, name, float(times_s[frames[0]]), was[0], LEFT_OUT, float(times_s[frames[-1]]))
        return tracks.without(frames, n), [whole]
    return tracks.without(bad, n), [Repair(what, name, float(times_s[f]), w, LEFT_OUT) for f, w in zip(bad, was)]


def _impossible(box: Array) -> str:
    """Which of a box's values cannot be."""
    names = ("x", "y", "z", "heading", "length", "width", "height", "vx", "vy")
    wrong = ~(np.abs(box) <= LARGEST)
    sizes = box[LENGTH : HEIGHT + 1]
    wrong[LENGTH : HEIGHT + 1] |= ~((sizes >= LEAST_SIZE_M) & (sizes <= LARGEST_SIZE_M))
    return ", ".join(f"{name} {value:g}" for name, value, bad in zip(names, box, wrong) if bad)


@dataclass(frozen=True)
class _Steps:
    """From frame to frame of each thing, at the second of the two; NaN where there is none."""

    before: Ints  # (F, N) the first of the two
    took_s: Array  # (F, N)
    velocities: Array  # (F, N, 2)

    @cached_property
    def speeds(self) -> Array:
        """(F, N)"""
        return np.hypot(self.velocities[..., 0], self.velocities[..., 1])


def _steps(tracks: ObservedTracks) -> _Steps:
    seen = tracks.seen
    last = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], -1), axis=0)
    before = np.concatenate([np.full((1, len(tracks)), -1), last[:-1]])
    took_s = np.where(seen & (before >= 0), tracks.times_s[:, None] - tracks.times_s[before], np.nan)
    xy = tracks.boxes[..., :2]
    return _Steps(before, took_s, (xy - np.take_along_axis(xy, before[..., None], axis=0)) / took_s[..., None])


def _even(tracks: ObservedTracks, steps: _Steps) -> Bools:
    """(N,) whose steps are so alike that none is a jump: no step is farther from the usual than two are apart."""
    limits = np.array([TOP_SPEED_MPS[kind] for kind in tracks.kinds])
    known = ~np.isnan(steps.took_s)
    fast = (known & (steps.speeds * steps.took_s > limits * steps.took_s + NOISE_M)).any(axis=0)
    here = known[..., None]
    widest = np.where(here, steps.velocities, -np.inf).max(axis=0) - np.where(here, steps.velocities, np.inf).min(
        axis=0
    )
    apart_m = np.hypot(*widest.T) * np.where(known, steps.took_s, -np.inf).max(axis=0)
    return ~fast & ((apart_m <= NOISE_M) | ~known.any(axis=0))


def _looks_ahead(tracks: ObservedTracks, steps: _Steps) -> Bools:
    """(N,) which never turn by more than TURNED_RAD between two frames, nor ever go backwards at REVERSED_MPS."""
    heading = tracks.boxes[..., HEADING]
    ahead = np.full(len(tracks), True)
    for looks in (heading, before := np.take_along_axis(heading, steps.before, axis=0)):
        forward = np.cos(looks) * steps.velocities[..., 0] + np.sin(looks) * steps.velocities[..., 1]
        ahead &= ~(forward <= -REVERSED_MPS).any(axis=0)
    turned = np.abs(wrap_angle(heading - before)) > TURNED_RAD
    return np.asarray(ahead & ~(turned & ~np.isnan(steps.took_s)).any(axis=0))


def _jumps(tracks: ObservedTracks, n: int, frames: Ints) -> Bools:
    """(K - 1,) whether thing n cannot have gone from one of its K frames to the next."""
    if len(frames) < 2:
        return np.zeros(0, bool)
    dt = np.diff(tracks.times_s[frames])
    moved = np.diff(tracks.boxes[frames, n, :2], axis=0)
    jumps = np.hypot(*moved.T) > TOP_SPEED_MPS[tracks.kinds[n]] * dt + NOISE_M
    if float(np.hypot(*np.ptp(moved / dt[:, None], axis=0)) * dt.max()) <= NOISE_M:
        return jumps  # nothing is farther from the usual than the fastest from the slowest
    steps = max(3, 2 * round(USUAL_S / float(np.median(dt)) / 2.0) + 1)
    unknown = dt > KNOWN_AFTER_S  # what comes before them says nothing of the speed behind them
    for run in np.split(np.arange(len(dt)), np.flatnonzero(np.diff(np.cumsum(unknown))) + 1):
        run = run[~unknown[run]]
        if len(run) >= steps:
            took = dt[run, None]
            usual = np.stack([median_filter(v, steps, mode="mirror") for v in (moved[run] / took).T], axis=1)
            off = np.hypot(*(moved[run] - usual * took).T)
            jumps[run] |= off > NOISE_M + LARGEST_ACCEL_MPS2 * dt[run] ** 2
    return jumps


def _in_pieces(tracks: ObservedTracks, n: int, pieces: Sequence[Ints]) -> tuple[ObservedTracks, list[Repair]]:
    """Thing n, which jumps between the pieces (frames each), as several, and without frames that lie elsewhere."""
    name, done = tracks.track_ids[n], list[Repair]()
    things: list[Ints] = []
    for i, piece in enumerate(pieces):
        before, after = things[-1] if things else None, pieces[i + 1 : i + 3]
        if before is None:
            spike = len(after) < 2 or not _goes_on(tracks, n, piece, after[1])
        else:
            spike = _goes_on(tracks, n, before, after[0]) if after else not _goes_on(tracks, n, before, piece)
        if spike and len(piece) <= SPIKE_FRAMES:
            for f in piece:
                done.append(Repair("jump", name, float(tracks.times_s[f]), "away from its other frames", LEFT_OUT))
            tracks = tracks.without(piece, n)
        elif before is not None and _goes_on(tracks, n, before, piece):
            things[-1] = np.concatenate([before, piece])
        else:
            things.append(piece)
    if len(things) < 2:
        return tracks, done
    tracks, names = _named_anew(tracks, n, things[1:])
    for later, renamed in zip(things[1:], names):
        span = tracks.times_s[later[[0, -1]]].tolist()
        done.append(Repair("jump", name, span[0], name, renamed, span[1]))
    return tracks, done


def _goes_on(tracks: ObservedTracks, n: int, before: Ints, after: Ints) -> bool:
    """Whether thing n can have gone from the last of some frames to the first of others, at the speed it has there."""
    t, xy = tracks.times_s, tracks.boxes[:, n, :2]
    near = [
        frames[np.abs(t[frames] - t[at]) <= USUAL_S / 2.0] for frames, at in ((before, before[-1]), (after, after[0]))
    ]
    ends = [(xy[part[-1]] - xy[part[0]]) / (t[part[-1]] - t[part[0]]) for part in near if len(part) > 1]
    dt, moved = float(t[after[0]] - t[before[-1]]), xy[after[0]] - xy[before[-1]]
    if np.hypot(*moved) > TOP_SPEED_MPS[tracks.kinds[n]] * dt + NOISE_M:
        return False
    usual = np.mean(ends, axis=0) if ends else np.zeros(2)
    return bool(not ends or np.hypot(*(moved - usual * dt)) <= NOISE_M + LARGEST_ACCEL_MPS2 * dt**2)


def _named_anew(tracks: ObservedTracks, n: int, pieces: Sequence[Ints]) -> tuple[ObservedTracks, list[str]]:
    """Pieces (frames each) of thing n as things of their own, behind the others; and their names."""
    taken, names, k = set(tracks.track_ids), list[str](), 2
    for _ in pieces:
        while (name := f"{tracks.track_ids[n]}#{k}") in taken:
            k += 1
        names.append(name)
        taken.add(name)
    rows, columns = tracks.rows.copy(), np.full((len(tracks.rows), len(pieces)), UNSEEN)
    for column, frames in zip(columns.T, pieces):
        column[frames] = rows[frames, n]
        rows[frames, n] = UNSEEN
    named = replace(
        tracks,
        track_ids=(*tracks.track_ids, *names),
        kinds=(*tracks.kinds, *[tracks.kinds[n]] * len(pieces)),
        boxes=np.concatenate([tracks.boxes, tracks.boxes[:, [n] * len(pieces)]], axis=1),
        rows=np.column_stack([rows, columns]),
    )
    return named, names


def _too_fast(tracks: ObservedTracks, n: int) -> Ints:
    """The frames of thing n that lie within some second in which it went farther than its kind can."""
    frames = tracks.frames(n)
    times_s, xy = tracks.times_s[frames], tracks.boxes[frames, n, :2]
    until = np.searchsorted(times_s, times_s + 1.0 + 1e-6) - 1
    took = times_s[until] - times_s
    far = np.hypot(*(xy[until] - xy).T) > TOP_SPEED_MPS[tracks.kinds[n]] * took
    out = np.zeros(len(frames), bool)
    for k in np.flatnonzero(far & (took >= 0.5)):
        out[k : until[k] + 1] = True
    return frames[out]


def _pairs_inside(tracks: ObservedTracks) -> Iterable[tuple[int, int, int]]:
    """(n, m, frames) of all things n < m of one kind that are in one place in some frames."""
    import shapely  # here alone: workers that drive do not need it

    half = np.where(tracks.seen, np.hypot(tracks.boxes[..., LENGTH], tracks.boxes[..., WIDTH]) / 2.0, 0.0).max(axis=0)
    pairs = _pairs_near(tracks, half)
    reach = np.maximum(half[pairs].max(axis=1), SAME_M)  # of the centre of the smaller, which is in the larger
    counts = np.zeros(len(pairs), int)
    for start in range(0, len(tracks.times_s), block := max(1, AT_ONCE // max(len(pairs), 1))):
        seen, boxes = tracks.seen[start : start + block], tracks.boxes[start : start + block]
        (dx, dy), (first, second) = (boxes[:, pairs[:, 0], k] - boxes[:, pairs[:, 1], k] for k in (X, Y)), pairs.T
        frame, pair = np.nonzero(seen[:, first] & seen[:, second] & (dx**2 + dy**2 <= reach**2))
        one, other = boxes[frame, first[pair]], boxes[frame, second[pair]]
        inside = _center_inside(one, other) | (np.hypot(*(one - other)[:, :2].T) <= SAME_M)
        one, other, pair = one[inside], other[inside], pair[inside]
        if len(pair):
            shapes = [shapely.polygons(box_corners(b[:, [X, Y, HEADING, LENGTH, WIDTH]])) for b in (one, other)]
            shared = shapely.area(shapely.intersection(*shapes))
            together = shared >= ONE_PLACE * (shapely.area(shapes[0]) + shapely.area(shapes[1]) - shared)
            together |= np.hypot(*(one - other)[:, :2].T) <= SAME_M
            counts += np.bincount(pair[together], minlength=len(pairs))
    return [(n, m, together) for (n, m), together in zip(pairs.tolist(), counts.tolist()) if together]


def _pairs_near(tracks: ObservedTracks, half: Array) -> Ints:
    """(P, 2) things n < m of one kind whose extents over all time overlap; half: (N,) diagonals of their boxes."""
    here, xy = tracks.seen[..., None], tracks.boxes[..., :2]
    least = np.where(here, xy, np.inf).min(axis=0) - half[:, None]
    most = np.where(here, xy, -np.inf).max(axis=0) + half[:, None]
    kinds = np.array([kind.value for kind in tracks.kinds])
    near = ((least[:, None] <= most) & (least <= most[:, None])).all(axis=-1) & (kinds[:, None] == kinds)
    return np.argwhere(np.triu(near, 1))


def _center_inside(one: Array, other: Array) -> Bools:
    """(K,) of K pairs of boxes whether the centre of the smaller is in the larger, as in one place it has to be."""
    swap = (one[:, LENGTH] * one[:, WIDTH] < other[:, LENGTH] * other[:, WIDTH])[:, None]
    large, small = np.where(swap, other, one), np.where(swap, one, other)
    dx, dy = (small[:, axis] - large[:, axis] for axis in (X, Y))
    c, s = np.cos(large[:, HEADING]), np.sin(large[:, HEADING])
    along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
    return np.asarray((along <= large[:, LENGTH] / 2.0) & (across <= large[:, WIDTH] / 2.0))


def _turned_round(tracks: ObservedTracks, n: int, run: Ints) -> Bools:
    """(K,) of K frames of thing n in a row: which look the other way."""
    heading, times_s = tracks.boxes[run, n, HEADING], tracks.times_s[run]
    turned = np.cumsum(np.abs(wrap_angle(np.diff(heading, prepend=heading[0]))) > TURNED_RAD) % 2 == 1
    moved = np.gradient(tracks.boxes[run, n, :2], times_s, axis=0)
    forward = np.cos(heading) * moved[:, 0] + np.sin(heading) * moved[:, 1]
    forward[np.hypot(*moved.T) < MOVING_MPS] = 0.0
    forward[turned] *= -1.0
    if turned.any():
        first_is_right = forward.sum() > 0.0 if forward.any() else turned.mean() <= MOST
    else:
        first_is_right = times_s[-1] - times_s[0] < REVERSED_S or forward.mean() > -REVERSED_MPS
    return turned if first_is_right else ~turned


def _between(tracks: ObservedTracks, n: int, frame: int, before: int, after: int) -> Array:
    """(9,) the box of thing n at a frame, linear between two others."""
    t = tracks.times_s
    share = (t[frame] - t[before]) / (t[after] - t[before])
    first, last = tracks.boxes[before, n], tracks.boxes[after, n]
    box = first + share * (last - first)
    box[HEADING] = wrap_angle(first[HEADING] + share * wrap_angle(last[HEADING] - first[HEADING]))
    return np.asarray(box)


# Boxes that touch all their life are one articulated vehicle: a truck cab and its trailer, a car and its caravan.
#
# Labels have a box and a track for each part. Nobody else drives so near: two vehicles are coupled where, of the frames
# they share, they touch in at least half, in all and in those in which they drive, and are never farther apart than
# labels wander. The numbers are chosen on real logs: the cab and trailer of AV2's 7fab2350 overlap or touch in 65 % of
# their frames, 53 % in the worst window, and are 3.2 m apart at most, since far boxes wander along the road; cars that
# stay one behind the other in a queue touch in no frame (nuScenes, eight scenes: 0.55 m and more between them).

TOUCHES_M, TOUCHES_S = 0.5, 0.1  # between two parts: a drawbar, and what no driver follows as near as
TOUCHES_IN = 0.5  # of the frames
APART_M = 4.0  # in any frame: then each goes its own way
LOOK_STEPS = 8  # of every so many frames one tells which vehicles are worth a look at all of them
SLACK = 1.5  # boxes are that much nearer to each other at a corner
SHARED = 0.8  # of both lives
DRIVES_MPS, DRIVES_STEPS = 2.0, 5  # as fast for as long: parked cars and those that wait are not coupled
MOVES_M = 2.0  # from where it is first seen


def couplings(agents: AgentTracks) -> tuple[tuple[int, int], ...]:
    """Pairs (front, towed) of vehicles that are parts of one; the front leads in the direction of motion.

    A vehicle tows one at most and is towed by one at most; what is towed may tow in turn. Of several that could be the
    nearest is.
    """
    found = [pair for i, j in _always_near(agents) if (pair := _coupled(agents, i, j)) is not None]
    chosen: list[tuple[int, int]] = []
    first = list(range(len(agents)))  # of each train, by its parts
    for _, front, towed in sorted(found):
        if all(front != f and towed != t for f, t in chosen) and first[front] != first[towed]:
            chosen.append((front, towed))
            first = [first[front] if k == first[towed] else k for k in first]
    return tuple(sorted(chosen, key=lambda pair: pair[1]))


def first_parts(n: int, pairs: tuple[tuple[int, int], ...]) -> Ints:
    """(N,) the first part of the vehicle that each of N boxes is of: itself where nothing tows it."""
    front_of = {towed: front for front, towed in pairs}
    out = np.arange(n)
    for towed in front_of:
        part = towed
        while part in front_of:
            part = front_of[part]
        out[towed] = part
    return out


def articulated(agents: AgentTracks) -> tuple[Repair, ...]:
    """A record for each part that the simulation moves behind the one before it. The tracks stay as they are."""
    names = agents.track_ids
    return tuple(
        Repair("articulated", names[towed], math.nan, "an agent of its own", f"towed by {names[front]}")
        for front, towed in couplings(agents)
    )


def _always_near(agents: AgentTracks) -> list[tuple[int, int]]:
    """Pairs of vehicles that move, share most of their lives and are never far apart; a first, cheap look."""
    n = len(agents)
    seen_at = agents.boxes[agents.valid.argmax(axis=0), np.arange(n), :2]
    moved = np.where(agents.valid, _lengths(agents.boxes[..., :2] - seen_at), 0.0).max(axis=0, initial=0.0)
    is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds], dtype=bool)
    moving = np.flatnonzero(is_vehicle & (moved >= MOVES_M))
    valid = agents.valid[:, moving].astype(np.float64)
    shared, lives = valid.T @ valid, valid.sum(axis=0)
    boxes, there = agents.boxes[::LOOK_STEPS, moving], agents.valid[::LOOK_STEPS, moving]
    radius = np.where(there, 0.5 * _lengths(boxes[..., 3:]), 0.0).max(axis=0, initial=0.0)
    apart = _lengths(boxes[:, :, None, :2] - boxes[:, None, :, :2])
    far = (apart > radius[:, None] + radius + SLACK * APART_M).any(axis=0)  # false next to absent frames
    near = ~far & (shared >= DRIVES_STEPS) & (shared >= SHARED * np.maximum(lives[:, None], lives))
    return [(int(moving[i]), int(moving[j])) for i, j in np.argwhere(np.triu(near, 1))]


def _lengths(vectors: Array) -> Array:
    out: Array = np.hypot(vectors[..., 0], vectors[..., 1])
    return out


def _coupled(agents: AgentTracks, i: int, j: int) -> tuple[float, int, int] | None:
    """(distance [m], front, towed) of two vehicles that are coupled."""
    both = agents.valid[:, i] & agents.valid[:, j]
    one, other = agents.boxes[both, i], agents.boxes[both, j]
    if not _within(one, other, APART_M).all():
        return None
    velocities = agents.velocities[both, i], agents.velocities[both, j]
    speed = np.maximum(*map(_lengths, velocities))
    touches, drives = _within(one, other, TOUCHES_M + TOUCHES_S * speed), speed >= DRIVES_MPS
    if drives.sum() < DRIVES_STEPS or min(touches.mean(), touches[drives].mean()) < TOUCHES_IN:
        return None
    # One behind the other: not side by side, and not one vehicle that is labelled twice. On a circle the line between
    # two parts is headed as they are on average.
    between = one[:, :2] - other[:, :2]
    ahead = np.stack([f(one[:, 2]) + f(other[:, 2]) for f in (np.cos, np.sin)], axis=1)
    ahead /= np.maximum(_lengths(ahead), 1e-9)[:, None]
    along, across = (between * ahead).sum(axis=1), between[:, 1] * ahead[:, 0] - between[:, 0] * ahead[:, 1]
    lengths, widths = one[:, 3] + other[:, 3], one[:, 4] + other[:, 4]
    if np.median(np.abs(along) / lengths) < 0.25 or np.median(np.abs(across) / widths) > 0.25:
        return None
    leads = float((between * (velocities[0] + velocities[1])).sum())
    distance = float(np.median(_lengths(between)))
    return (distance, i, j) if leads > 0.0 else (distance, j, i)


def _within(one: Array, other: Array, gap: Array | float) -> Bools:
    """(K,) whether boxes (K, 5) are that near [m] to each other, at corners a little farther."""
    one, other = one.copy(), other.copy()
    for boxes in (one, other):
        boxes[:, 3:] += np.reshape(gap, (-1, 1))
    return touching(one, other)
