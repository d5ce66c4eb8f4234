"""Gaussians of the street that hang before a car which drives: which they are, and that the fit makes them go."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.backend import FitBackend
from tasks.render.fit.corrections import apply_exposure, corrected_pose
from tasks.render.fit.on_torch import TorchBackend
from tasks.render.fit.reconstruct import (
    ALIKE,
    FARTHER,
    GONE_LOGIT,
    LEAST_OPACITY,
    REFINE_UNTIL,
    SHOWN_BY,
    fade_floaters,
    find_floaters,
    run_iterations,
)
from tasks.render.fit.start import FitProblem, prepare_fit
from tasks.render.fit.state import BACKGROUND, FitState, add_to_average, logits_of, opacities_of
from tasks.render.gate import intersect_box
from tasks.render.scene.body import BEFORE_M, NEAREST_M, REACH_M, body_boxes
from tasks.render.scene.movers import SHIFT_SIZE, interpolate_knots, shift_boxes
from tasks.render.settings import FitSettings
from tasks.world.arrays import Array
from tasks.world.clip import AgentTracks
from tests.bench.by_kernels import by_kernels
from tests.tasks.render.fit.test_reconstruct import fresh

N = 5  # photos, every 0.25 s: the car 8 to 12 m before the camera, a little to the left
SETTINGS = FitSettings(iterations=30, start_gaussians=500, most_gaussians=500, refine_every=5, refine_from=5)
RAG = np.array([0.9, 0.1, 0.9])  # a colour that nothing in the street has
POST, GREEN = np.array([4.9, 0.9, 1.2]), np.array([0.1, 0.8, 0.1])  # before the car in the first photo alone
Prepared = tuple[FitProblem, FitState]


def before_the_car(k: int, share: float = 0.5) -> Array:
    """(3,) a share of the way from photo `k` to the middle of the car's rear."""
    box, eye = street.car_box(0.25 * k), street.photo(1.0 * k, 0.0, 0.25 * k).world_from_camera[:3, 3]
    rear = box[:3] - [0.47 * box[4], 0.0, 0.3]
    return np.asarray(eye + share * (rear - eye))


def begun(tracks: AgentTracks, post: Array | None = None) -> Prepared:
    """Five photos; a post, if any, is painted into each as wide as a street light 0.8 m thick would be."""
    photos, sweeps = street.drive(N)
    if post is not None:
        for photo in photos:
            u, v, depth = pixel_of(photo.world_from_camera, photo.intrinsics, post)
            rows, columns = np.mgrid[: street.HEIGHT, : street.WIDTH] + 0.5
            if depth > NEAREST_M:
                on = np.hypot(columns - u, rows - v) < 0.4 * photo.intrinsics[0, 0] / depth
                photo.rgb[on] = np.rint(255.0 * GREEN)
    return prepare_fit(photos, sweeps, tracks, SETTINGS, held_out=[])


def pixel_of(world_from_camera: Array, k: Array, point: Array) -> tuple[float, float, float]:
    x, y, z = np.linalg.inv(world_from_camera)[:3] @ [*point, 1.0]
    return k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2], z


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return begun(street.tracks())


def with_parked() -> AgentTracks:
    """Another car waits on the right, of which no photo shows anything."""
    car = street.tracks()
    waiting = np.repeat(car.boxes[:1], car.n_steps, axis=0)
    waiting[..., 1] *= -0.5
    boxes, still = np.concatenate([car.boxes, waiting], axis=1), np.zeros((car.n_steps, 1, 2))
    valid, center_z = np.repeat(car.valid, 2, axis=1), np.repeat(car.center_z, 2, axis=1)
    kinds, velocities = car.kinds * 2, np.concatenate([car.velocities, still], axis=1)
    return AgentTracks(("car", "parked"), kinds, boxes, velocities, valid, center_z, np.repeat(car.heights, 2))


@pytest.fixture(scope="module")
def with_post() -> Prepared:
    return begun(street.tracks(), POST)


def put(problem: FitProblem, state: FitState, point: Array, colour: Array, row: int = 0, opacity: float = 0.9) -> None:
    """A Gaussian of the street in place of what is at `row`."""
    state.learned["means"].values[row] = point - problem.origin
    state.learned["colours"].values[row] = colour
    state.learned["logits"].values[row] = logits_of(np.array([opacity]))
    state.road[row] = False


