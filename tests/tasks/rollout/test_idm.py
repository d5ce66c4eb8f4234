"""The driver model alone: closed forms and geometry against slow, obvious twins."""

import numpy as np
import pytest
import shapely
import shapely.ops

from tasks.rollout.corridor import (
    Paths,
    Way,
    boxes_overlap,
    corridor_gap,
    pose_on_path,
    project_on_path,
    stretch_rectangles,
)
from tasks.rollout.idm import (
    IdmDriver,
    advance,
    following_acceleration,
    free_acceleration,
    matters_within,
    needed_deceleration,
    stop_line_gap,
)
from tasks.world.frames import box_corners

DRIVER = IdmDriver(1.0, 1.5, 1.0, 2.0, 4.0, 8.0, 60.0, 20.0)


def one_path(xy: np.ndarray, lines: tuple[tuple[float, int], ...] = ()) -> Paths:
    """A single path through points 0.5 m apart."""
    edge = np.gradient(xy, axis=0)
    heading = np.unwrap(np.arctan2(edge[:, 1], edge[:, 0]))[None]
    return Paths(
        xy=xy[None],
        heading=heading,
        height=np.zeros((1, len(xy))),
        target_speed=np.full((1, len(xy)), 10.0),
        stretches=stretch_rectangles(xy[None], heading),
        line_start=np.array([0, len(lines)]),
        line_at=np.array([at for at, _ in lines], dtype=float),
        line_state=np.array([[state for _, state in lines]] * 41, dtype=np.uint8).reshape(41, len(lines)),
    )


def idm_acceleration(speed: float, target_speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    free = free_acceleration(speed, target_speed, driver)
    return following_acceleration(free, speed, gap, lead_speed, driver)


def circle(radius: float) -> Paths:
    step = 0.5 / radius
    angles = np.arange(int(1.5 * np.pi / step)) * step
    return one_path(radius * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)]))


def test_a_free_road_follows_the_closed_form() -> None:
    """dv/dt = a (1 - (v/v0)^4) from rest integrates to t = v0/2a (artanh u + arctan u), u = v/v0."""
    speed = 0.0
    for step in range(1, 401):
        _, speed = advance(speed, idm_acceleration(speed, 10.0, np.inf, 0.0, DRIVER))
        u = speed / 10.0
        if u < 0.95:
            assert 5.0 * (np.arctanh(u) + np.arctan(u)) == pytest.approx(0.1 * step, abs=0.15)
    assert speed == pytest.approx(10.0, abs=0.02)


def test_in_equilibrium_the_gap_is_idms_own() -> None:
    """At equal speeds and zero acceleration: gap = (s0 + v T) / sqrt(1 - (v/v0)^4)."""
    for speed in (0.0, 3.0, 8.0):
        gap = (1.0 + 1.5 * speed) / np.sqrt(1.0 - (speed / 10.0) ** 4)
        assert idm_acceleration(speed, 10.0, gap, speed, DRIVER) == pytest.approx(0.0, abs=1e-12)


def test_too_fast_on_a_free_road_brakes_comfortably_and_a_wall_brakes_at_the_tyres_limit() -> None:
    assert idm_acceleration(20.0, 10.0, np.inf, 0.0, DRIVER) == -2.0
    assert idm_acceleration(20.0, 10.0, 2.0, 0.0, DRIVER) == -8.0


def test_the_needed_deceleration_stops_half_the_minimum_gap_behind_the_leaders_emergency_stop() -> None:
    for speed, gap, lead in ((10.0, 20.0, 0.0), (12.0, 6.0, 8.0)):
        needed = needed_deceleration(speed, gap, lead, DRIVER)
        left = gap + lead**2 / (2.0 * DRIVER.emergency_decel) - speed**2 / (2.0 * needed)
        assert left == pytest.approx(0.5 * DRIVER.min_gap_m)


def test_who_is_farther_than_matters_leaves_the_acceleration_and_who_is_a_little_nearer_does_not() -> None:
    rng, lowered = np.random.default_rng(5), 0
    for _ in range(2000):
        speed, most = rng.uniform(0.0, 20.0), rng.uniform(0.0, 15.0)
        free = free_acceleration(speed, 15.0, DRIVER)
        accel = free - rng.choice([1e-6, 0.1, 2.0]) * rng.random()
        within = matters_within(free, speed, accel, most, DRIVER)
        for lead_speed in (-most, rng.uniform(-most, most), most):
            assert following_acceleration(free, speed, within, lead_speed, DRIVER) >= accel
        lowered += following_acceleration(free, speed, 0.99 * within, -most, DRIVER) < accel
    assert lowered > 1000  # the others' braking has a floor


def test_a_braking_car_stops_where_it_stops_and_never_reverses() -> None:
    distance, speed = advance(0.4, -8.0)
    assert (distance, speed) == (pytest.approx(0.4**2 / 16.0), 0.0)
    assert advance(0.0, -8.0) == (0.0, 0.0)


