"""Exposure, poses, sky: what is learned about the photos beside the street."""

import numpy as np
import pytest

from tasks.render.fit.backend import backdrop_gradient
from tasks.render.fit.corrections import (
    apply_exposure,
    apply_exposure_gradient,
    chain_exposures,
    corrected_pose,
    interpolate_in_time,
    mean_exposure,
    rigid_motion,
)
from tasks.render.fit.reconstruct import decay, photo_of_iteration
from tasks.render.scene.sky import COLUMNS, ROWS, look_up_sky, sky_cells
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gradient import backward
from tasks.render.splatting.raster import forward

RNG = np.random.default_rng(3)
K = np.array([[20.0, 0.0, 10.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])
SIZE = (20, 16)


def test_exposure_gradient_agrees_with_finite_differences() -> None:
    rgb, upstream = RNG.uniform(0, 1, (4, 5, 3)), RNG.normal(size=(4, 5, 3)).astype(np.float32)
    row = RNG.normal(0.0, 0.1, 12).astype(np.float32)
    d_rgb, d_row = apply_exposure_gradient(rgb.astype(np.float32), row, upstream)
    for k in range(12):
        step = np.zeros(12, np.float32)
        step[k] = 0.01
        both = [apply_exposure(rgb.astype(np.float32), row + sign * step).astype(np.float64) for sign in (1, -1)]
        assert d_row[k] == pytest.approx(((both[0] - both[1]) * upstream).sum() / 0.02, rel=1e-3, abs=1e-3)
    moved = apply_exposure((rgb + 0.01 * d_rgb).astype(np.float32), row) - apply_exposure(rgb.astype(np.float32), row)
    assert (moved * upstream).sum() == pytest.approx(0.01 * (d_rgb**2).sum(), rel=1e-3)


def test_two_rows_after_another_do_what_one_does() -> None:
    rgb = RNG.uniform(0, 1, (5, 3)).astype(np.float32)
    one, two = RNG.normal(0.0, 0.1, (2, 12)).astype(np.float32)
    np.testing.assert_allclose(
        apply_exposure(rgb, chain_exposures(two, one)), apply_exposure(apply_exposure(rgb, one), two), atol=1e-6
    )


def test_each_camera_counts_once_in_the_common_exposure_however_many_photos_it_took() -> None:
    rows = np.zeros((4, 12), np.float32)
    rows[:, 0] = 0.3, 0.3, 0.0, -0.1
    assert mean_exposure(["a", "a", "a", "b"], rows)[0] == pytest.approx(0.05)


def test_a_motion_is_rigid_and_small_ones_add_up() -> None:
    row = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    np.testing.assert_allclose(rigid_motion(row)[:3, :3] @ rigid_motion(row)[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rigid_motion(1e-4 * row) @ rigid_motion(1e-4 * row), rigid_motion(2e-4 * row), atol=1e-7)
    np.testing.assert_array_equal(rigid_motion(np.zeros(6)), np.eye(4))


def test_the_rasterisers_camera_gradient_is_that_of_a_pose_row() -> None:
    """Over scenes: pixels that come over a Gaussian's cut-off as it moves are in the difference alone, some 4 %."""
    upstream = np.ones((SIZE[1], SIZE[0], 3), np.float32) * np.linspace(-1, 1, SIZE[0], dtype=np.float32)[None, :, None]
    black = np.zeros(3, np.float32)

    def scene_of(rng: np.random.Generator, n: int = 30) -> Gaussians:
        depth = rng.uniform(3.0, 9.0, n)
        means = np.stack([rng.uniform(-0.3, 0.3, n) * depth, rng.uniform(-0.3, 0.3, n) * depth, depth], 1)
        return Gaussians(
            means.astype(np.float32),
            np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
            np.full((n, 3), np.log(0.5), np.float32),
            np.full(n, 0.4, np.float32),
            rng.uniform(0, 1, (n, 3)).astype(np.float32),
        )

    def value(scene: Gaussians, row: np.ndarray) -> float:
        view = forward(scene, K, corrected_pose(np.eye(4), row), *SIZE, black).view
        return float((view.rgb.astype(np.float64) * upstream).sum())

    scenes = [scene_of(np.random.default_rng(seed)) for seed in range(20)]
    slopes = sum(backward(forward(scene, K, np.eye(4), *SIZE, black), scene, upstream).camera for scene in scenes)
    for axis in (0, 4):  # to the right, and turned about the vertical: what the upstream looks at
        step = np.zeros(6)
        step[axis] = 3e-3
        measured = sum((value(scene, step) - value(scene, -step)) / 6e-3 for scene in scenes)
        assert slopes[axis] == pytest.approx(measured, rel=0.06)


def test_between_two_photos_a_correction_is_the_mean_of_theirs() -> None:
    rows = np.array([[2.0, 0.0], [0.0, 4.0]], np.float32)
    np.testing.assert_allclose(interpolate_in_time(np.array([1.0, 0.0]), rows, 0.5), [1.0, 2.0])
    np.testing.assert_allclose(interpolate_in_time(np.array([1.0, 0.0]), rows, 7.0), rows[0])


def test_the_sky_s_gradient_is_the_transpose_of_looking_it_up() -> None:
    cells = RNG.uniform(0, 1, (ROWS, COLUMNS, 3)).astype(np.float32)
    pose = rigid_motion(np.array([1.0, 2.0, 3.0, 0.3, -2.9, 0.2]))
    seen = look_up_sky(cells.reshape(-1, 3), sky_cells(K, pose, *SIZE))
    upstream = RNG.normal(size=seen.shape).astype(np.float32)
    alpha = np.full(seen.shape[:2], 0.25, np.float32)
    alpha[:4] = 1.0
    rows, gradient = backdrop_gradient(upstream, alpha, sky_cells(K, pose, *SIZE))
    # The look-up is linear: <upstream, (1 - alpha) backdrop(cells)> = <gradient, cells>.
    assert float((gradient * cells.reshape(-1, 3)[rows]).sum()) == pytest.approx(
        float((upstream * seen)[4:].sum()) * 0.75, rel=1e-3
    )


def test_every_photo_is_looked_at_once_a_round() -> None:
    looked = [photo_of_iteration(i, 7, 5) for i in range(21)]
    assert [sorted(looked[k : k + 7]) for k in (0, 7, 14)] == [list(range(7))] * 3
    assert looked[:7] != looked[7:14]


def test_rates_fall_exponentially() -> None:
    assert [decay(0.01, p) for p in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.1, 0.01])
