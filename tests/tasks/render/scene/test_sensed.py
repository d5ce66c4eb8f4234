"""What the sensors recorded, made smaller."""

import numpy as np

from tasks.render.scene.sensed import Photo, resize_photo

K = np.array([[900.0, 0.0, 650.0], [0.0, 900.0, 350.0], [0.0, 0.0, 1.0]])


def ramp() -> Photo:
    """Red says the column, green the row."""
    v, u = np.meshgrid(np.arange(720), np.arange(1280), indexing="ij")
    return Photo("front", 0.0, np.stack([u // 8, v // 4, 0 * u], axis=-1).astype(np.uint8), K, np.eye(4))


def test_a_reduced_photo_shows_the_same_in_the_same_direction() -> None:
    photo, small = ramp(), resize_photo(ramp(), 640)
    assert small.rgb.shape == (360, 640, 3)
    point = np.array([0.4, -0.2, 1.0])
    for p in (photo, small):
        x, y, _ = p.intrinsics @ point
        red, green, _ = p.rgb[int(y), int(x)].astype(float)
        np.testing.assert_allclose([red, green], [(650 + 360) / 8, (350 - 180) / 4], atol=1.0)


def test_a_small_photo_is_left_as_it_is() -> None:
    photo = ramp()
    assert resize_photo(photo, 1280) is photo
