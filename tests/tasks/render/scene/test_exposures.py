"""What a camera makes of the scene's light, at any time."""

import numpy as np

from tasks.render.scene.asset import Exposure, RenderAsset
from tasks.render.scene.sky import SkyMap
from tasks.render.splatting.gaussians import EMPTY


def scene(*seen: tuple[str, float, float]) -> RenderAsset:
    """Camera, time and gain of each photo."""
    exposures = tuple(Exposure(camera, time_s, np.float32(gain * np.eye(3, 4))) for camera, time_s, gain in seen)
    return RenderAsset(np.zeros(3), EMPTY, {}, SkyMap(np.zeros((2, 4, 3), np.float32)), 30.0, exposures=exposures)


def gain(asset: RenderAsset, camera: str, time_s: float) -> float:
    return float(asset.affine_of(camera, time_s)[0, 0])


def test_a_camera_exposes_as_between_its_photos_before_and_after_and_as_the_nearest_outside() -> None:
    asset = scene(("front", 2.0, 1.4), ("side", 1.0, 5.0), ("front", 1.0, 0.8))
    found = [gain(asset, "front", time_s) for time_s in (0.0, 1.0, 1.25, 2.0, 9.0)]
    np.testing.assert_allclose(found, [0.8, 0.8, 0.95, 1.4, 1.4], rtol=1e-6)
    assert gain(asset, "side", 0.0) == 5.0


def test_a_camera_without_photos_shows_the_scene_as_it_is() -> None:
    np.testing.assert_array_equal(scene(("front", 1.0, 0.8)).affine_of("other", 1.0), np.eye(3, 4))


def test_a_clip_counts_from_its_own_first_step() -> None:
    asset = scene(("front", 2.0, 1.4), ("front", 1.0, 0.8))
    assert gain(asset.since(0.5), "front", 0.75) == gain(asset, "front", 1.25)
