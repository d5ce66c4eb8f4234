"""How far away the driven road is along a ray, on a plane, on a hill and over its top."""

import numpy as np
import pytest

from tasks.render.scene.features import driven_road, road_depth
from tasks.render.scene.stereo import FAR_M

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # world from camera, looking along x


def rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(128) + 0.5, np.arange(72) + 0.5)
    local = np.stack([(u - 64.0) / 100.0, (v - 36.0) / 100.0, np.ones_like(u)], axis=-1)
    return np.asarray(local @ AHEAD.T)


def road(slope: float, from_m: float = -10.0, until_m: float = 60.0) -> np.ndarray:
    """Driven along x, flat until x = 0."""
    poses = np.tile(np.eye(4), (71, 1, 1))
    poses[:, 0, 3] = np.linspace(from_m, until_m, 71)
    poses[:, 2, 3] = slope * np.maximum(poses[:, 0, 3], 0.0)
    return driven_road(poses, 0.0)


@pytest.mark.parametrize("slope", [0.0, 0.04, -0.03])
def test_a_ray_meets_the_road_where_it_does(slope: float) -> None:
    """Along x the closed form; a hill's foot is under the camera."""
    eye = np.array([0.0, 0.0, 1.5])
    found = road_depth(road(slope), eye, rays())[:, 64]
    fall = -rays()[:, 64, 2]
    true = np.divide(1.5, fall + slope, out=np.full(72, FAR_M), where=fall + slope > 1e-9)
    sure = (fall > 0.0) & (true < 50.0)
    assert sure.sum() > 25
    assert (found[sure] / true[sure]).min() > 0.97 and (found[sure] / true[sure]).max() < 1.05
    assert (found[rays()[:, 64, 2] >= 0.0] == 0.0).all()


def test_beside_the_drive_the_road_goes_on_as_high() -> None:
    found = road_depth(road(0.0), np.array([5.0, 0.0, 1.5]), rays())
    low = rays()[..., 2] < -0.1
    assert found[low] == pytest.approx((1.5 / -rays()[..., 2])[low], rel=0.03)
