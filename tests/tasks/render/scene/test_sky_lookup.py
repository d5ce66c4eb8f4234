"""Looking up the sky, against the same in numpy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.render.scene.sky import (
    COLUMNS,
    LEAST_LIGHT,
    ROWS,
    SkyMap,
    look_up_sky,
    pixel_directions,
    put_sky_behind,
    sky_cells,
)

RNG = np.random.default_rng(4)
SIZE = (53, 31)
K = np.array([[40.0, 0.0, 24.0], [0.0, 43.0, 17.5], [0.0, 0.0, 1.0]])


def slow_lookup(
    sky: SkyMap, pose: NDArray[np.float64], k: NDArray[np.float64] = K, size: tuple[int, int] = SIZE
) -> NDArray[np.float32]:
    """(H, W, 3), linear between the four cells around each direction; columns go round, rows end at the poles."""
    rays = pixel_directions(k, pose, *size)
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    rows, columns = (0.5 - elevation / np.pi) * ROWS - 0.5, (azimuth / (2 * np.pi) + 0.5) * COLUMNS - 0.5
    y0 = np.clip(np.floor(rows).astype(int), 0, ROWS - 2)
    x0 = np.floor(columns).astype(int)
    fy, fx = np.clip(rows - y0, 0.0, 1.0)[..., None], (columns - x0)[..., None]
    left, right = x0 % COLUMNS, (x0 + 1) % COLUMNS
    top = sky.rgb[y0, left] * (1 - fx) + sky.rgb[y0, right] * fx
    bottom = sky.rgb[y0 + 1, left] * (1 - fx) + sky.rgb[y0 + 1, right] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, np.float32)


def finished(
    sky: SkyMap, pose: NDArray[np.float64], threads: int = 1, k: NDArray[np.float64] = K, size: tuple[int, int] = SIZE
) -> NDArray[np.float32]:
    """The sky before nothing."""
    rgb, alpha = np.zeros((*size[::-1], 3), np.float32), np.zeros(size[::-1], np.float32)
    sky.finish(rgb, alpha, np.eye(3, 4), k, pose, threads)
    return rgb


@pytest.mark.parametrize("seed", range(6))
def test_the_sky_is_what_numpy_looks_up(seed: int) -> None:
    """Cameras turned any way, the poles and the seam behind included."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn
    sky = SkyMap(RNG.random((ROWS, COLUMNS, 3)).astype(np.float32))
    seen, looked_up = finished(sky, pose), look_up_sky(sky.cells, sky_cells(K, pose, *SIZE))
    for found in (seen, looked_up):
        np.testing.assert_allclose(found, slow_lookup(sky, pose), atol=1e-5)
    np.testing.assert_array_equal(seen, finished(sky, pose, threads=3))


def test_a_picture_is_finished_in_its_camera_s_colours() -> None:
    """What shines through of the sky, the camera's gain and offset, and nothing beyond black and white."""
    sky = SkyMap(RNG.random((ROWS, COLUMNS, 3)).astype(np.float32))
    behind, alpha = slow_lookup(sky, np.eye(4)), RNG.random(SIZE[::-1]).astype(np.float32)
    light = RNG.random((*SIZE[::-1], 3)).astype(np.float32)
    affine = np.array([[1.6, 0.1, 0.0, -0.9], [-0.1, 1.2, 0.2, -0.5], [0.0, 0.3, 0.8, 0.1]], np.float32)
    expected = (light + (1.0 - alpha[..., None]) * behind) @ affine[:, :3].T + affine[:, 3]
    sky.finish(light, alpha, affine, K, np.eye(4))
    np.testing.assert_allclose(light, np.clip(expected, 0.0, 1.0), atol=0.5 / 255.0)
    assert (light == 0.0).any() and (light == 1.0).any()


def test_a_picture_of_the_fit_gets_the_sky_that_it_lets_through() -> None:
    """Where next to nothing passes, no angle is worked out."""
    sky, alpha = SkyMap(RNG.random((ROWS, COLUMNS, 3)).astype(np.float32)), RNG.random(SIZE[::-1]).astype(np.float32)
    alpha[::3], light = 1.0 - 0.9 * LEAST_LIGHT, RNG.random((*SIZE[::-1], 3)).astype(np.float32)
    expected = light + np.where(1.0 - alpha > LEAST_LIGHT, 1.0 - alpha, 0.0)[..., None] * slow_lookup(sky, np.eye(4))
    where = sky_cells(K, np.eye(4), *SIZE, alpha=alpha)
    put_sky_behind(light, alpha, sky.cells, where)
    np.testing.assert_allclose(light, expected, atol=1e-5)
    assert not where.shares[::3].any() and where.shares[1::3].all()


def test_a_sky_that_nobody_may_write_to_is_seen_all_the_same() -> None:
    rgb = RNG.random((ROWS, COLUMNS, 3)).astype(np.float32)
    seen = finished(SkyMap(rgb), np.eye(4))
    rgb.setflags(write=False)
    np.testing.assert_array_equal(finished(SkyMap(rgb), np.eye(4)), seen)


def test_a_map_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=rf"sky: \(8, 16, 3\), expected \({ROWS}, {COLUMNS}, 3\)"):
        finished(SkyMap(np.zeros((8, 16, 3), np.float32)), np.eye(4))


def test_what_hides_some_of_the_sky_changes_none_of_it_beside() -> None:
    rng, size = np.random.default_rng(7), (211, 120)
    sky, k = SkyMap(rng.random((ROWS, COLUMNS, 3)).astype(np.float32)), np.diag([80.0, 80.0, 1.0])
    k[:2, 2] = 100.0, 50.0
    hidden = np.zeros(size[::-1], bool)
    for row, column, high, wide in rng.integers(0, 100, (8, 4)):
        hidden[row : row + high // 2, column : column + wide // 2] = True
    hidden[:, 150:] = hidden[60:, :40] = True  # rows end behind something, or begin so
    rgb = np.zeros((*hidden.shape, 3), np.float32)
    sky.finish(rgb, hidden.astype(np.float32), np.eye(3, 4), k, np.eye(4))
    all_of_it = finished(sky, np.eye(4), k=k, size=size)
    np.testing.assert_array_equal(rgb, np.where(hidden[..., None], np.float32(0.0), all_of_it))
    assert 0.1 < hidden.mean() < 0.9
