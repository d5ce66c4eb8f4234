"""One function draws a scene, whatever the backend: what it gives, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import street

from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import render
from tasks.render.scene.movers import NOBODY, agents_at_time
from tasks.render.scene.sky import look_up_sky, sky_cells
from tasks.render.splatting.gaussians import EMPTY
from tasks.render.views import render_views
from tasks.world.clip import Camera, Pinhole

POSE = street.ego_pose(3.0) @ street.EGO_FROM_CAMERA
FRONT = Pinhole(street.INTRINSICS, POSE, street.WIDTH, street.HEIGHT)


def test_depth_is_metres_along_the_axis_and_alpha_says_where_the_street_is(street_asset: RenderAsset) -> None:
    view = render(street_asset, [FRONT])[0]
    assert view.rgb.shape == (street.HEIGHT, street.WIDTH, 3) and view.rgb.dtype == np.float32
    assert view.rgb.min() >= 0.0 and view.rgb.max() <= 1.0
    below = np.arange(48, street.HEIGHT)  # rows that see the road: 1.5 m below the camera
    wanted = 100.0 * 1.5 / (below + 0.5 - 36.0)
    np.testing.assert_allclose(np.median(view.depth[48:, 50:78], axis=1), wanted, rtol=0.1)  # of discs' centres
    assert (view.alpha[48:, 20:108] > 0.7).mean() > 0.95
    assert view.alpha[:8, 60:68].max() < 0.2  # sky over the end of the street


def test_the_pipeline_s_frames_are_the_same_function_s(street_asset: RenderAsset) -> None:
    rig = [Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)]
    size = (street.WIDTH, street.HEIGHT)
    frames = np.stack([*render_views(street_asset, rig, street.ego_pose(3.0)[None], street.tracks(), [8], *size)])
    drawn = render(street_asset, [FRONT], agents_at_time(street.tracks(), 0.8))[0].rgb
    np.testing.assert_array_equal(frames[0, 0], np.rint(drawn * 255.0).astype(np.uint8))


def test_several_cameras_are_drawn_as_each_alone(street_asset: RenderAsset) -> None:
    aside = replace(FRONT, world_from_camera=street.ego_pose(3.0, 1.0) @ street.EGO_FROM_CAMERA, width=64)
    both = render(street_asset, [FRONT, aside])
    for camera, view in zip((FRONT, aside), both):
        alone = render(street_asset, [camera])[0]
        assert view.rgb.tobytes() == alone.rgb.tobytes() and view.depth.tobytes() == alone.depth.tobytes()


def test_a_camera_that_sees_no_gaussian_sees_the_sky_map_and_never_black(street_asset: RenderAsset) -> None:
    up = POSE.copy()
    up[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # straight up
    up[2, 3] = 50.0
    for asset, pose in ((street_asset, up), (replace(street_asset, background=EMPTY, nodes={}), POSE)):
        view = render(asset, [replace(FRONT, world_from_camera=pose)])[0]
        assert view.alpha.max() == 0.0 and view.depth.max() == 0.0
        local = pose.copy()
        local[:3, 3] -= asset.origin
        sky = look_up_sky(asset.sky.cells, sky_cells(FRONT.intrinsics, local, FRONT.width, FRONT.height))
        np.testing.assert_allclose(view.rgb, sky, atol=1e-3)
        assert view.rgb.min() > 0.1


def test_nobody_is_there_unless_named_and_the_far_are_left_out(street_asset: RenderAsset) -> None:
    there = agents_at_time(street.tracks(), 0.8)
    assert there.track_ids == ("car",) and there.boxes[0] == pytest.approx(street.car_box(0.8))
    away = agents_at_time(street.tracks(), 0.8, np.array([500.0, 0.0]), 150.0)
    assert away.track_ids == () and away.boxes.shape == NOBODY.boxes.shape
    with_car, without = (render(street_asset, [FRONT], who)[0].rgb for who in (there, away))
    assert (np.abs(with_car - without).max(axis=-1) > 0.2).mean() > 0.005


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"intrinsics": np.eye(4)}, r"\(4, 4\), \(4, 4\), expected \(3, 3\)"),
        ({"world_from_camera": np.eye(4)[:3]}, r"\(3, 4\), expected \(3, 3\) and \(4, 4\)"),
        ({"intrinsics": np.diag([np.nan, 1.0, 1.0])}, "NaN"),
        ({"intrinsics": np.diag([0.0, 1.0, 1.0])}, "positive"),
        ({"width": 0}, "positive"),
    ],
)
def test_what_is_no_camera_is_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(FRONT, **change)  # type: ignore[arg-type]
