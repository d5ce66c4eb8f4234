"""The passes on a log's tracks: closed forms, slow twins on dicts of boxes, and what they leave alone."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from statistics import mean, median

import numpy as np
import pytest
import shapely
from shapely import affinity

from tasks.world.clip import AgentKind
from tasks.world.frames import PACIFICA, wrap_angle
from tasks.world.repair.records import LEFT_OUT
from tasks.world.repair.tracks import (
    FILLED,
    PASSES,
    TAKEN_OUT,
    TOP_SPEED_MPS,
    UNSEEN,
    ObservedTracks,
    clock_repairs,
    observed,
    repaired,
    whole_frames,
    with_gaps_filled,
    with_headings_turned,
    with_jumps_apart,
    without_doubles,
    without_impossible_values,
    without_the_ego,
)

CAR, WALKER, RIDER, CONE = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.TRAFFIC_CONE
SIZES = {CAR: (4.6, 1.9, 1.6), WALKER: (0.7, 0.6, 1.7), RIDER: (1.8, 0.7, 1.7), CONE: (0.4, 0.4, 0.7)}
X, Y, HEADING, LENGTH = 0, 1, 3, 4
TIMES_S = np.round(np.arange(40) * 0.1, 9)
Box = tuple[float, ...]
Things = dict[str, dict[int, Box]]  # id -> frame -> box, of the frames that show it


def thing(kind: AgentKind, x: object, y: object, heading: object = 0.0) -> tuple[AgentKind, np.ndarray]:
    """Its kind and boxes (F, 9); of TIMES_S where it only stands."""
    n = max(np.size(x), np.size(y), np.size(heading))
    columns = x, y, 0.8, heading, *SIZES[kind], 0.0, 0.0
    return kind, np.stack([np.broadcast_to(column, (len(TIMES_S) if n == 1 else n,)) for column in columns], axis=1)


def tracks_of(times_s: np.ndarray, **things: tuple[AgentKind, np.ndarray]) -> ObservedTracks:
    """Things that every frame shows."""
    boxes = np.stack([box for _, box in things.values()], axis=1)
    rows = np.tile(np.arange(len(things)), (len(times_s), 1))
    return ObservedTracks(times_s, tuple(things), tuple(kind for kind, _ in things.values()), boxes, rows)


def far_ego(n: int) -> np.ndarray:
    return np.tile([-5000.0, -5000.0, 0.0], (n, 1))


def as_things(tracks: ObservedTracks) -> Things:
    found: Things = {}
    for n, name in enumerate(tracks.track_ids):
        frames = {int(f): tuple(tracks.boxes[f, n].tolist()) for f in tracks.frames(n)}
        if frames:
            found[name] = frames
    return found


def taken_out(tracks: ObservedTracks) -> set[tuple[str, int]]:
    return {(tracks.track_ids[n], int(f)) for f, n in np.argwhere(tracks.rows == TAKEN_OUT)}


def assert_same(found: Things, expected: Things) -> None:
    assert {name: sorted(boxes) for name, boxes in found.items()} == {n: sorted(b) for n, b in expected.items()}
    for name, boxes in found.items():
        for frame, box in boxes.items():
            assert box == pytest.approx(expected[name][frame], abs=1e-9, nan_ok=True), (name, frame)


# Traffic in which nothing is wrong, and traffic in which much is.


def healthy(seed: int, hz: float, noise_m: float = 0.3, seconds: float = 12.0) -> tuple[ObservedTracks, np.ndarray]:
    """Things a street has, as a detector sees them: with noise, gaps, and lives that begin and end within the log."""
    rng = np.random.default_rng(seed)
    times_s = np.round(np.arange(0.0, seconds, 1.0 / hz), 9)
    n = len(times_s)
    fine = np.arange(0.0, seconds, 0.01)
    things = {}
    for k in range(14):
        kind = (CAR, CAR, CAR, WALKER, WALKER, RIDER, CONE)[k % 7]
        top, accel, rate = {CAR: (25.0, 8.0, 0.5), WALKER: (2.5, 2.0, 1.5), RIDER: (8.0, 3.0, 0.8)}.get(kind, (0, 0, 0))
        push = rng.uniform(-accel, accel, 1 + int(seconds)).repeat(100)[: len(fine)]
        speed = np.empty(len(fine))
        speed[0] = rng.uniform(0.0, top)
        for i in range(1, len(fine)):
            speed[i] = min(max(speed[i - 1] + 0.01 * push[i], 0.0), top)
        back = -1.0 if k == 1 else 1.0  # a car that reverses
        speed = np.minimum(speed, 2.0) if k == 1 else speed
        turning = rng.uniform(-rate, rate, 1 + int(seconds)).repeat(100)[: len(fine)]
        grip = 6.0 / np.maximum(speed, 1.0)
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(np.clip(turning, -grip, grip)) / 100
        xy = (
            600.0 * np.array([k, k % 3])
            + np.cumsum(back * speed * np.stack([np.cos(heading), np.sin(heading)]), 1).T / 100
        )
        at = np.searchsorted(fine, times_s - 1e-6)
        seen_xy = xy[at] + rng.normal(0.0, noise_m, (n, 2))
        of = wrap_angle(heading[at] + rng.normal(0.0, 0.03, n))
        things[f"{kind.lower()}-{k:02d}"] = thing(kind, seen_xy[:, 0], seen_xy[:, 1], of)
    beside = things["pedestrian-03"][1].copy()
    beside[:, Y] += 1.0 + rng.normal(0.0, 0.1, n)  # two who walk together
    things["pedestrian-03b"] = WALKER, beside
    tracks = tracks_of(times_s, **dict(sorted(things.items())))
    rows = tracks.rows.copy()
    for column in rows.T:
        column[rng.random(n) < 0.1] = UNSEEN
        first = rng.integers(0, n)
        column[first : first + rng.integers(0, n // 2)] = UNSEEN
    ego = np.column_stack([10.0 * times_s, np.full(n, -300.0), np.zeros(n)])
    return replace(tracks, rows=rows), ego


def spoiled(seed: int, hz: float) -> tuple[ObservedTracks, np.ndarray]:
    """The same with faults of all kinds in it."""
    tracks, ego = healthy(seed, hz, noise_m=0.1)
    rng = np.random.default_rng(seed)
    boxes, rows, n = tracks.boxes.copy(), tracks.rows.copy(), len(tracks.times_s)
    columns = list(rng.permutation(len(tracks)))
    for value in (np.nan, np.inf, 1e12):
        frames = rng.choice(n, rng.integers(1, n // 3), replace=False)
        boxes[frames, columns.pop(), rng.integers(0, 9)] = value
    boxes[:, columns.pop(), LENGTH + 1] = -1.2959
    for _ in range(2):  # one of another identity
        boxes[rng.integers(1, n) :, columns.pop(), :2] += rng.uniform(30.0, 60.0, 2)
    boxes[rng.integers(0, n), columns.pop(), :2] += 40.0  # one frame elsewhere
    for _ in range(2):
        boxes[rng.random(n) < 0.3, columns.pop(), HEADING] += np.pi
    twin, of = columns.pop(), columns.pop()
    boxes[:, twin] = boxes[:, of] + rng.normal(0.0, 0.02, (n, 9)) * (np.arange(9) < 2)
    rows[rng.random(n) < 0.3, twin] = UNSEEN
    kinds = list(tracks.kinds)
    kinds[twin] = kinds[of]
    again = columns.pop()
    boxes[:, again, 0], boxes[:, again, 1] = ego[:, 0] + PACIFICA.rear_axle_to_center, ego[:, 1]
    return replace(tracks, boxes=boxes, rows=rows, kinds=tuple(kinds)), ego


SPOILED = [(seed, hz) for seed in range(6) for hz in (10.0, 2.0)]


# Slow twins: the same rules over dicts of boxes.


def without_impossible_twin(tracks: ObservedTracks, _: np.ndarray) -> Things:
    kept: Things = {}
    for name, boxes in as_things(tracks).items():
        fine = {}
        for frame, box in boxes.items():
            _, _, _, _, length, width, height, _, _ = box
            finite = all(math.isfinite(value) and abs(value) <= 1e8 for value in box)
            if finite and 0.001 <= length <= 100.0 and 0.001 <= width <= 100.0 and 0.0 <= height <= 100.0:
                fine[frame] = box
        if len(fine) >= len(boxes) / 2 and fine:
            kept[name] = fine
    return kept


def without_the_ego_twin(tracks: ObservedTracks, ego_poses: np.ndarray) -> Things:
    kept: Things = {}
    for name, boxes in as_things(tracks).items():
        inside = 0
        for frame, box in boxes.items():
            x, y, heading = ego_poses[frame]
            back, front = (
                PACIFICA.rear_axle_to_center - PACIFICA.half_length,
                PACIFICA.rear_axle_to_center + PACIFICA.half_length,
            )
            car = shapely.box(x + back, y - PACIFICA.half_width, x + front, y + PACIFICA.half_width)
            car = affinity.rotate(car, heading, origin=(x, y), use_radians=True)
            inside += car.contains(shapely.Point(box[X], box[Y]))
        if inside <= len(boxes) / 2:
            kept[name] = boxes
    return kept


def footprint(box: Box) -> shapely.Polygon:
    x, y, _, heading, length, width = box[:6]
    flat = shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    return affinity.rotate(flat, heading, use_radians=True)


def without_doubles_twin(tracks: ObservedTracks, _: np.ndarray) -> Things:
    things, kind = as_things(tracks), dict(zip(tracks.track_ids, tracks.kinds))
    life = {name: len(boxes) for name, boxes in things.items()}
    names = [name for name in tracks.track_ids if name in things]
    pairs = []
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            if kind[one] != kind[other]:
                continue
            together = 0
            for frame in things[one].keys() & things[other].keys():
                a, b = footprint(things[one][frame]), footprint(things[other][frame])
                near = math.dist(things[one][frame][:2], things[other][frame][:2]) <= 0.1
                together += near or a.intersection(b).area >= a.union(b).area / 2
            pairs.append((one, other, together))
    gone: set[str] = set()
    for one, other, together in pairs:
        longer, shorter = (one, other) if life[one] >= life[other] else (other, one)
        if together > life[shorter] / 2 and longer not in gone and shorter not in gone:
            gone.add(shorter)
            things[longer] = {**things.pop(shorter), **things[longer]}
    return things


def turned_the_other_way(a: float, b: float) -> bool:
    return math.cos(a - b) < math.cos(2.6)


def with_headings_turned_twin(tracks: ObservedTracks, _: np.ndarray) -> Things:
    things, kind, times_s = as_things(tracks), dict(zip(tracks.track_ids, tracks.kinds)), tracks.times_s
    for name, boxes in things.items():
        frames = sorted(boxes)
        run = frames[:1]
        for frame in [*frames[1:], None]:
            if frame is not None and times_s[frame] - times_s[run[-1]] <= 0.6:
                run.append(frame)
                continue
            if kind[name] in (CAR, RIDER) and len(run) > 1:
                turn(boxes, run, times_s)
            run = [frame] if frame is not None else []
    return things


def turn(boxes: dict[int, Box], run: list[int], times_s: np.ndarray) -> None:
    """Two ways to read a run, of which one is the other turned round: the one that its motion speaks for."""
    signs = [1]
    for before, after in pairwise(run):
        signs.append(-signs[-1] if turned_the_other_way(boxes[before][HEADING], boxes[after][HEADING]) else signs[-1])
    motion = np.gradient(np.array([boxes[f][:2] for f in run]), times_s[run], axis=0)
    forward = 0.0
    for f, sign, (vx, vy) in zip(run, signs, motion):
        if math.hypot(vx, vy) >= 2.0:
            forward += sign * (math.cos(boxes[f][HEADING]) * vx + math.sin(boxes[f][HEADING]) * vy)
    right = math.copysign(1, forward) if forward else (1 if signs.count(-1) <= len(signs) / 2 else -1)
    if len(set(signs)) == 1:  # then it reverses, unless that is too fast
        right = -1 if times_s[run[-1]] - times_s[run[0]] >= 1.0 and forward / len(run) <= -5.0 else 1
    for f, sign in zip(run, signs):
        if sign != right:
            box = list(boxes[f])
            box[HEADING] = math.remainder(box[HEADING] + math.pi, 2.0 * math.pi)
            boxes[f] = tuple(box)


def with_gaps_filled_twin(tracks: ObservedTracks, _: np.ndarray) -> Things:
    things, times_s = as_things(tracks), tracks.times_s
    filled = {name: dict(boxes) for name, boxes in things.items()}
    for name, frame in taken_out(tracks):
        before = [f for f in things.get(name, {}) if f < frame]
        after = [f for f in things.get(name, {}) if f > frame]
        if before and after and times_s[min(after)] - times_s[max(before)] <= 0.5 + 1e-6:
            a, b = max(before), min(after)
            share = (times_s[frame] - times_s[a]) / (times_s[b] - times_s[a])
            one, other = things[name][a], list(things[name][b])
            other[HEADING] = one[HEADING] + math.remainder(other[HEADING] - one[HEADING], 2.0 * math.pi)
            box = [p + share * (q - p) for p, q in zip(one, other)]
            box[HEADING] = math.remainder(box[HEADING], 2.0 * math.pi)
            filled[name][frame] = tuple(box)
    return filled


def with_jumps_apart_twin(tracks: ObservedTracks, _: np.ndarray) -> Things:
    things, times_s = as_things(tracks), tracks.times_s
    kind = dict(zip(tracks.track_ids, tracks.kinds))
    out: Things = {}
    names = set(tracks.track_ids)
    for name, boxes in things.items():
        top, count = TOP_SPEED_MPS[kind[name]], 2
        for i, part in enumerate(pieces(boxes, times_s, top)):
            called = name
            if i:
                while f"{name}#{count}" in names:
                    count += 1
                called = f"{name}#{count}"
                names.add(called)
            kind[called] = kind[name]
            out[called] = {f: boxes[f] for f in part}
    for name in list(out):
        top, frames = TOP_SPEED_MPS[kind[name]], sorted(out[name])
        fast: set[int] = set()
        for a in frames:
            b = max(f for f in frames if times_s[f] - times_s[a] <= 1.0 + 1e-6)
            took = times_s[b] - times_s[a]
            if took >= 0.5 and math.dist(out[name][a][:2], out[name][b][:2]) > top * took:
                fast |= {f for f in frames if a <= f <= b}
        out[name] = {} if len(fast) > len(frames) / 2 else {f: out[name][f] for f in frames if f not in fast}
    return {name: boxes for name, boxes in out.items() if boxes}


def pieces(boxes: dict[int, Box], times_s: np.ndarray, top: float) -> list[list[int]]:
    """The frames of each thing that has this identity."""
    frames = sorted(boxes)
    dt = [times_s[b] - times_s[a] for a, b in pairwise(frames)]
    v = [[(boxes[b][i] - boxes[a][i]) / t for (a, b), t in zip(pairwise(frames), dt)] for i in (0, 1)]
    half = max(1, round(1.1 / median(dt) / 2.0)) if dt else 0
    parts: list[list[int]] = [frames[:1]]
    for k, t in enumerate(dt):
        apart = t * math.hypot(v[0][k], v[1][k]) > top * t + 2.5
        first = max((j + 1 for j in range(k) if dt[j] > 0.6), default=0)
        last = min((j - 1 for j in range(k, len(dt)) if dt[j] > 0.6), default=len(dt) - 1)
        if last - first + 1 >= 2 * half + 1 and t <= 0.6:
            mirrored = [first + abs(k + j - first) for j in range(-half, half + 1)]
            around = [min(j, 2 * last - j) for j in mirrored]
            usual = [median(axis[j] for j in around) for axis in v]
            apart |= t * math.hypot(v[0][k] - usual[0], v[1][k] - usual[1]) > 2.5 + 10.0 * t**2
        parts.append([frames[k + 1]]) if apart else parts[-1].append(frames[k + 1])
    if len(parts) == 1:
        return parts
    things: list[list[int]] = []
    for i, part in enumerate(parts):
        if len(part) <= 2:
            if not things:
                alone = i + 2 >= len(parts) or not goes_on(boxes, times_s, part, parts[i + 2], top)
            elif i + 1 == len(parts):
                alone = not goes_on(boxes, times_s, things[-1], part, top)
            else:
                alone = goes_on(boxes, times_s, things[-1], parts[i + 1], top)
            if alone:
                continue
        if things and goes_on(boxes, times_s, things[-1], part, top):
            things[-1] += part
        else:
            things.append(list(part))
    return things


def goes_on(boxes: dict[int, Box], times_s: np.ndarray, one: list[int], other: list[int], top: float) -> bool:
    a, b = one[-1], other[0]
    t = times_s[b] - times_s[a]
    if math.dist(boxes[a][:2], boxes[b][:2]) > top * t + 2.5:
        return False
    speeds = []
    for near in (
        [f for f in one if times_s[a] - times_s[f] <= 0.55],
        [f for f in other if times_s[f] - times_s[b] <= 0.55],
    ):
        if len(near) > 1:
            took = times_s[near[-1]] - times_s[near[0]]
            speeds.append([(boxes[near[-1]][i] - boxes[near[0]][i]) / took for i in (0, 1)])
    if not speeds:
        return True
    expected = [boxes[a][i] + t * mean(speed[i] for speed in speeds) for i in (0, 1)]
    return math.dist(expected, boxes[b][:2]) <= 2.5 + 10.0 * t**2


TWINS: dict[Callable, Callable] = {
    without_impossible_values: without_impossible_twin,
    with_jumps_apart: with_jumps_apart_twin,
    without_the_ego: without_the_ego_twin,
    without_doubles: without_doubles_twin,
    with_headings_turned: with_headings_turned_twin,
    with_gaps_filled: with_gaps_filled_twin,
}


def test_every_pass_has_a_twin() -> None:
    assert list(TWINS) == list(PASSES)


@pytest.mark.parametrize(("seed", "hz"), SPOILED)
def test_each_pass_does_what_its_twin_does_where_much_is_wrong(seed: int, hz: float) -> None:
    tracks, ego = spoiled(seed, hz)
    for one in PASSES:
        expected = TWINS[one](tracks, ego)
        found, _ = getattr(one, "__wrapped__", one)(tracks, ego)  # once, not until it is settled
        assert_same(as_things(found), expected)
        tracks, _ = one(tracks, ego)


@pytest.mark.parametrize(("seed", "hz"), SPOILED)
def test_each_pass_and_all_of_them_change_nothing_the_second_time(seed: int, hz: float) -> None:
    tracks, ego = spoiled(seed, hz)
    for one in PASSES:
        once, _ = one(tracks, ego)
        twice, again = one(once, ego)
        assert not again, one.__name__
        assert_same(as_things(twice), as_things(once))
        tracks = once
    once, did = repaired(spoiled(seed, hz)[0], ego)
    twice, again = repaired(once, ego)
    assert did and not again
    assert once.track_ids == twice.track_ids
    assert np.array_equal(once.rows, twice.rows)
    assert np.array_equal(once.boxes[once.seen], twice.boxes[once.seen])


@pytest.mark.parametrize("hz", [10.0, 5.0, 2.0])
@pytest.mark.parametrize("seed", range(12))
def test_healthy_traffic_is_left_as_it_is(seed: int, hz: float) -> None:
    tracks, ego = healthy(seed, hz)
    found, did = repaired(tracks, ego)
    assert not did
    assert_same(as_things(found), as_things(tracks))


@pytest.mark.parametrize(("seed", "hz"), SPOILED[:6])
def test_a_world_that_is_moved_and_turned_is_repaired_alike(seed: int, hz: float) -> None:
    tracks, ego = spoiled(seed, hz)
    angle, shift = 2.1, np.array([1234.5, -987.0])
    c, s = np.cos(angle), np.sin(angle)

    def moved(of: ObservedTracks) -> ObservedTracks:
        boxes = of.boxes.copy()
        with np.errstate(invalid="ignore"):
            boxes[..., :2] = boxes[..., :2] @ np.array([[c, s], [-s, c]]) + shift
            boxes[..., 7:] = boxes[..., 7:] @ np.array([[c, s], [-s, c]])
        boxes[..., HEADING] = wrap_angle(
            np.where(np.abs(boxes[..., HEADING]) < 1e6, boxes[..., HEADING] + angle, np.nan)
        )
        return replace(of, boxes=boxes)

    moved_ego = np.column_stack([ego[:, :2] @ np.array([[c, s], [-s, c]]) + shift, ego[:, 2] + angle])
    here, did = repaired(tracks, ego)
    there, did_there = repaired(moved(tracks), moved_ego)
    assert here.track_ids == there.track_ids
    assert np.array_equal(here.rows, there.rows)
    seen = here.seen
    off = moved(here).boxes[seen] - there.boxes[seen]
    off[:, HEADING] = wrap_angle(off[:, HEADING])
    assert np.abs(off).max() < 1e-6
    assert [(r.what, r.thing, r.time_s, r.until_s) for r in did] == [
        (r.what, r.thing, r.time_s, r.until_s) for r in did_there
    ]


# Closed forms.


def test_one_impossible_box_is_put_between_its_neighbours_and_told() -> None:
    tracks = tracks_of(TIMES_S, car=thing(CAR, 5.0 * TIMES_S, 0.0))
    tracks.boxes[10, 0, LENGTH] = np.nan
    found, did = repaired(tracks, far_ego(40))
    assert np.allclose(found.boxes[:, 0], thing(CAR, 5.0 * TIMES_S, 0.0)[1])
    assert [(r.what, r.thing, r.time_s, r.was, r.now) for r in did] == [
        ("impossible", "car", 1.0, "length nan", LEFT_OUT),
        ("gap", "car", 1.0, "no frame", "between its frames at 0.9 and 1.1 s"),
    ]
    assert found.rows[10, 0] == FILLED


@pytest.mark.parametrize("bad", [20, 21])
def test_a_thing_goes_where_more_than_half_of_its_boxes_cannot_be(bad: int) -> None:
    tracks = tracks_of(TIMES_S, car=thing(CAR, 5.0 * TIMES_S, 0.0), other=thing(CAR, 5.0 * TIMES_S, 9.0))
    tracks.boxes[:bad, 0, 1] = np.inf
    found, did = without_impossible_values(tracks, far_ego(40))
    assert found.seen.sum(axis=0).tolist() == [20 if bad == 20 else 0, 40]
    assert len(did) == (20 if bad == 20 else 1)
    assert did[-1].until_s == (-np.inf if bad == 20 else 3.9)


@pytest.mark.parametrize(
    ("column", "value", "fine"),
    [
        (LENGTH, 0.0, False),
        (LENGTH, 1e-3, True),
        (LENGTH, 100.0, True),
        (LENGTH, 100.1, False),
        (LENGTH + 2, 0.0, True),
        (LENGTH + 2, -0.1, False),
        (X, 1e8, True),
        (X, 1.01e8, False),
        (7, np.nan, False),
        (HEADING, -np.inf, False),
    ],
)
def test_what_a_box_can_be(column: int, value: float, fine: bool) -> None:
    tracks = tracks_of(TIMES_S, car=thing(CAR, 0.0, 0.0))
    tracks.boxes[7, 0, column] = value
    found, did = without_impossible_values(tracks, far_ego(40))
    assert (found.rows[7, 0] != TAKEN_OUT) == fine == (not did)


@pytest.mark.parametrize("at", [1, 2, 20, 37])
def test_an_identity_that_goes_over_to_another_person_is_two_of_them(at: int) -> None:
    y = np.where(np.arange(40) < at, 0.0, 8.0)
    found, did = repaired(tracks_of(TIMES_S, walker=thing(WALKER, 1.2 * TIMES_S, y)), far_ego(40))
    assert len(did) == min(at, 40 - at, 1) if at > 2 else len(did) == at
    if at > 2:
        assert found.track_ids == ("walker", "walker#2")
        assert found.seen[:, 0].tolist() == [f < at for f in range(40)]
        assert found.seen[:, 1].tolist() == [f >= at for f in range(40)]
        assert (did[0].what, did[0].was, did[0].now, did[0].time_s) == ("jump", "walker", "walker#2", TIMES_S[at])
    else:  # a frame or two are a fault of theirs
        assert found.seen[:, 0].tolist() == [f >= at for f in range(40)]
        assert {(r.what, r.now) for r in did} == {("jump", LEFT_OUT)}


@pytest.mark.parametrize("at", [0, 1, 17, 38, 39])
def test_a_car_that_lies_elsewhere_in_one_frame_is_where_it_went_on(at: int) -> None:
    """Also in its first and last frame, and where 8 m of 0.1 s are no speed that a car could not have."""
    straight = 14.0 * TIMES_S
    tracks = tracks_of(TIMES_S, car=thing(CAR, straight, 8.0 * (np.arange(40) == at)))
    found, did = repaired(tracks, far_ego(40))
    inner = 0 < at < 39
    assert [r.what for r in did] == (["jump", "gap"] if inner else ["jump"])
    assert found.seen[:, 0].sum() == (40 if inner else 39)
    here = found.seen[:, 0]
    assert np.allclose(found.boxes[here, 0, :2], np.column_stack([straight, np.zeros(40)])[here])


def test_a_name_that_is_taken_is_not_given_to_another() -> None:
    y = np.where(np.arange(40) < 20, 0.0, 8.0)
    things = {"walker": thing(WALKER, 1.2 * TIMES_S, y), "walker#2": thing(WALKER, 50.0, 50.0)}
    found, _ = with_jumps_apart(tracks_of(TIMES_S, **things), far_ego(40))
    assert found.track_ids == ("walker", "walker#2", "walker#3")


def test_a_thing_that_is_unseen_for_long_may_be_elsewhere_but_not_farther_than_its_kind_can_go() -> None:
    times_s = np.concatenate([TIMES_S, TIMES_S + 8.0])
    x = np.where(times_s < 5.0, 0.0, 30.0)
    for kind, far, parts in ((WALKER, 30.0, 1), (WALKER, 60.0, 2), (CAR, 250.0, 1), (CAR, 300.0, 2)):
        found, _ = with_jumps_apart(tracks_of(times_s, it=thing(kind, x * far / 30.0, 0.0)), far_ego(80))
        assert len(found) == parts, (kind, far)


def test_a_pedestrian_who_keeps_the_speed_of_a_car_is_left_out() -> None:
    found, did = repaired(tracks_of(TIMES_S, it=thing(WALKER, 14.0 * TIMES_S, 0.0)), far_ego(40))
    assert len(found) == 0
    assert [(r.what, r.now, r.was) for r in did] == [("jump", LEFT_OUT, "pedestrian faster than 10 m/s")]


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_what_is_inside_the_ego_for_most_of_its_life_is_the_ego(share: float) -> None:
    ego = np.column_stack([10.0 * TIMES_S, np.zeros(40), np.zeros(40)])
    center = ego[:, 0] + PACIFICA.rear_axle_to_center
    inside = np.arange(40) < share * 40
    aside = np.where(inside, 0.0, PACIFICA.half_width + 0.1)
    found, did = without_the_ego(tracks_of(TIMES_S, it=thing(CAR, center, aside)), ego)
    assert bool(did) == (share > 0.5) == (not found.seen.any())
    assert not did or did[0].now == LEFT_OUT


def test_nothing_is_the_ego_where_nobody_knows_where_it_was() -> None:
    tracks = tracks_of(TIMES_S, it=thing(CAR, 0.0, 0.0))
    assert not without_the_ego(tracks, np.full((40, 3), np.nan))[1]


def test_a_thing_listed_twice_is_the_one_seen_longer_wherever_either_was_seen() -> None:
    tracks = tracks_of(TIMES_S, a=thing(CAR, TIMES_S, 0.0), b=thing(CAR, TIMES_S + 0.2, 0.1))
    tracks.rows[:15, 1] = UNSEEN
    tracks.rows[35:, 0] = UNSEEN
    found, did = repaired(tracks, far_ego(40))
    assert found.track_ids == ("a",)
    assert found.seen.all()
    assert np.allclose(found.boxes[35:, 0, 0], TIMES_S[35:] + 0.2)
    assert [(r.what, r.thing, r.was, r.now) for r in did] == [("twice", "b", "where a is in 20 of 25 frames", LEFT_OUT)]


def test_two_boxes_that_share_less_than_half_or_are_of_two_kinds_are_two_things() -> None:
    for other in (thing(CAR, 4.6 * 0.34, 0.0), thing(RIDER, 0.0, 0.0)):
        assert not without_doubles(tracks_of(TIMES_S, a=thing(CAR, 0.0, 0.0), b=other), far_ego(40))[1]
    assert without_doubles(tracks_of(TIMES_S, a=thing(CAR, 0.0, 0.0), b=thing(CAR, 4.6 * 0.33, 0.0)), far_ego(40))[1]


def test_a_bollard_listed_twice_a_little_aside_is_found_though_the_boxes_share_little() -> None:
    tracks = tracks_of(TIMES_S, a=thing(CONE, 0.0, 0.0), b=thing(CONE, 0.06, 0.06))
    tracks.boxes[..., LENGTH : LENGTH + 2] = 0.12, 0.12
    assert [r.what for r in without_doubles(tracks, far_ego(40))[1]] == ["twice"]


def test_a_barrier_listed_twice_that_is_wider_than_long_is_found() -> None:
    tracks = tracks_of(TIMES_S, a=thing(CONE, 0.0, 0.0), b=thing(CONE, 0.0, 0.8))
    tracks.boxes[..., LENGTH : LENGTH + 2] = 0.4, 3.0
    assert [r.what for r in without_doubles(tracks, far_ego(40))[1]] == ["twice"]


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_headings_off_by_pi_are_turned_as_motion_or_most_frames_say(speed: float) -> None:
    """A moving car looks ahead though most frames say the other; of a standing one most frames know."""
    wrong = np.arange(40) % 10 < (7 if speed else 3)
    tracks = tracks_of(TIMES_S, car=thing(CAR, speed * TIMES_S, 0.0, 0.1 + np.pi * wrong))
    found, did = repaired(tracks, far_ego(40))
    assert np.allclose(found.boxes[:, 0, HEADING], 0.1)
    assert [(r.what, r.time_s) for r in did] == [("heading", t) for t in TIMES_S[wrong]]


@pytest.mark.parametrize(("speed", "wrong"), [(4.9, False), (5.1, True), (15.0, True)])
def test_a_car_that_looks_back_all_its_life_is_turned_where_none_reverses_so_fast(speed: float, wrong: bool) -> None:
    tracks = tracks_of(TIMES_S, car=thing(CAR, -speed * TIMES_S, 0.0, 0.1))
    found, did = repaired(tracks, far_ego(40))
    assert np.allclose(wrap_angle(found.boxes[:, 0, HEADING] - 0.1 - np.pi * wrong), 0.0)
    assert [r.what for r in did] == ["heading"] * 40 * wrong


def test_a_car_that_reverses_and_a_pedestrian_who_turns_round_look_where_they_look() -> None:
    tracks = tracks_of(
        TIMES_S,
        car=thing(CAR, -2.5 * TIMES_S, 0.0, 0.0),
        walker=thing(WALKER, 0.0, 20.0, np.pi * (np.arange(40) > 20)),
    )
    assert not repaired(tracks, far_ego(40))[1]


@pytest.mark.parametrize(("out", "filled"), [(4, True), (5, False)])
def test_gaps_of_half_a_second_are_filled_and_longer_ones_are_not(out: int, filled: bool) -> None:
    tracks = tracks_of(TIMES_S, car=thing(CAR, 5.0 * TIMES_S, 0.0, 3.1 + 0.1 * np.arange(40)))
    tracks.boxes[10 : 10 + out, 0, X] = np.nan
    found, did = repaired(tracks, far_ego(40))
    assert found.seen[:, 0].all() == filled
    assert sum(r.what == "gap" for r in did) == (out if filled else 0)
    if filled:
        assert np.allclose(found.boxes[:, 0, X], 5.0 * TIMES_S)
        assert np.allclose(wrap_angle(found.boxes[:, 0, HEADING] - 3.1 - 0.1 * np.arange(40)), 0.0)


def test_what_a_file_does_not_show_stays_unseen() -> None:
    """A gap that no pass made is the file's own: its reader says what lies between frames."""
    tracks = tracks_of(TIMES_S, car=thing(CAR, 5.0 * TIMES_S, 0.0))
    tracks.rows[10:12, 0] = UNSEEN
    assert not repaired(tracks, far_ego(40))[1]