def test_overlap_equals_shapely() -> None:
    rng = np.random.default_rng(1)
    for _ in range(2000):
        a, b = (np.array([*rng.uniform(-4, 4, 2), rng.uniform(-4, 4), *rng.uniform(0.3, 6, 2)]) for _ in range(2))
        area = shapely.Polygon(box_corners(a)).intersection(shapely.Polygon(box_corners(b))).area
        if area > 1e-9 or area == 0.0:
            assert boxes_overlap(a, b) == (area > 0.0)


def test_an_absent_box_overlaps_nothing() -> None:
    there, absent = np.array([0.0, 0.0, 0.0, 4.0, 2.0]), np.full(5, np.nan)
    assert not boxes_overlap(there, absent) and not boxes_overlap(absent, there)


def corridor_in_pieces(xy: np.ndarray, nose: float, half_width: float) -> np.ndarray:
    """The buffered path ahead of the nose, cut every 5 cm over 60 m or to its end."""
    line = shapely.LineString(xy)
    starts = [at for at in nose + np.arange(0.0, 60.0, 0.05) if at + 0.05 <= line.length]
    pieces = [shapely.ops.substring(line, at, at + 0.05) for at in starts]
    return shapely.buffer(pieces, half_width, cap_style="flat")


def gap_in_pieces(pieces: np.ndarray, box: np.ndarray) -> float:
    """Slow twin of the gap: how far ahead the first piece lies that meets the box."""
    meets = shapely.intersects(pieces, shapely.Polygon(box_corners(box)))
    return 0.05 * meets.argmax() if meets.any() else np.inf


@pytest.mark.parametrize("radius", [20.0, 1e5])
def test_the_corridor_gap_equals_its_slow_twin(radius: float) -> None:
    paths = circle(radius) if radius < 1e3 else one_path(np.column_stack([np.arange(0, 120, 0.5), np.zeros(240)]))
    rng = np.random.default_rng(2)
    thinner, exact, wider = (corridor_in_pieces(paths.xy[0], 7.3, half_width) for half_width in (0.85, 0.95, 1.05))
    hits = 0
    for _ in range(60):
        k = rng.integers(20, paths.xy.shape[1] - 40)
        center = paths.xy[0, k] + rng.uniform(-4, 4, 2)
        box = np.array([*center, rng.uniform(-3, 3), rng.uniform(0.5, 6), rng.uniform(0.5, 2.5)])
        gap, _ = corridor_gap(paths, Way(0, 5.0, 0.0, 0.0, 0.0, 2.3, 0.95), box, np.hypot(*box[3:]) / 2.0, 20.0, 60.0)
        slow = gap_in_pieces(exact, box)
        if np.isfinite(slow) != np.isfinite(gap):  # only a graze may be judged differently
            assert np.isinf(gap_in_pieces(thinner, box)) and np.isfinite(gap_in_pieces(wider, box))
        elif np.isfinite(slow):
            hits += 1
            assert gap == pytest.approx(slow, abs=0.35)
    assert hits > 10


def test_a_start_beside_the_path_is_kept_and_fades_without_a_jump() -> None:
    paths = circle(30.0)
    x0, y0, _ = pose_on_path(paths, 0, 12.0, 0.0, 1.2, 0.1, 20.0)
    s, left = project_on_path(paths, 0, x0, y0)
    assert (s, left) == (pytest.approx(12.0, abs=0.05), pytest.approx(1.2, abs=0.01))
    poses = np.array([pose_on_path(paths, 0, 12.0 + t, t, 1.2, 0.1, 20.0) for t in np.arange(0.0, 25.0, 0.1)])
    assert np.abs(np.diff(poses[:, 2])).max() < 0.03
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.12
    assert project_on_path(paths, 0, poses[-1, 0], poses[-1, 1])[1] == pytest.approx(0.0, abs=0.01)


def test_lines_stop_who_can_stop_and_let_pass_who_has_passed() -> None:
    road = np.column_stack([np.arange(0, 100, 0.5), np.zeros(200)])
    red, yellow, green = (one_path(road, ((50.0, state),)) for state in (2, 1, 0))
    assert stop_line_gap(red, 0, 0, 40.0, 10.0, 2.0) == 10.0
    assert stop_line_gap(green, 0, 0, 40.0, 10.0, 2.0) == np.inf
    assert stop_line_gap(yellow, 0, 0, 20.0, 10.0, 2.0) == 30.0
    assert stop_line_gap(yellow, 0, 0, 40.0, 10.0, 2.0) == np.inf  # 25 m needed
    assert stop_line_gap(red, 0, 0, 50.5, 0.0, 2.0) == 0.0  # stopped with the nose over the line
    assert stop_line_gap(red, 0, 0, 50.5, 5.0, 2.0) == np.inf
