"""Looking up the sky, against the same in numpy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap, pixel_directions

RNG = np.random.default_rng(4)
SIZE = (53, 31)
K = np.array([[40.0, 0.0, 24.0], [0.0, 43.0, 17.5], [0.0, 0.0, 1.0]])


def slow_lookup(sky: SkyMap, pose: NDArray[np.float64]) -> NDArray[np.float32]:
    """(H, W, 3), linear between the four cells around each direction; columns go round, rows end at the poles."""
    rays = pixel_directions(K, pose, *SIZE)
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


@pytest.mark.parametrize("seed", range(6))
def test_the_sky_is_what_numpy_looks_up(seed: int) -> None:
    """Cameras turned any way, the poles and the seam behind included."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn
    sky = SkyMap(RNG.random((ROWS, COLUMNS, 3)).astype(np.float32))
    seen = sky.seen_by(K, pose, *SIZE)
    np.testing.assert_allclose(seen, slow_lookup(sky, pose), atol=1e-6)
    np.testing.assert_array_equal(seen, sky.seen_by(K, pose, *SIZE, threads=3))


def test_a_sky_that_nobody_may_write_to_is_seen_all_the_same() -> None:
    rgb = RNG.random((ROWS, COLUMNS, 3)).astype(np.float32)
    seen = SkyMap(rgb).seen_by(K, np.eye(4), *SIZE)
    rgb.setflags(write=False)
    np.testing.assert_array_equal(SkyMap(rgb).seen_by(K, np.eye(4), *SIZE), seen)


def test_a_map_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=rf"sky: \(8, 16, 3\), expected \({ROWS}, {COLUMNS}, 3\)"):
        SkyMap(np.zeros((8, 16, 3), np.float32)).seen_by(K, np.eye(4), *SIZE)
