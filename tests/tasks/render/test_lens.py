"""A lens put before a pinhole's picture is the one that `undistorted` takes away again."""

import cv2
import numpy as np
import pytest

from tasks.render.lens import lens_of
from tasks.render.views import undistorted
from tasks.world.clip import Camera

K = np.array([[386.0, 0.0, 240.0], [0.0, 386.0, 140.0], [0.0, 0.0, 1.0]])
NUPLAN = np.array([-0.356123, 0.172545, -0.00213, 0.000464, -0.05231])
PINCUSHION = np.array([0.08, 0.02, 0.001, 0.002, 0.01])


@pytest.mark.parametrize("distortion", [NUPLAN, PINCUSHION])
def test_through_the_lens_and_undistorted_is_the_pinhole_s_picture(distortion: np.ndarray) -> None:
    lens = lens_of(480, 270, K, distortion)
    patches = np.random.default_rng(0).integers(0, 256, (14, 24, 3)).astype(np.uint8)
    wide = cv2.resize(patches, (lens.width, lens.height), interpolation=cv2.INTER_CUBIC)
    taken = cv2.remap(wide, *lens.maps, cv2.INTER_LINEAR)
    back = undistorted(taken, Camera("lens", 480, 270, K, distortion, np.eye(4))).astype(int)
    own = wide[lens.top : lens.top + 270, lens.left : lens.left + 480]
    seen = np.s_[:, :] if distortion[0] < 0.0 else np.s_[30:-30, 50:-50]  # a pincushion shows less than its pinhole
    assert np.abs(back - own)[seen].mean() < 0.5
    assert lens.left > 0 if distortion[0] < 0.0 else lens.left <= 1
    np.testing.assert_array_equal(lens.intrinsics[:2, 2] - K[:2, 2], [lens.left, lens.top])


def test_what_shows_a_pixel_several_rays_or_far_more_than_a_pinhole_is_refused() -> None:
    for focal_px, terms, why in ((386.0, [-3.0, 0.0], "several rays, or none"), (230.0, [-0.22, 0.024], "4 times")):
        k = np.array([[focal_px, 0.0, 240.0], [0.0, focal_px, 140.0], [0.0, 0.0, 1.0]])
        with pytest.raises(ValueError, match=why):
            lens_of(480, 270, k, np.array([*terms, 0.0, 0.0, 0.0]))
