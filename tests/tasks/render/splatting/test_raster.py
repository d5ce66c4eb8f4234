"""The tile rasteriser against a slow, obvious twin, and against what can be said in closed form."""

import numpy as np
import pytest
import slow_raster
import torch
from numpy.typing import NDArray

from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import CLASSIC, FITTED, MIN_ALPHA, ScreenFilter
from tasks.render.splatting.raster import forward

INTRINSICS = np.array([[60.0, 0.0, 37.0], [0.0, 58.0, 22.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 75, 45  # no multiple of a tile
BLACK = np.zeros(3, np.float32)


def cloud(n: int, seed: int, sigma: float = 0.15) -> Gaussians:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(-1.0, 25.0, n)  # some behind the camera
    means = np.stack([rng.uniform(-0.8, 0.8, n) * depth, rng.uniform(-0.5, 0.5, n) * depth, depth], 1)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        means.astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.log(sigma * rng.uniform(0.2, 2.0, (n, 3))).astype(np.float32),
        rng.uniform(0.05, 0.98, n).astype(np.float32),
        rng.uniform(0.0, 1.0, (n, 3)).astype(np.float32),
    )


def pose(yaw: float, position: tuple[float, float, float]) -> NDArray[np.float64]:
    c, s = np.cos(yaw), np.sin(yaw)
    out = np.eye(4)
    out[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    out[:3, 3] = position
    return out


def slow_rasterize(
    gaussians: Gaussians,
    scene_from_camera: NDArray[np.float64],
    background: NDArray[np.float32],
    screen: ScreenFilter = FITTED,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Every Gaussian on every pixel, in float64, nearest first."""
    behind = torch.tensor(background, dtype=torch.float64)
    scene = slow_raster.slow(gaussians, grad=False)
    rgb, depth, alpha = slow_raster.slow_render(scene, INTRINSICS, scene_from_camera, behind, screen=screen)
    return rgb.numpy(), depth.numpy(), alpha.numpy()


@pytest.mark.parametrize("screen", [FITTED, CLASSIC])
@pytest.mark.parametrize(("n", "sigma"), [(40, 0.6), (800, 0.15), (1500, 0.5), (1500, 0.02)])
def test_the_kernel_equals_its_slow_twin(n: int, sigma: float, screen: ScreenFilter) -> None:
    scene, view = cloud(n, seed=n, sigma=sigma), pose(0.2, (0.3, -0.1, -0.5))
    background = np.random.default_rng(1).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    fast = forward(scene, INTRINSICS, view, WIDTH, HEIGHT, background, screen=screen).view
    rgb, depth, alpha = slow_rasterize(scene, view, background, screen)
    assert np.abs(fast.rgb - rgb).max() <= 2.0 / 255.0
    assert np.abs(fast.alpha - alpha).max() <= 2.0 / 255.0
    solid = alpha > 0.05
    assert np.abs(fast.depth - depth)[solid].max() <= 0.1
    assert np.median(np.abs(fast.rgb - rgb)) < 1e-4


def one(
    mean: tuple[float, float, float], sigma: float, opacity: float, colour: tuple[float, float, float]
) -> Gaussians:
    return Gaussians(
        np.array([mean], np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), np.log(sigma), np.float32),
        np.array([opacity], np.float32),
        np.array([colour], np.float32),
    )


@pytest.mark.parametrize("metres", [10.0, 20.0, 40.0])
def test_what_is_smaller_than_a_pixel_sheds_the_light_that_its_area_does(metres: float) -> None:
    """The sum of alpha is 2 pi opacity times the root of the determinant before the filter; after it for the classic
    one, which makes a small thing the brighter the farther off it is."""
    ball = one((0.0, 0.0, metres), 0.2, 0.99, (1.0, 1.0, 1.0))
    px = 0.2 * np.array([INTRINSICS[0, 0], INTRINSICS[1, 1]]) / metres
    square = np.array([[INTRINSICS[0, 0], 0.0, 8.0], [0.0, INTRINSICS[1, 1], 8.0], [0.0, 0.0, 1.0]])
    for screen in (ScreenFilter(4.0, True), ScreenFilter(4.0, False)):  # wide enough to be summed up by pixels
        alpha = forward(ball, square, np.eye(4), 16, 16, BLACK, screen=screen).view.alpha
        area = px.prod() if screen.keeps_light else np.sqrt(np.prod(px**2 + 4.0))
        least = 2.0 * np.pi * np.sqrt(np.prod(px**2 + 4.0)) * MIN_ALPHA  # cut off around
        assert alpha.sum() == pytest.approx(max(2.0 * np.pi * 0.99 * area - least, 0.0), rel=0.03)
