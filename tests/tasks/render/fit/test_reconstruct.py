"""The loop, on a few small photos of the closed-form street."""

import math
from dataclasses import replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray

from tasks.render.fit.backend import CpuBackend
from tasks.render.fit.reconstruct import (
    REFINE_UNTIL,
    draw_photo,
    finish_scene,
    interpolated_corrections,
    photo_of_iteration,
    run_iterations,
)
from tasks.render.fit.start import FitProblem, prepare_fit
from tasks.render.fit.state import BETA1, SHAPES, SLACK_M, FitState, add_to_average, height_above_road
from tasks.render.scene.asset import psnr
from tasks.render.scene.engine import render
from tasks.render.scene.movers import PlacedAgents
from tasks.render.scene.sensed import Photo, Sweep, Tracks
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import moved, turned_quats
from tasks.world.clip import AgentKind, Pinhole

SETTINGS = FitSettings(
    iterations=24,
    start_gaussians=1500,
    most_gaussians=2200,
    refine_every=6,
    refine_from=6,
    pose_from=4,
    stereo_photos=1,
)


def few() -> tuple[list[Photo], list[Sweep]]:
    """Every other row and column of five photos."""
    photos, sweeps = street.drive(5)
    half = np.diag([0.5, 0.5, 1.0])
    small = [replace(p, rgb=np.ascontiguousarray(p.rgb[::2, ::2]), intrinsics=half @ p.intrinsics) for p in photos]
    return small, sweeps[::2]


@pytest.fixture(scope="module")
def prepared() -> tuple[FitProblem, FitState]:
    photos, sweeps = few()
    return prepare_fit(photos, sweeps, street.tracks(), SETTINGS, held_out=[2])


def fresh(state: FitState) -> FitState:
    return FitState.from_arrays(state.arrays())


def test_a_held_out_photo_comes_out_better_with_every_round(prepared: tuple[FitProblem, FitState]) -> None:
    problem, state = prepared[0], fresh(prepared[1])
    shot = problem.held_out[0]
    scores = []
    for until in (0, 8, 24):
        run_iterations(problem, state, SETTINGS, until)
        scores.append(psnr(street.picture_of(problem, state, shot.photo), shot.compared.target.rgb))
    assert scores[1] > scores[0] + 1.0
    assert scores[2] > scores[1]
    assert len(state) > len(prepared[1])
    assert finish_scene(problem, state).psnr_db == pytest.approx(scores[2], abs=0.02)  # the camera's mean colours


