"""A camera is what its numbers say, or none."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.world.clip import Camera

CAMERA = Camera(
    "front",
    640,
    480,
    np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]]),
    np.array([-0.1, 0.01, 0.0, 0.0, 0.0]),
    np.eye(4),
)


def test_the_centred_part_of_an_image_keeps_its_rays() -> None:
    small = CAMERA.resized(160, 90)  # 640 x 360 of 640 x 480, a quarter of it
    assert CAMERA.window(160, 90) == (0, 60, 640, 360)
    for u, v in ((0.0, 60.0), (320.0, 240.0), (640.0, 420.0)):
        ray = np.linalg.solve(CAMERA.intrinsics, [u, v, 1.0])
        np.testing.assert_allclose(small.intrinsics @ ray, [u / 4, (v - 60) / 4, 1.0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"intrinsics": np.eye(4)}, r"camera front: intrinsics: shape \(4, 4\), expected \(3, 3\)"),
        ({"intrinsics": np.array([500.0, 510.0, 320.0, 240.0])}, r"intrinsics: shape \(4,\)"),
        ({"distortion": np.zeros(3)}, r"distortion: shape \(3,\), expected \(5,\)"),
        ({"ego_from_camera": np.eye(4)[:3]}, r"ego_from_camera: shape \(3, 4\), expected \(4, 4\)"),
        ({"distortion": np.array([0.0, np.nan, 0.0, 0.0, 0.0])}, "distortion: NaN"),
        ({"intrinsics": np.diag([0.0, 500.0, 1.0])}, "focal lengths must be positive"),
        ({"width": 0}, "size: 0x480"),
        ({"ego_from_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "not a rotation"),
        ({"ego_from_camera": np.diag([2.0, 2.0, 2.0, 1.0])}, "not a rotation"),
    ],
)
def test_what_is_no_calibration_is_named_with_its_camera(change: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(CAMERA, **change)  # type: ignore[arg-type]
