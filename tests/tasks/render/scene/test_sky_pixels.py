"""What of a picture may be sky: bright or blue, and smooth where a boarded wall is not."""

import numpy as np

from tasks.render.scene.sky import is_smooth_around, may_be_sky

HEIGHT, WIDTH = 180, 480


def test_sky_is_bright_or_blue() -> None:
    rgb = np.array([[[0.8, 0.8, 0.8], [0.3, 0.4, 0.6], [0.5, 0.5, 0.5], [0.1, 0.1, 0.3]]], np.float32)
    assert may_be_sky(rgb).tolist() == [[True, True, False, False]]


def test_a_boarded_wall_is_not_smooth_and_clouds_are() -> None:
    rgb = np.full((HEIGHT, WIDTH, 3), 0.75, np.float32)
    rgb[:, : WIDTH // 2] += 0.1 * np.linspace(0.0, 1.0, HEIGHT)[:, None, None]  # clouds
    rgb[::5, WIDTH // 2 :] -= 0.12  # the shadow of each board
    smooth = is_smooth_around(rgb, np.ones((HEIGHT, WIDTH), bool))
    margin = 20
    assert smooth[:, : WIDTH // 2 - margin].all() and not smooth[:, WIDTH // 2 + margin :].any()