def test_where_photos_look_is_kept_only_while_they_are_taken_from_there(
    prepared: tuple[FitProblem, FitState], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, state, keeping = prepared[0], fresh(prepared[1]), CpuBackend()
    for turn in (0.0, 0.0, 0.02):
        state.learned["poses"].values[1, 3:] = turn
        found = keeping.derivatives(problem, state, 1, SETTINGS)
        with monkeypatch.context() as patched:
            patched.setattr("tasks.render.fit.backend.SKY_KEPT", 0)
            looked_up = CpuBackend().derivatives(problem, state, 1, SETTINGS)
        assert len(found.cells) > 100 and found.loss == looked_up.loss
        for name in ("camera", "cells", "sky"):
            np.testing.assert_array_equal(getattr(found, name), getattr(looked_up, name))


def test_a_fit_that_was_stored_and_resumed_equals_the_uninterrupted_one_bit_for_bit(
    prepared: tuple[FitProblem, FitState],
) -> None:
    problem = prepared[0]
    straight, broken = fresh(prepared[1]), fresh(prepared[1])
    run_iterations(problem, straight, SETTINGS, SETTINGS.iterations)
    for until in (1, 7, 15, 21, SETTINGS.iterations):
        broken = FitState.from_arrays(broken.arrays())
        run_iterations(problem, broken, SETTINGS, until)
    assert straight.arrays().keys() == broken.arrays().keys()
    for name, array in straight.arrays().items():
        np.testing.assert_array_equal(array, broken.arrays()[name], err_msg=name)


def test_the_scene_is_the_mean_of_what_was_learned_once_nothing_is_relocated(
    prepared: tuple[FitProblem, FitState], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noted every hundredth of the fit, here after each iteration: all that is learned, of the last fifth."""
    problem, state = prepared[0], fresh(prepared[1])
    settled = fresh(state)
    run_iterations(problem, settled, SETTINGS, SETTINGS.iterations)
    monkeypatch.setattr(FitState, "apply_average", lambda self, road: None)
    noted: dict[str, list[NDArray[np.float32]]] = {name: [] for name in state.learned}
    first = math.floor(REFINE_UNTIL * SETTINGS.iterations) + 1
    for until in range(first, SETTINGS.iterations + 1):
        run_iterations(problem, state, SETTINGS, until)
        for name, values in noted.items():
            values.append(state.learned[name].values.copy())
    assert len(noted["sky"]) == 5
    for name, values in noted.items():
        rows = ~settled.road if name in SHAPES else np.ones(len(values[0]), bool)  # what lies on the road is laid on it
        np.testing.assert_allclose(
            settled.learned[name].values[rows], np.mean(values, axis=0)[rows], rtol=1e-5, atol=1e-6, err_msg=name
        )


def test_a_turn_and_its_negative_are_one_on_average(prepared: tuple[FitProblem, FitState]) -> None:
    state = fresh(prepared[1])
    before = state.learned["quats"].values.copy()
    add_to_average(state)
    state.learned["quats"].values[::2] *= -1.0
    add_to_average(state)
    state.apply_average(None)
    np.testing.assert_allclose(state.learned["quats"].values, before, rtol=1e-6)


def test_what_lies_on_the_road_lies_on_it_on_average(prepared: tuple[FitProblem, FitState]) -> None:
    problem, state = prepared[0], fresh(prepared[1])
    add_to_average(state)
    state.averages["means"][state.road, 2] += 0.5
    state.apply_average(problem.road)
    assert problem.road is not None and state.road.sum() > 100
    away = height_above_road(state.learned["means"].values[state.road].astype(np.float64), problem.road)
    assert np.nanmax(np.abs(away)) < SLACK_M + 1e-4


def test_a_picture_is_shown_with_the_exposure_that_was_learned_for_its_camera(
    prepared: tuple[FitProblem, FitState],
) -> None:
    """Twice as bright, and a little blue added."""
    problem, state = prepared[0], fresh(prepared[1])
    photo = problem.held_out[0].photo
    plain = street.picture_of(problem, state, photo)
    row = np.zeros(12, np.float32)
    row[[0, 4, 8]], row[11] = 1.0, 0.05
    state.learned["exposure"].values[:] = row
    expected = np.clip(2.0 * plain + np.array([0.0, 0.0, 0.05], np.float32), 0.0, 1.0)
    np.testing.assert_allclose(street.picture_of(problem, state, photo), expected, atol=1e-5)
    asset = finish_scene(problem, state)
    exposures = asset.exposures
    assert len(exposures) == len(problem.train)
    for exposure, shot in zip(exposures, problem.train):
        assert (exposure.camera, exposure.time_s) == (shot.photo.camera, shot.photo.time_s)
        np.testing.assert_allclose(exposure.affine, np.eye(3, 4), atol=1e-6)
    darker = np.maximum(prepared[1].gaussians().colours, 0.0)
    assert asset.background.colours.max() == pytest.approx(2.0 * darker[state.owner < 0].max(), abs=0.06)


def test_the_scene_s_own_colours_are_those_of_photos_and_each_camera_keeps_its_mean_difference(
    prepared: tuple[FitProblem, FitState],
) -> None:
    """Two cameras about one light: whatever common gain was learned, each shows its photos' colours of that time."""
    problem, state = prepared[0], fresh(prepared[1])
    named = [replace(shot, photo=replace(shot.photo, camera=name)) for shot, name in zip(problem.train, "abba")]
    problem = replace(problem, train=tuple(named))
    state.learned["colours"].values[:] = np.clip(state.learned["colours"].values, 0.0, 1.0) / 3.0
    state.learned["sky"].values[:] /= 3.0
    rows = state.learned["exposure"].values
    rows[:] = 0.0
    for gain, row in zip((3.3, 2.6, 2.8, 3.3), rows):
        row[[0, 4, 8]] = gain - 1.0
    asset = finish_scene(problem, state)
    (first, second) = (shot.photo.time_s for shot in problem.train if shot.photo.camera == "b")
    gains = [asset.affine_of("b", time_s)[0, 0] for time_s in (first, 0.5 * (first + second), second)]
    np.testing.assert_allclose(gains, [2.6 / 3.0, 0.9, 2.8 / 3.0], atol=1e-3)
    assert asset.affine_of("a", first)[0, 0] == pytest.approx(1.1, abs=1e-3)
    for shot in problem.train:
        photo = shot.photo
        shown = draw_photo(asset, problem, photo, photo.world_from_camera)
        np.testing.assert_allclose(shown, street.picture_of(problem, state, photo), atol=2e-3)


def test_a_photo_takes_the_corrections_of_its_own_camera(prepared: tuple[FitProblem, FitState]) -> None:
    """Of four photos the second and the third are another camera's; between its own, a correction is their mean."""
    problem, state = prepared[0], fresh(prepared[1])
    named = [replace(shot, photo=replace(shot.photo, camera=name)) for shot, name in zip(problem.train, "abba")]
    times = [shot.photo.time_s for shot in named]
    for learned in ("poses", "exposure"):
        state.learned[learned].values[:] = np.array([[1.0], [2.0], [4.0], [8.0]])
    mixed = replace(problem, train=tuple(named))
    for camera, time_s, expected in (("a", times[0], 1.0), ("b", times[1], 2.0), ("a", (times[0] + times[3]) / 2, 4.5)):
        for row in interpolated_corrections(mixed, state, camera, time_s):
            np.testing.assert_allclose(row, expected, rtol=1e-6)
    assert not np.concatenate(interpolated_corrections(mixed, state, "nobody's", times[0])).any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_exposure_that_is_off_is_corrected_and_only_the_photo_s_that_was_looked_at(
    prepared: tuple[FitProblem, FitState], sign: float
) -> None:
    """Too bright: darker, and the other way round; by the rate, as Adam's first step is."""
    problem, state = prepared[0], fresh(prepared[1])
    row = photo_of_iteration(0, len(problem.train), SETTINGS.seed)
    offsets = state.learned["exposure"].values[:, 9:]
    offsets[:] = 0.3 * sign
    before = offsets.copy()
    run_iterations(problem, state, SETTINGS, 1)
    np.testing.assert_allclose(offsets[row] - before[row], -sign * SETTINGS.exposure_rate, rtol=1e-3)
    others = np.arange(len(offsets)) != row
    assert np.array_equal(offsets[others], before[others])


def test_a_camera_keeps_its_pose_until_pose_from_and_then_shifts_and_turns_at_rates_of_their_own(
    prepared: tuple[FitProblem, FitState],
) -> None:
    problem, state = prepared[0], fresh(prepared[1])
    poses = state.learned["poses"].values
    run_iterations(problem, state, SETTINGS, SETTINGS.pose_from)
    assert not poses.any()
    row = photo_of_iteration(SETTINGS.pose_from, len(problem.train), SETTINGS.seed)
    run_iterations(problem, state, SETTINGS, SETTINGS.pose_from + 1)
    fall = SETTINGS.rate_end ** (SETTINGS.pose_from / SETTINGS.iterations)
    rates = fall * np.repeat([SETTINGS.shift_rate, SETTINGS.turn_rate], 3)
    np.testing.assert_allclose(np.abs(poses[row]), rates, rtol=1e-3)
    assert not np.delete(poses, row, axis=0).any()


@pytest.mark.parametrize(("iterations", "times"), [(16_000, 1.0), (8_000, 1.0), (2_000, 2.0), (500, 4.0), (24, 4.0)])
def test_sizes_step_farther_in_short_fits(prepared: tuple[FitProblem, FitState], iterations: int, times: float) -> None:
    problem, state = prepared[0], fresh(prepared[1])
    before = {name: state.learned[name].values[state.owner < 0].copy() for name in ("log_scales", "logits")}
    run_iterations(problem, state, replace(SETTINGS, iterations=iterations), until=1)
    moved_by = {name: np.abs(state.learned[name].values[state.owner < 0] - before[name]).max() for name in before}
    assert moved_by["log_scales"] == pytest.approx(times * SETTINGS.scale_rate, rel=1e-3)  # Adam's first step
    assert moved_by["logits"] == pytest.approx(SETTINGS.opacity_rate, rel=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_camera_that_was_turned_away_turns_back(prepared: tuple[FitProblem, FitState], sign: float) -> None:
    """By 2 degrees to either side, of a scene that is fitted so far."""
    problem, state = prepared[0], fresh(prepared[1])
    run_iterations(problem, state, replace(SETTINGS, pose_from=100), 20)
    row = photo_of_iteration(20, len(problem.train), SETTINGS.seed)
    poses = state.learned["poses"].values
    poses[row, 4] = sign * np.radians(2.0)
    run_iterations(problem, state, replace(SETTINGS, pose_from=20), 21)
    assert np.sign(poses[row, 4] - sign * np.radians(2.0)) == -sign


def test_a_car_is_learned_in_its_own_box_and_can_be_put_elsewhere(prepared: tuple[FitProblem, FitState]) -> None:
    problem, state = prepared[0], fresh(prepared[1])
    start = state.learned["colours"].values[state.owner == 0].copy()
    run_iterations(problem, state, replace(SETTINGS, refine_from=1000), 12)
    assert not np.array_equal(start, state.learned["colours"].values[state.owner == 0])
    asset = finish_scene(problem, state)
    box = street.car_box(0.0)
    box[:2] = 14.0, -2.0
    photo = problem.train[0].photo
    pose = photo.world_from_camera.copy()
    pose[:3, 3] += problem.origin
    moved = PlacedAgents(("car",), (AgentKind.VEHICLE,), box[None])
    picture = render(asset, [Pinhole(photo.intrinsics, pose, 64, 36)], moved)[0].rgb
    u = int(50 * (1.0 * 2.0 / 12.0) + 32)  # 2 m to the right, 12 m ahead of the camera
    red, green, _ = picture[19:22, u - 1 : u + 2].mean(axis=(0, 1))
    assert red > 2.0 * green


def test_a_vehicle_s_gradients_are_turned_into_its_own_frame(prepared: tuple[FitProblem, FitState]) -> None:
    """The same car in the same place, held in a box that is turned: its gradients turn against the box.

    With x = R y the chain rule is dL/dy = R^T dL/dx, and for a quaternion likewise. Adam's first moment after one step
    tells the gradient that the fit went by.
    """
    problem, state = prepared[0], fresh(prepared[1])
    angle, mine = np.radians(110.0), np.flatnonzero(state.owner == 0)
    back = np.eye(4)
    back[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    agents = street.tracks()
    boxes = agents.boxes.copy()
    boxes[..., 2] += angle
    turned_box = replace(problem, tracks=Tracks(replace(agents, boxes=boxes), problem.origin))
    turned_car = fresh(state)
    in_box = moved(state.gaussians().take(mine), back)
    for name, values in (("means", in_box.means), ("quats", in_box.quats)):
        turned_car.learned[name].values[mine] = values.reshape(len(mine), -1)

    def gradients(problem: FitProblem, state: FitState) -> dict[str, NDArray[np.float64]]:
        stepped = fresh(state)
        for name in SHAPES:
            stepped.learned[name].forget(np.arange(len(state)))
        run_iterations(problem, stepped, SETTINGS, state.iteration + 1)
        return {name: stepped.learned[name].first.astype(float) / (1.0 - BETA1) for name in SHAPES}

    own, turned = gradients(problem, state), gradients(turned_box, turned_car)
    expected = {
        "means": own["means"][mine] @ back[:3, :3].T,
        "quats": turned_quats(np.array([np.cos(angle / 2), 0.0, 0.0, -np.sin(angle / 2)]), own["quats"][mine]),
    }
    for name in SHAPES:
        wanted = expected.get(name, own[name][mine])
        size = np.linalg.norm(wanted)
        assert size > 0.0, f"the photo says nothing of the car's {name}"
        assert np.linalg.norm(turned[name][mine] - wanted) < 0.01 * size, name  # float32, and discs as thin as paper
        rest = np.delete(own[name], mine, axis=0)
        np.testing.assert_allclose(np.delete(turned[name], mine, axis=0), rest, atol=0.01 * abs(rest).max())


def test_progress_is_told_and_photos_are_needed() -> None:
    with pytest.raises(ValueError, match="none to learn from"):
        prepare_fit([], [], None, SETTINGS)
    with pytest.raises(ValueError, match="iterations"):
        FitSettings(iterations=0)


def test_a_plain_road_can_start_with_fewer_and_larger_gaussians() -> None:
    photos, sweeps = few()
    sparse, usual = (
        prepare_fit(photos, sweeps, street.tracks(), replace(SETTINGS, road_share=share), held_out=[2])[1]
        for share in (0.25, 1.0)
    )
    assert len(sparse) == len(usual)
    assert sparse.road.sum() < 0.7 * usual.road.sum()
    sizes = [np.median(state.learned["log_scales"].values[state.road, 0]) for state in (sparse, usual)]
    assert sizes[0] > sizes[1] + 0.1
    with pytest.raises(ValueError, match="road_share"):
        replace(SETTINGS, road_share=0.0)


def test_without_lidar_the_street_is_fitted_from_parallax_alone() -> None:
    photos, _ = few()
    problem, state = prepare_fit(photos, [], street.tracks(), SETTINGS, held_out=[2])
    started = finish_scene(problem, state).psnr_db
    run_iterations(problem, state, SETTINGS, SETTINGS.iterations)
    fitted = finish_scene(problem, state).psnr_db
    assert fitted > started + 0.5 and fitted > 18.0


def test_gaussians_in_boxes_end_no_longer_than_asked_for(prepared: tuple[FitProblem, FitState]) -> None:
    """Those that a photo has shown; what lies on the road stays thin."""
    problem = prepared[0]
    for most in (2.0, 0.0):
        state = fresh(prepared[1])
        run_iterations(problem, state, replace(SETTINGS, box_stretch=most), SETTINGS.iterations)
        stretch = np.exp(np.ptp(state.learned["log_scales"].values, axis=1))
        shown = np.isfinite(state.nearest) & (state.owner >= 0)
        assert shown.sum() > 100
        assert (stretch[shown].max() <= 2.0 + 1e-4) == (most == 2.0)
        assert stretch[state.road].min() > 2.0


@pytest.mark.parametrize("name", ["stretch", "box_stretch"])
@pytest.mark.parametrize("value", [0.5, -1.0, float("nan")])
def test_a_stretch_below_one_is_no_shape(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"fit {name} must be 0"):
        replace(FitSettings(), **{name: value})