def alone(prepared: Prepared, point: Array, colour: Array, opacity: float = 0.9) -> tuple[FitProblem, FitState]:
    """The state with such a Gaussian at row 0, and all others of the street transparent."""
    problem, state = prepared[0], fresh(prepared[1])
    state.learned["logits"].values[state.owner == BACKGROUND] = GONE_LOGIT
    put(problem, state, point, colour, 0, opacity)
    return problem, state


def slow_floaters(problem: FitProblem, state: FitState) -> list[int]:
    """Gaussian by Gaussian, photo by photo."""
    views, found = [], []
    for i, shot in enumerate(problem.train):
        boxes, valid = problem.tracks.at(shot.photo.time_s)
        off = state.learned["boxes"].values.reshape(len(boxes), -1, SHIFT_SIZE)
        boxes = shift_boxes(boxes, interpolate_knots(off, shot.photo.time_s))
        camera = corrected_pose(shot.photo.world_from_camera, state.learned["poses"].values[i])
        near = [j for j in range(len(boxes)) if valid[j] and np.hypot(*(boxes[j, :2] - camera[:2, 3])) < REACH_M]
        views.append((shot, camera, [(part, problem.tracks.driving[j]) for j in near for part in body_boxes(boxes[j])]))
    for row in range(len(state)):
        opacity = opacities_of(state.learned["logits"].values[row, :1])[0]
        if state.owner[row] != BACKGROUND or state.road[row] or opacity <= LEAST_OPACITY:
            continue
        mean = state.learned["means"].values[row].astype(np.float64)
        nearest, others = np.inf, []
        for i, (shot, camera, bodies) in enumerate(views):
            u, v, depth = pixel_of(camera, shot.photo.intrinsics, mean)
            if depth <= NEAREST_M or not (0.0 <= u < street.WIDTH and 0.0 <= v < street.HEIGHT):
                continue
            ray = mean - camera[:3, 3]
            along = [float(intersect_box(body, camera[:3, 3], ray[None])[3][0]) for body, _ in bodies]
            first = int(np.argmin(along)) if along else -1
            if first >= 0 and np.isfinite(along[first]) and bodies[first][1]:
                if (along[first] - 1.0) * np.linalg.norm(ray) > BEFORE_M:
                    nearest = min(nearest, depth)
                    continue
                if along[first] < 1.0:
                    continue
            if shot.hidden is None or not shot.hidden[int(v), int(u)]:
                others.append((i, depth, shot.photo.rgb[int(v), int(u)] / 255.0))
        if np.isfinite(nearest):
            near_enough = [(i, rgb) for i, depth, rgb in others if depth < FARTHER * nearest]
            mine = state.learned["colours"].values[row]
            like = [
                np.abs(np.clip(apply_exposure(mine, state.learned["exposure"].values[i]), 0.0, 1.0) - rgb).max() < ALIKE
                for i, rgb in near_enough
            ]
            if sum(like) <= SHOWN_BY * len(like):
                found.append(row)
    return found


@pytest.mark.slow
def test_they_are_those_found_one_by_one() -> None:
    rng = np.random.default_rng(0)
    problem, state = begun(with_parked(), POST)
    dark = np.zeros((street.HEIGHT, street.WIDTH), bool)
    dark[:, 70:] = True
    shots = list(problem.train)
    shots[1] = replace(shots[1], hidden=dark)
    problem = replace(problem, train=tuple(shots))
    for name, size in (("exposure", 0.02), ("poses", 0.02), ("boxes", 0.1)):
        state.learned[name].values += rng.normal(0.0, size, state.learned[name].values.shape).astype(np.float32)
    street_rows = np.flatnonzero(state.owner == BACKGROUND)
    for row in street_rows:
        k = int(rng.integers(N))
        point = before_the_car(k, rng.uniform(0.1, 1.3)) + rng.normal(0.0, [0.3, 0.4, 0.3])
        seen = problem.train[int(rng.integers(N))].photo
        u, v, depth = pixel_of(seen.world_from_camera, seen.intrinsics, point - problem.origin)
        inside = depth > 0.0 and 0.0 <= u < street.WIDTH and 0.0 <= v < street.HEIGHT
        colour = seen.rgb[int(v), int(u)] / 255.0 if inside else rng.uniform(size=3)
        put(problem, state, point, colour + rng.normal(0.0, 0.02, 3), row, rng.choice([0.01, 0.1, 0.9]))
    state.road[street_rows] = rng.random(len(street_rows)) < 0.1
    expected = slow_floaters(problem, state)
    assert 50 < len(expected) < 0.7 * len(street_rows)
    np.testing.assert_array_equal(find_floaters(problem, state), expected)


