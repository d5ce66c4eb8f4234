"""Where boxes are is learned with all else: what was logged beside a vehicle comes to lie on it."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.backend import OwnedGaussians, box_gradient
from tasks.render.fit.reconstruct import finish_scene, learned_box_shifts, run_iterations, split_box_shifts
from tasks.render.fit.start import FitProblem, prepare_fit
from tasks.render.fit.state import FitState
from tasks.render.scene.movers import KNOT_S, SHIFT_SIZE, shift_boxes, world_from_boxes
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import quats_of, turned_quats
from tasks.world.arrays import Array
from tasks.world.clip import AgentTracks
from tests.tasks.render.fit.test_reconstruct import fresh

SETTINGS = FitSettings(
    iterations=160,
    start_gaussians=1500,
    most_gaussians=1500,
    start_node_gaussians=600,
    stereo_photos=1,
    pose_from=40,
    shift_rate=0.0,
    turn_rate=0.0,
    exposure_rate=0.0,
    box_shift_rate=4e-2,
)
N = 6  # photos, every 0.25 s: the car 9 to 14 m ahead


def logged_beside() -> AgentTracks:
    """The car's boxes, at every other knot 0.2 m too far left, at the others too far right."""
    tracks = street.tracks()
    boxes = tracks.boxes.copy()
    at = np.arange(tracks.n_steps) * 0.1 / KNOT_S
    boxes[:, 0, 1] += np.interp(at, np.arange(64), 0.2 * (-1.0) ** np.arange(64))
    return replace(tracks, boxes=boxes)


@pytest.fixture(scope="module")
def beside() -> tuple[FitProblem, FitState]:
    photos, _ = street.drive(N)
    return prepare_fit(photos, street.drive(N)[1], logged_beside(), SETTINGS, held_out=[3])


def test_the_derivative_by_a_box_is_that_of_where_its_gaussians_come_to_lie() -> None:
    """Central differences of a loss that is linear in places and sides, by way of the frames that the fit uses."""
    rng = np.random.default_rng(0)
    means, quats, by_means, by_quats = (rng.normal(size=(7, size)) for size in (3, 4, 3, 4))
    box, off = np.array([[9.0, 2.5, 0.8, 0.4, 4.4, 1.9, 1.6]]), np.array([0.3, -0.2, 0.1, 0.2])

    def frame(by: Array) -> Array:
        return world_from_boxes(shift_boxes(box, by[None]))[0]

    def loss(by: Array) -> float:
        to = frame(by)
        there = means @ to[:3, :3].T + to[:3, 3]
        return float((by_means * there).sum() + (by_quats * turned_quats(quats_of(to[None, :3, :3])[0], quats)).sum())

    to = frame(off)
    part = OwnedGaussians(0, np.arange(7), to, 0, off.astype(np.float32))
    back = turned_quats(quats_of(to[None, :3, :3].transpose(0, 2, 1))[0], by_quats)
    shift, turn = box_gradient(part, means, quats, by_means @ to[:3, :3], back)
    steps = 1e-6 * np.eye(SHIFT_SIZE)
    measured = [(loss(off + step) - loss(off - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose([*shift, turn], measured, rtol=1e-6)


@pytest.mark.slow
def test_a_box_logged_beside_its_vehicle_comes_to_lie_on_it(beside: tuple[FitProblem, FitState]) -> None:
    problem = beside[0]
    as_logged, found = fresh(beside[1]), fresh(beside[1])
    run_iterations(problem, as_logged, replace(SETTINGS, box_shift_rate=0.0, box_turn_rate=0.0), SETTINGS.iterations)
    run_iterations(problem, found, SETTINGS, SETTINGS.iterations)
    assert not as_logged.learned["boxes"].values.any()
    _, shifts = split_box_shifts(problem, found)
    logged_off = 0.2 * np.array([1.0, -1.0, 1.0])  # of which the mean is how the vehicle lies in its box
    expected = logged_off.mean() - logged_off
    assert np.abs(shifts.rows[0, : N // 2, 1] - expected).max() < 0.5 * np.abs(expected).max()
    views = {name: finish_scene(problem, state).views[0] for name, state in (("logged", as_logged), ("found", found))}
    vehicle = {name: next(c.psnr_db for c in view.classes if c.name == "vehicles") for name, view in views.items()}
    assert vehicle["found"] > vehicle["logged"] + 0.5


def test_a_scene_looks_the_same_whatever_a_box_is_off_by_on_average(beside: tuple[FitProblem, FitState]) -> None:
    """The mean goes to the Gaussians, what is left to the boxes: no picture knows."""
    problem, state = beside[0], fresh(beside[1])
    rng, learned = np.random.default_rng(1), state.learned["boxes"]
    learned.values[:] = rng.normal(0.0, [0.1, 0.1, 0.05, 0.05], learned.values.shape)
    learned.steps[: N // 2] = 1
    _, shifts = split_box_shifts(problem, state)
    assert shifts.track_ids == ("car",)
    np.testing.assert_allclose(shifts.rows[0, : N // 2].mean(axis=0), 0.0, atol=1e-6)
    view, photo = finish_scene(problem, state).views[0], problem.held_out[0]
    seen = street.picture_of(problem, state, photo.photo)
    rgb = photo.compared.target.rgb
    assert view.psnr_db == pytest.approx(-10.0 * np.log10(np.mean((seen - rgb) ** 2)), abs=1e-3)


def test_a_knot_without_photos_lies_between_its_neighbours(beside: tuple[FitProblem, FitState]) -> None:
    problem, state = beside[0], fresh(beside[1])
    learned = state.learned["boxes"]
    learned.values[[1, 3], 1], learned.values[2] = [0.1, 0.3], 9.0
    learned.steps[[1, 3]] = 1
    off = learned_box_shifts(problem, state)[:, 1]
    np.testing.assert_allclose(off[:5], [0.1, 0.1, 0.2, 0.3, 0.3], atol=1e-7)
    assert off[-1] == off[3]