def test_boxes_in_any_order_are_tracks_by_id_without_those_that_name_nothing() -> None:
    times_s = np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0, 0.0])
    ids = ["b", "a", "a", None, "b", "c", "d"]
    kinds = [CAR, None, WALKER, CAR, CAR, None, CONE]
    boxes = np.arange(63.0).reshape(7, 9)
    tracks, did = observed(np.array([0.0, 0.1]), times_s, ids, kinds, boxes)
    assert tracks.track_ids == ("a", "b", "d")
    assert tracks.kinds == (WALKER, CAR, CONE)
    assert tracks.rows.tolist() == [[1, TAKEN_OUT, 6], [2, 0, TAKEN_OUT]]  # b may be what has no name in the first
    assert np.array_equal(tracks.boxes[1, :2], boxes[[2, 0]])
    assert [(r.what, r.thing, r.time_s, r.now) for r in did] == [
        ("token", "box 3", 0.0, LEFT_OUT),
        ("class", "a", 0.0, "pedestrian"),
        ("class", "c", 0.0, LEFT_OUT),
        ("twice", "b", 0.1, "the first of them"),
    ]


def test_a_frame_that_holds_another_one_too_is_left_out_and_one_that_is_listed_twice_is_not() -> None:
    ids, kinds, times_s = ["a", "b", "c"] * 3, [CAR] * 9, np.repeat([0.0, 0.1, 0.1], 3)
    boxes = np.repeat(np.arange(9.0)[:, None], 9, axis=1)
    tracks, did = observed(np.array([0.0, 0.1]), times_s, ids, kinds, boxes)
    assert tracks.rows.tolist() == [[0, 1, 2], [TAKEN_OUT] * 3]
    assert [(r.what, r.thing, r.time_s, r.now) for r in did] == [("twice", "", 0.1, LEFT_OUT)]
    boxes[6:] = boxes[3:6]
    tracks, did = observed(np.array([0.0, 0.1]), times_s, ids, kinds, boxes)
    assert tracks.rows.tolist() == [[0, 1, 2], [3, 4, 5]] and [r.thing for r in did] == ["a", "b", "c"]


