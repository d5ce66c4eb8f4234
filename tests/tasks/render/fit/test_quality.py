"""What held-out photos are measured by: classes told by geometry, distances, and pixels that do not count."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.reconstruct import (
    ROAD_M,
    distance_to_nearest_m,
    finish_scene,
    measure_photo,
    pixel_classes,
    run_iterations,
)
from tasks.render.fit.start import FitPhoto, FitProblem, prepare_fit
from tasks.render.fit.state import CELL_M, FitState, Road
from tasks.render.scene.asset import ClassQuality, ViewQuality
from tasks.render.settings import FitSettings

SETTINGS = FitSettings(iterations=30, start_gaussians=3000, stereo_photos=1)


def slope(grade: float) -> Road:
    """A road that climbs along x from height 0 at x = 0; known from x = -5 m to 60 m, 8 m to either side."""
    x, y = np.arange(-5.0, 60.0, CELL_M), np.arange(-8.0, 8.0, CELL_M)
    heights = np.repeat(grade * x[:, None], len(y), axis=1)
    slopes = np.zeros((*heights.shape, 2))
    slopes[..., 0] = grade
    return Road(np.array([-5.0, -8.0]), heights, slopes)


@pytest.mark.parametrize("grade", [0.0, 0.03])
def test_road_is_what_meets_its_surface_within_reach(grade: float) -> None:
    photo = street.photo(0.0, 0.0, 0.0)
    found = pixel_classes(photo, np.zeros((0, 7)), slope(grade))
    v, u = np.mgrid[:72, :128] + 0.5
    ray = np.stack([np.ones_like(u), -(u - 64.0) / 100.0, -(v - 36.0) / 100.0], axis=-1)  # ego frame, from (1, 0, 1.5)
    with np.errstate(divide="ignore"):
        length = (1.5 - grade) / (grade * ray[..., 0] - ray[..., 2])
    meets = (length > 0.0) & (length * np.linalg.norm(ray, axis=-1) < ROAD_M) & (np.abs(length * ray[..., 1]) < 7.4)
    assert (found["road"] != meets).mean() < 0.01 and meets.mean() > 0.2
    assert not found["vehicles"].any() and (found["rest"] == ~found["road"]).all()


def test_a_vehicle_is_what_looks_at_its_box_whatever_is_behind() -> None:
    photo, nobody = street.photo(0.0, 0.0, 0.5), street.photo(0.0, 0.0, 0.5, with_car=False)
    found = pixel_classes(photo, street.car_box(0.5)[None], slope(0.0))
    shown = (photo.rgb != nobody.rgb).any(axis=-1)
    assert shown.sum() > 100 and found["vehicles"][shown].all()
    assert found["vehicles"].sum() < 2.0 * shown.sum(), "the box is a little larger than the car"
    together = sum(part.astype(int) for part in found.values())
    assert (together == 1).all()


def test_how_far_away_the_nearest_photo_is_that_looks_the_same_way() -> None:
    photos = [street.photo(x, 0.0, 0.0) for x in (0.0, 4.0, 10.0)]
    assert distance_to_nearest_m(street.photo(5.0, 0.0, 0.0), photos) == pytest.approx(1.0)
    turned = street.photo(5.0, 0.0, 0.0)
    back = turned.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    assert distance_to_nearest_m(replace(turned, world_from_camera=back), photos) == np.inf


@pytest.fixture(scope="module")
def fitted() -> tuple[FitProblem, FitState]:
    photos, sweeps = street.drive(5)
    problem, state = prepare_fit(photos, sweeps, street.tracks(), SETTINGS, held_out=[2])
    run_iterations(problem, state, SETTINGS, SETTINGS.iterations)
    return problem, state


def of(view: ViewQuality, name: str) -> ClassQuality:
    (found,) = (part for part in view.classes if part.name == name)
    return found


def test_each_class_is_measured_on_its_own_pixels(fitted: tuple[FitProblem, FitState]) -> None:
    """A vehicle of a wrong colour costs the vehicles, and the road nothing."""
    problem, state = fitted
    asset = finish_scene(problem, state)
    (view,) = asset.views
    assert (view.camera, view.held_out, view.away_m) == ("front", True, pytest.approx(1.0))
    assert {part.name for part in view.classes} == {"road", "vehicles", "rest"}
    assert sum(part.share for part in view.classes) == pytest.approx(1.0)
    green = {name: replace(node, colours=node.colours[:, ::-1].copy()) for name, node in asset.nodes.items()}
    shot = problem.held_out[0]
    other = measure_photo(replace(asset, nodes=green), problem, shot, shot.photo.world_from_camera)
    same = measure_photo(asset, problem, shot, shot.photo.world_from_camera)
    assert of(other, "vehicles").psnr_db < of(same, "vehicles").psnr_db - 1.0
    assert of(other, "vehicles").ssim < of(same, "vehicles").ssim
    assert of(other, "road").psnr_db == pytest.approx(of(same, "road").psnr_db, abs=0.3)
    assert same.psnr_db > other.psnr_db


def test_pixels_without_weight_are_not_measured(fitted: tuple[FitProblem, FitState]) -> None:
    problem, state = fitted
    asset, shot = finish_scene(problem, state), problem.held_out[0]
    spoilt = shot.photo.rgb.copy()
    spoilt[:20] = 255 - spoilt[:20]
    hidden = np.zeros(spoilt.shape[:2], bool)
    hidden[:20] = True
    pose = shot.photo.world_from_camera
    bad = replace(shot.photo, rgb=spoilt)
    masked = measure_photo(asset, problem, FitPhoto(bad, hidden), pose)
    clean = measure_photo(asset, problem, FitPhoto(shot.photo, hidden), pose)
    assert masked.psnr_db == clean.psnr_db and of(masked, "rest").psnr_db == of(clean, "rest").psnr_db
    seen = measure_photo(asset, problem, FitPhoto(bad, None), pose)
    assert seen.psnr_db < masked.psnr_db - 3.0
