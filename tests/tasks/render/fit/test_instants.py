"""Cameras of one instant that do not agree about brightness."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.fit.corrections import (
    apply_exposure,
    estimate_exposures,
    group_by_instant,
    invert_exposure,
    with_common_exposure,
)
from tasks.render.fit.start import prepare_fit
from tasks.render.scene.depth import estimate_photo_depth
from tasks.render.scene.features import SurfacePoints
from tasks.render.scene.sensed import Photo, Tracks, fuse_sweeps
from tasks.render.settings import FitSettings

DARKER = np.array([-0.3, 0, 0, 0, -0.25, 0, 0, 0, -0.2, 0.02, 0.0, 0.01], np.float32)


def developed(photo: Photo, row: np.ndarray) -> Photo:
    rgb = np.clip(apply_exposure(photo.rgb.astype(np.float32) / 255.0, row), 0.0, 1.0)
    return replace(photo, rgb=np.rint(255 * rgb).astype(np.uint8))


def pair() -> list[Photo]:
    """Two cameras, half a metre apart, at one instant; the right one is darker."""
    left = street.photo(2.0, 0.25, 0.5, with_car=False)
    right = replace(street.photo(2.0, -0.25, 0.5, with_car=False), camera="right")
    return [left, developed(right, DARKER)]


def test_an_instant_holds_each_camera_once() -> None:
    at = [("a", 0.00), ("b", 0.01), ("a", 0.02), ("b", 0.10), ("a", 0.12)]
    photos = [replace(pair()[0], camera=name, time_s=time) for name, time in at]
    assert group_by_instant(photos) == [[0, 1], [2], [3, 4]]


def test_photos_of_an_instant_come_out_alike_on_what_both_see() -> None:
    photos = pair()
    tracks = Tracks(None, np.zeros(3))
    static, _ = fuse_sweeps([street.sweep(x, 0.1 * x, with_car=False) for x in (0.0, 1.0, 2.0, 3.0)], tracks)
    seen = [estimate_photo_depth(p, photos, SurfacePoints(static), {}, tracks, 1) for p in photos]
    rows = estimate_exposures(photos, seen, static)
    alike = with_common_exposure(photos, rows)
    ground = slice(50, 70), slice(20, 100)

    def off(a: Photo, b: Photo) -> float:
        return float(np.abs(a.light[ground].mean(axis=(0, 1)) - b.light[ground].mean(axis=(0, 1))).max())

    assert off(*alike) < 0.15 * off(*photos)
    for photo, row, common in zip(photos, rows, alike):
        back = 255.0 * apply_exposure(common.light, row)
        assert np.abs(back - photo.rgb).max() < 1e-2, "its exposure gives the photo back, its brightest pixels too"


def test_what_a_dark_photo_shows_white_is_brighter_than_white_and_nothing_is_darker_than_black() -> None:
    gains, offset = np.diag([0.75, 0.5, 0.6]), np.full(3, 0.1)
    row = np.concatenate([(gains - np.eye(3)).ravel(), offset]).astype(np.float32)
    photo = replace(pair()[0], rgb=np.full((2, 2, 3), 255, np.uint8))
    photo.rgb[1] = 0
    (common,) = with_common_exposure([photo], row[None])
    np.testing.assert_allclose(common.light[0, 0], [1.2, 1.8, 1.5], rtol=1e-6)
    assert (common.light[1] == 0.0).all() and (photo.light.max(), photo.light.min()) == (1.0, 0.0)


def test_a_camera_that_exposes_anew_is_followed_from_photo_to_photo() -> None:
    places, gains = (0.0, 0.5, 1.0, 1.5, 2.0), (1.0, 0.7, 1.1, 0.8, 1.0)
    true = [street.photo(x, 0.25, x, with_car=False) for x in places]
    photos = [developed(p, np.float32([*((g - 1.0) * np.eye(3)).ravel(), 0, 0, 0])) for p, g in zip(true, gains)]
    tracks = Tracks(None, np.zeros(3))
    static, _ = fuse_sweeps([street.sweep(x, 0.1 * x, with_car=False) for x in (0.0, 1.0, 2.0, 3.0)], tracks)
    seen = [estimate_photo_depth(p, photos, SurfacePoints(static), {}, tracks, 1) for p in photos]
    rows = estimate_exposures(photos, seen, static)
    found = 1.0 + rows[:, 0]
    np.testing.assert_allclose(found / found.mean(), np.array(gains) / np.mean(gains), rtol=0.03)
    alike = [a.light.mean() / b.light.mean() for a, b in zip(with_common_exposure(photos, rows), true)]
    assert np.ptp(alike) < 0.04 < np.ptp(gains)


def test_one_camera_alone_is_left_as_it_is() -> None:
    photos, sweeps = street.drive(3, with_car=False)
    _, state = prepare_fit(photos, sweeps, None, FitSettings(start_gaussians=200, stereo_photos=1), held_out=[])
    assert not state.learned["exposure"].values.any()


def test_the_fit_begins_with_the_exposures_of_its_photos() -> None:
    photos = pair() + [replace(p, time_s=1.0) for p in pair()]
    sweeps = [street.sweep(x, 0.1 * x, with_car=False) for x in (0.0, 1.0, 2.0)]
    _, state = prepare_fit(photos, sweeps, None, FitSettings(start_gaussians=200, stereo_photos=1), held_out=[])
    rows = state.learned["exposure"].values
    grey = np.full((1, 3), 0.4, np.float32)
    common = apply_exposure(grey, invert_exposure(rows[0]))  # what the left camera shows as this grey
    np.testing.assert_allclose(apply_exposure(common, rows[1]), apply_exposure(grey, DARKER), atol=0.02)
    assert state.learned["exposure"].values[0] == pytest.approx(state.learned["exposure"].values[2])