def test_nothing_is_repaired_where_nothing_is_seen() -> None:
    tracks, did = observed(TIMES_S, np.zeros(0), [], [], np.zeros((0, 9)))
    found, done = repaired(tracks, far_ego(40))
    assert len(found) == 0 and not did and not done


@pytest.mark.parametrize(
    ("hz", "said"), [(10.0, False), (10.04, False), (9.9, True), (10.3, True), (5.0, True), (2.0, True)]
)
def test_a_clock_that_is_not_of_10_hz_is_said(hz: float, said: bool) -> None:
    did = clock_repairs(np.arange(50) / hz)
    assert [r.what for r in did] == (["clock"] if said else [])


def test_a_frame_that_is_missing_is_said_with_its_time_where_it_is_filled_in() -> None:
    for missing, said in ((1, True), (4, True), (5, False)):
        times_s = np.delete(np.arange(50) * 0.1, slice(20, 20 + missing))
        assert [(r.what, r.time_s) for r in clock_repairs(times_s)] == ([("gap", pytest.approx(1.9))] if said else [])


def test_poses_of_the_ego_that_cannot_be_or_lie_elsewhere_go_but_not_those_at_its_ends() -> None:
    boxes = np.ones((40, 9))
    boxes[:, :3] = np.column_stack([8.0 * TIMES_S, np.zeros((40, 2))])
    boxes[[5, 6], 0] = np.nan
    boxes[20, 1] += 50.0
    boxes[-1, 1] += 50.0
    left, did = whole_frames(TIMES_S, boxes)
    assert np.flatnonzero(~left).tolist() == [5, 6, 20]
    assert [(r.what, r.thing, r.time_s) for r in did] == [
        ("impossible", "ego", 0.5),
        ("impossible", "ego", 0.6),
        ("jump", "ego", 2.0),
    ]
