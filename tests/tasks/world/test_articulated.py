"""Which boxes are parts of one vehicle: trains are found whatever their labels do, nobody else is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, AgentKind, AgentTracks
from tasks.world.frames import box_corners
from tasks.world.repair.tracks import articulated, couplings, first_parts
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track

Array = NDArray[np.float64]
TIME = (np.arange(CLIP_STEPS) - NOW) * STEP_S
CAB, TRAILER = (8.0, 2.6), (7.0, 2.6)
BEHIND_M = 7.7  # of the cab's centre: 0.2 m between the boxes


def along(way: Array, y: float = 0.0, **options: object) -> Track:
    """One whose log is at (way, y), headed along x."""
    poses = np.column_stack([way, np.full(CLIP_STEPS, y), np.zeros(CLIP_STEPS)])
    return Track(0.0, poses=poses, **options)  # type: ignore[arg-type]


def on_circle(way: Array, radius: float = 15.0, **options: object) -> Track:
    angle = way / radius
    poses = np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])
    return Track(0.0, poses=poses, **options)  # type: ignore[arg-type]


def pairs(*members: Track) -> tuple[tuple[int, int], ...]:
    return couplings(worlds.tracks(*members))


DRIVES = 6.0 * TIME


def test_a_trailer_belongs_to_the_cab_before_it() -> None:
    cab, trailer = along(DRIVES, size=CAB), along(DRIVES - BEHIND_M, size=TRAILER)
    assert pairs(cab, trailer) == ((0, 1),)
    assert pairs(trailer, Track(50.0, speed=6.0), cab) == ((2, 0),), "whatever their order and whoever else drives"


def test_the_front_leads_in_the_direction_of_motion() -> None:
    assert pairs(along(-DRIVES, size=CAB), along(-DRIVES - BEHIND_M, size=TRAILER)) == ((1, 0),), "it is pushed back"


def test_a_cab_with_two_trailers_is_a_chain() -> None:
    parts = [along(DRIVES - k * BEHIND_M, size=TRAILER) for k in (2, 0, 1)]
    found = pairs(*parts)
    assert found == ((2, 0), (1, 2))
    assert first_parts(4, found).tolist() == [1, 1, 1, 3]


def test_a_train_that_circles_is_found() -> None:
    assert pairs(on_circle(DRIVES, size=CAB), on_circle(DRIVES - BEHIND_M, size=TRAILER)) == ((0, 1),)


def test_labels_that_wander_as_those_of_far_boxes_do_are_a_train() -> None:
    """AV2's cab and trailer are up to 3.2 m apart, and overlap in most frames."""
    wanders = 1.2 + 1.8 * np.cos(np.linspace(0.0, 9.0, CLIP_STEPS) + 0.8)
    assert pairs(along(DRIVES, size=CAB), along(DRIVES - BEHIND_M + 0.6 - wanders, size=TRAILER)) == ((0, 1),)


def test_a_drawbar_is_longer_where_it_is_fast() -> None:
    """Nobody follows 1 m behind at 50 km/h."""
    fast, slow = 14.0 * TIME, 3.0 * TIME
    gap = 4.6 + 1.2
    assert pairs(along(fast), along(fast - gap)) == ((0, 1),)
    assert pairs(along(slow), along(slow - gap)) == ()


def test_cars_parked_bumper_to_bumper_are_no_train() -> None:
    assert pairs(Track(0.0), Track(4.7), Track(9.4)) == ()


def queue(gap_m: float, headway_m: float) -> list[Track]:
    """Three cars that wait for 5 s, `gap_m` between them, and drive off one after the other to `headway_m`."""
    moving = np.maximum(TIME - 3.5, 0.0)
    starts = [np.maximum(moving - 0.6 * k, 0.0) for k in range(3)]
    way = [np.where(t < 3.0, t * t, 9.0 + 6.0 * (t - 3.0)) for t in starts]
    spread = [np.minimum(moving, 2.0) / 2.0 * headway_m * k for k in range(3)]
    return [along(way[k] - k * (4.6 + gap_m) - spread[k]) for k in range(3)]


@pytest.mark.parametrize("headway_m", [0.0, 2.0])
def test_a_queue_at_a_light_is_no_train(headway_m: float) -> None:
    assert pairs(*queue(0.3, headway_m)) == ()


def test_a_queue_that_crawls_is_no_train() -> None:
    crawls = 3.0 * TIME
    assert pairs(along(crawls), along(crawls - 4.6 - 0.9)) == (), "0.9 m is nearer than any in the logs"


def test_a_train_that_starts_late_in_the_window_is_found() -> None:
    """At 1 m/s2 for the last 2.8 s."""
    way = 0.5 * np.maximum(TIME - 5.2, 0.0) ** 2
    assert pairs(along(way, size=CAB), along(way - BEHIND_M, size=TRAILER)) == ((0, 1),)


def test_who_drives_side_by_side_is_no_train() -> None:
    assert pairs(along(DRIVES, size=CAB), along(DRIVES, 2.9, size=CAB)) == ()
    assert pairs(along(DRIVES, size=CAB), along(DRIVES - 4.0, 2.9, size=CAB)) == ()


def test_a_vehicle_that_is_labelled_twice_is_no_train() -> None:
    assert pairs(along(DRIVES, size=CAB), along(DRIVES - 0.5, 0.3, size=CAB)) == ()


def test_who_shares_a_part_of_its_life_or_is_no_vehicle_is_no_train() -> None:
    cab = along(DRIVES, size=CAB)
    assert pairs(cab, along(DRIVES - BEHIND_M, size=TRAILER, last=70)) == ()
    assert pairs(cab, along(DRIVES - BEHIND_M, size=TRAILER, kind=AgentKind.BICYCLE)) == ()


