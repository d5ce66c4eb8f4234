"""A block seen by lidar alone, on the closed-form street."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.scene.build import BRIGHTEST, DARKEST, grey_of, lidar_asset
from tasks.render.scene.engine import Vehicles, render
from tasks.world.clip import AgentKind, Pinhole


def seen(bright: int) -> np.ndarray:
    """A view from beside the two sweeps, every return of one strength."""
    sweeps = [
        replace(s, intensity=np.full(len(s.points), bright, np.uint8))
        for s in (street.sweep(4.0, 1.0), street.sweep(4.4, 1.1))
    ]
    asset = lidar_asset(sweeps, street.tracks())
    assert np.isnan(asset.psnr_db) and list(asset.nodes) == ["car"]
    view = street.photo(4.5, 0.8, 1.1)
    camera = Pinhole(view.intrinsics, view.world_from_camera, street.WIDTH, street.HEIGHT)
    return render(asset, [camera], Vehicles(("car",), (AgentKind.VEHICLE,), street.car_box(1.1)[None]))[0].rgb


def test_the_near_road_is_closed_and_as_bright_as_its_returns() -> None:
    road = seen(120)[52:, 20:108]
    assert (road.mean(axis=-1) > 0.75 * BRIGHTEST).mean() > 0.85
    assert seen(0)[52:, 20:108].mean() < 0.3


def test_stronger_returns_are_brighter_and_all_are_grey() -> None:
    grey = grey_of(np.array([0, 10, 60, 120, 255], np.uint8))
    assert (np.diff(grey[:, 0]) >= 0).all() and np.ptp(grey, axis=1).max() == 0.0
    assert grey[0, 0] == pytest.approx(DARKEST) and grey[-1, 0] == pytest.approx(BRIGHTEST)


def test_a_mover_is_drawn_at_its_box_and_apart_from_the_street() -> None:
    sweep = street.sweep(4.0, 1.0)
    asset = lidar_asset([replace(sweep, intensity=np.full(len(sweep.points), 60, np.uint8))], street.tracks())
    box = street.car_box(1.0)
    points = asset.background.means + asset.origin - box[:3]
    inside = (np.abs(points[:, :2]) < box[4:6] / 2).all(axis=1) & (np.abs(points[:, 2]) < box[6] / 2 - 0.15)
    assert not inside.any()


def test_a_scene_needs_sweeps_with_intensity() -> None:
    for sweeps in ([], [street.sweep(0.0, 0.0)]):
        with pytest.raises(ValueError, match="intensity"):
            lidar_asset(sweeps, None)
