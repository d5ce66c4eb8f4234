"""A scene whose depth comes from parallax alone."""

import numpy as np
import pytest

from tasks.render.scene.depth import estimate_photo_depth
from tasks.render.scene.features import SurfacePoints
from tasks.render.scene.sensed import Photo, Tracks
from tasks.world.clip import AgentKind, AgentTracks


def test_a_road_that_is_known_lies_behind_a_car_and_not_on_it() -> None:
    """Without lidar on the car nothing but its box says that the road behind it is hidden."""
    looks_ahead = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
    intrinsics = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
    photo = Photo("front", 0.0, np.full((64, 96, 3), 90, np.uint8), intrinsics, looks_ahead)
    x, y = np.meshgrid(np.arange(3.0, 40.0, 0.2), np.arange(-3.0, 3.1, 0.2))
    road = np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()])
    box = np.array([[[10.0, 0.0, 0.0, 4.0, 2.0]]])
    car = AgentTracks(
        ("car",), (AgentKind.VEHICLE,), box, np.zeros((1, 1, 2)), np.ones((1, 1), bool), np.full((1, 1), 0.8),
        np.array([1.6]),
    )  # fmt: skip
    known = SurfacePoints(road)
    free, hidden = (
        estimate_photo_depth(photo, [], known, {}, Tracks(agents, np.zeros(3)), 0).depth for agents in (None, car)
    )
    assert free[38, 48] == pytest.approx(1.5 * 60.0 / 6.5, rel=0.1)  # 14 m, the road there
    assert hidden[38, 48] != pytest.approx(free[38, 48], rel=0.2)
    assert hidden[60, 48] == pytest.approx(free[60, 48], rel=1e-6)  # in front of the car nothing changes