def test_who_unhitches_and_drives_off_is_no_train() -> None:
    off = np.where(TIME > 5.0, 6.0 * (TIME - 5.0), 0.0)
    assert pairs(along(DRIVES + off, size=CAB), along(DRIVES - BEHIND_M, size=TRAILER)) == ()


def test_nobody_is_coupled_where_nobody_is() -> None:
    assert pairs() == ()
    nobody = worlds.tracks(along(DRIVES))
    nobody = replace(nobody, valid=np.zeros_like(nobody.valid), boxes=np.full_like(nobody.boxes, np.nan))
    assert couplings(nobody) == ()


def test_the_record_names_both_and_nothing_else_changes() -> None:
    agents = worlds.tracks(along(DRIVES, size=CAB), along(DRIVES - BEHIND_M, size=TRAILER))
    before = agents.boxes.tobytes()
    (record,) = articulated(agents)
    assert (record.what, record.thing, record.now) == ("articulated", "a1", "towed by a0")
    assert math.isnan(record.time_s) and record.was == "an agent of its own"
    assert agents.boxes.tobytes() == before and len(articulated(agents)) == 1


def slow_couplings(agents: AgentTracks) -> set[tuple[int, int]]:
    """The rule frame by frame, with shapely; for worlds where nobody could be towed by two."""
    found = set()
    for i in range(len(agents)):
        for j in range(len(agents)):
            if i == j or {agents.kinds[i], agents.kinds[j]} != {AgentKind.VEHICLE}:
                continue
            lives = [np.flatnonzero(agents.valid[:, k]) for k in (i, j)]
            shared = sorted(set(lives[0].tolist()) & set(lives[1].tolist()))
            if len(shared) < 5 or len(shared) < 0.8 * max(map(len, lives)):
                continue
            farthest = [
                max(math.dist(agents.boxes[k, who, :2], agents.boxes[seen[0], who, :2]) for k in seen)
                for who, seen in zip((i, j), lives)
            ]
            if min(farthest) < 2.0:
                continue
            touch, drive, apart, places = [], [], False, []
            leads = 0.0
            for k in shared:
                speed = max(math.hypot(*agents.velocities[k, who]) for who in (i, j))
                one, other = agents.boxes[k, i], agents.boxes[k, j]
                touch.append(grown_touch(one, other, 0.5 + 0.1 * speed))
                drive.append(speed >= 2.0)
                apart = apart or not grown_touch(one, other, 4.0)
                between = one[:2] - other[:2]
                mean = math.atan2(sum(math.sin(b[2]) for b in (one, other)), sum(math.cos(b[2]) for b in (one, other)))
                turned = between[0] + 1j * between[1]
                turned *= np.exp(-1j * mean)
                places.append((abs(turned.real) / (one[3] + other[3]), abs(turned.imag) / (one[4] + other[4])))
                leads += float(between @ (agents.velocities[k, i] + agents.velocities[k, j]))
            driving = [t for t, d in zip(touch, drive) if d]
            if apart or len(driving) < 5 or min(np.mean(touch), np.mean(driving)) < 0.5:
                continue
            along_m, across_m = np.median(np.array(places), axis=0)
            if along_m >= 0.25 and across_m <= 0.25 and leads > 0.0:
                found.add((i, j))
    return found


def grown_touch(one: Array, other: Array, gap: float) -> bool:
    grown = np.array([0.0, 0.0, 0.0, gap, gap])
    a, b = (shapely.polygons(box_corners((box + grown)[None]))[0] for box in (one, other))
    return bool(shapely.intersects(a, b))


@pytest.mark.slow
@given(seed=st.integers(0, 2**31), gap=st.floats(0.0, 3.0), speed=st.floats(0.5, 12.0), noise=st.floats(0.0, 0.4))
@settings(max_examples=25)
def test_who_is_coupled_equals_its_slow_twin(seed: int, gap: float, speed: float, noise: float) -> None:
    """Two that drive one behind the other near or far, in a crowd of which nobody touches them."""
    rng = np.random.default_rng(seed)
    radius, way = rng.uniform(12.0, 200.0), speed * TIME
    ahead = on_circle(way, radius, size=CAB)
    behind = on_circle(way - 7.5 - gap + noise * rng.normal(size=CLIP_STEPS), radius, size=TRAILER)
    agents = worlds.tracks(ahead, behind, along(way, -40.0), along(way - rng.uniform(3.0, 9.0), -43.0))
    assert set(couplings(agents)) == slow_couplings(agents)


@given(seed=st.integers(0, 2**31), turn=st.floats(-3.0, 3.0))
@settings(max_examples=10)
def test_a_turned_world_has_the_same_trains(seed: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    members = [along(DRIVES, size=CAB), along(DRIVES - BEHIND_M, size=TRAILER), along(DRIVES + 20.0), *queue(0.3, 2.0)]
    agents = worlds.tracks(*members[:3], *(replace(m, poses=m.poses + np.array([0.0, 30.0, 0.0])) for m in members[3:]))
    c, s = math.cos(turn), math.sin(turn)
    rotation, shift = np.array([[c, -s], [s, c]]), rng.uniform(-1e3, 1e3, 2)
    boxes = agents.boxes.copy()
    boxes[..., :2] = boxes[..., :2] @ rotation.T + shift
    boxes[..., 2] += turn
    turned = replace(agents, boxes=boxes, velocities=agents.velocities @ rotation.T)
    assert couplings(turned) == couplings(agents) == ((0, 1),)