def test_a_rag_before_the_car_is_one_and_what_other_photos_show_there_is_not(with_post: Prepared) -> None:
    for colour, expected in ((RAG, [0]), (GREEN, [])):
        problem, state = alone(with_post, POST, colour)
        np.testing.assert_array_equal(find_floaters(problem, state), expected)


def test_a_rag_that_only_photos_show_in_which_it_hides_the_car_is_one(prepared: Prepared) -> None:
    problem, state = alone(prepared, before_the_car(0, 0.15), RAG)
    np.testing.assert_array_equal(find_floaters(problem, state), [0])


@pytest.mark.parametrize(
    ("share", "opacity", "road"),
    [(0.95, 0.9, False), (1.6, 0.9, False), (0.5, 0.5 * LEAST_OPACITY, False), (0.5, 0.9, True)],
    ids=["on the body", "behind it", "transparent", "of the road"],
)
def test_what_hides_no_body_stays(prepared: Prepared, share: float, opacity: float, road: bool) -> None:
    problem, state = alone(prepared, before_the_car(0, share), RAG, opacity)
    state.road[0] = road
    assert len(find_floaters(problem, state)) == 0


def test_what_hides_a_parked_car_stays() -> None:
    moving = street.tracks()
    parked = replace(moving, boxes=np.repeat(moving.boxes[:1], moving.n_steps, axis=0))
    problem, state = alone(begun(parked), before_the_car(0), RAG)
    assert len(find_floaters(problem, state)) == 0


def test_colours_are_compared_as_each_photo_is_exposed(with_post: Prepared) -> None:
    """All photos are half as bright as the scene: the green post is one of twice its colour."""
    problem, state = alone(with_post, POST, 2.0 * GREEN)
    np.testing.assert_array_equal(find_floaters(problem, state), [0])
    state.learned["exposure"].values[:, [0, 4, 8]] = -0.5
    assert len(find_floaters(problem, state)) == 0


def test_floaters_become_transparent_and_forget_how_they_were_moved(prepared: Prepared) -> None:
    problem, state = alone(prepared, before_the_car(0), RAG)
    before = fresh(state)
    for name in ("first", "second"):
        getattr(state.learned["logits"], name)[:] = 1.0
    add_to_average(state)
    assert fade_floaters(problem, state) == 1
    logits = state.learned["logits"]
    assert state.averages["logits"][0] == GONE_LOGIT
    assert logits.values[0] == GONE_LOGIT and logits.first[0] == logits.second[0] == 0.0
    assert (logits.first[1:] == 1.0).all()
    np.testing.assert_array_equal(logits.values[1:], before.learned["logits"].values[1:])


@pytest.mark.parametrize(
    ("at", "backend"),
    [(5, lambda: None), (25, lambda: None), (5, lambda: TorchBackend(by_kernels, "cpu"))],
    ids=["early", "late", "early on torch"],
)
def test_the_fit_clears_them_as_long_as_it_goes_on(
    prepared: Prepared, at: int, backend: Callable[[], FitBackend | None]
) -> None:
    """Also when Gaussians are no longer put elsewhere: a rag from just before `at` is not there at its end."""
    problem, state = prepared[0], fresh(prepared[1])
    assert 5 < REFINE_UNTIL * SETTINGS.iterations < 25
    run_iterations(problem, state, SETTINGS, at - 1, backend=backend())
    put(problem, state, before_the_car(0), RAG)
    run_iterations(problem, state, SETTINGS, at, backend=backend())
    away = np.linalg.norm(state.learned["colours"].values - RAG, axis=1)
    opacities = opacities_of(state.learned["logits"].values[:, 0])
    assert not (opacities[away < 0.1] > LEAST_OPACITY).any()


def test_the_last_iteration_clears_nothing(prepared: Prepared) -> None:
    """What it leaves behind, no iteration would fill."""
    problem, state = prepared[0], fresh(prepared[1])
    run_iterations(problem, state, SETTINGS, SETTINGS.iterations - 1)
    put(problem, state, before_the_car(0), RAG)
    run_iterations(problem, state, SETTINGS, SETTINGS.iterations)
    assert opacities_of(state.learned["logits"].values[0])[0] > 0.5
