"""Poses on the road, distortion, frames of a simulated drive, and drawings of the map."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import street

from tasks.render.views import GROUND, ROAD, SKY, WHITE, clip_near, draw_map_views, ground_height, pinhole, undistorted
from tasks.world.clip import Camera
from tasks.world.frames import EGO_STATE_SIZE, HEADING, X, Y, pose_on_ground
from tasks.world.road_map import Lane, MapLayer, MapPolygon, RoadMap


def states(x: float, y: float, heading: float) -> np.ndarray:
    out = np.zeros((1, EGO_STATE_SIZE))
    out[0, X], out[0, Y], out[0, HEADING] = x, y, heading
    return out


def slope(x: float, grade: float) -> np.ndarray:
    """A logged pose on a road that climbs along x."""
    angle = np.arctan(grade)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = x, 0.0, grade * x
    return pose


def test_a_logged_pose_comes_back() -> None:
    logged = np.stack([slope(x, 0.1) for x in range(10)])
    np.testing.assert_allclose(pose_on_ground(logged, states(4.0, 0.0, 0.0))[0], logged[4], atol=1e-12)


def test_a_perturbed_pose_stands_on_the_plane_of_the_road() -> None:
    logged = np.stack([slope(x, 0.1) for x in range(10)])
    pose = pose_on_ground(logged, states(4.3, 1.2, 0.4))[0]
    assert pose[2, 3] == pytest.approx(0.43)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.4)
    assert pose[2, 0] / np.hypot(pose[0, 0], pose[1, 0]) == pytest.approx(0.1 * np.cos(0.4))


def test_a_state_stands_at_the_height_of_the_road_next_to_it() -> None:
    """The log climbs by steps: 2 m at x = 0, 3 m at x = 10, 5 m at x = 20, level at each."""
    logged = np.tile(np.eye(4), (3, 1, 1))
    logged[:, 0, 3], logged[:, 2, 3] = (0.0, 10.0, 20.0), (2.0, 3.0, 5.0)
    states = np.zeros((3, 11))
    states[:, 0], states[:, 1] = (1.0, 14.0, 16.0), (0.5, -2.0, 3.0)
    np.testing.assert_allclose(pose_on_ground(logged, states)[:, 2, 3], [2.0, 3.0, 5.0])


def lens(distortion: list[float]) -> Camera:
    return Camera("c", 64, 48, np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), np.array(distortion), np.eye(4))


@pytest.mark.parametrize("distortion", [[-0.2, 0.05, 0.0, 0.0, 0.0], [-0.36, 0.17, 0.002, -0.003, -0.04]])
def test_undistorting_undoes_what_the_lens_did(distortion: list[float]) -> None:
    """The second row is near nuPlan's front camera. OpenCV inverts the model here; ours never does."""
    camera = lens(distortion)
    v, u = np.meshgrid(np.arange(48) + 0.5, np.arange(64) + 0.5, indexing="ij")
    ideal = np.stack([128 + 200 * (u - 32) / 60, 128 + 200 * (v - 24) / 60, 0 * u], -1)  # linear in the ideal ray
    # At a pixel of the photo stands the colour of the ideal ray that the lens sends there.
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.intrinsics, camera.distortion).reshape(48, 64, 2)
    photo = np.rint(np.concatenate([128 + 200 * rays, 0 * rays[..., :1]], -1)).clip(0, 255).astype(np.uint8)
    flat = undistorted(photo, camera).astype(np.float64)
    assert np.abs(flat - ideal)[4:-4, 4:-4].max() < 2.0


def test_a_photo_without_distortion_is_left_alone() -> None:
    photo = np.zeros((48, 64, 3), np.uint8)
    assert undistorted(photo, lens([0.0] * 5)) is photo


def road() -> RoadMap:
    edge = np.array([[-50.0, 2.0, 0.0], [100.0, 2.0, 0.0]])
    ring = np.array([[-50.0, -2], [100, -2], [100, 2], [-50, 2], [-50, -2]])
    centerline = np.column_stack([np.linspace(-50, 100, 50), np.zeros(50), np.zeros(50)])
    right = edge * [1, -1, 1]
    lane = Lane("a", ring, centerline, False, True, left_boundary=edge, right_boundary=right, left_mark="SOLID_WHITE")
    area = MapPolygon("da_1", MapLayer.DRIVABLE_AREA, ring * [1, 3])
    return RoadMap({"a": lane}, (area,))


def test_the_map_drawing_has_true_perspective() -> None:
    camera = pinhole("front", 0.0, 90.0, 200, 100)  # focal length 100 px, 1.6 m above the ground, 1.5 m ahead
    image = draw_map_views(road(), [camera], np.eye(4)[None], street.tracks(), [0], 200, 100)[0, 0]
    assert tuple(image[10, 100]) == SKY and tuple(image[95, 100]) == ROAD and tuple(image[53, 3]) == GROUND
    # The paint at y = 2 m is, at depth z, at u = 100 - 100 * 2 / z and v = 50 + 100 * 1.6 / z.
    row = 90
    depth = 160.0 / (row + 0.5 - 50.0)
    columns = np.flatnonzero((image[row] == WHITE).all(axis=-1))
    assert np.mean(columns) + 0.5 == pytest.approx(100.0 - 200.0 / depth, abs=1.5)


def lifted_road(z: float) -> RoadMap:
    lane = road().lanes["a"]
    lines = [np.column_stack([np.linspace(-50, 100, 151), np.full(151, side), np.full(151, z)]) for side in (2.0, -2.0)]
    return RoadMap({"a": replace(lane, left_boundary=lines[0], right_boundary=lines[1])}, road().drivable_areas)


def test_the_ground_of_the_drawing_lies_where_the_map_has_its_lane_boundaries() -> None:
    pose = slope(0.0, 0.0)
    pose[2, 3] = 12.33  # the rear axle, a third of a metre above the road
    assert ground_height(lifted_road(12.0), pose) == pytest.approx(-0.33)
    assert ground_height(road(), pose) == 0.0  # a map without heights
    camera = pinhole("front", 0.0, 90.0, 200, 100)
    args = (pose[None], street.tracks(), [0], 200, 100)
    low = draw_map_views(lifted_road(12.0), [camera], *args)[0, 0]
    higher = np.eye(4)
    higher[2, 3] = 0.33
    mounted = replace(camera, ego_from_camera=higher @ camera.ego_from_camera)
    high = draw_map_views(lifted_road(12.33), [mounted], *args)[0, 0]
    np.testing.assert_array_equal(low[60:], high[60:])


def test_the_map_drawing_shows_boxes_and_every_side() -> None:
    rig = [pinhole(f"camera {yaw}", yaw, 70.0) for yaw in range(0, 360, 60)]
    images = draw_map_views(road(), rig, np.eye(4)[None], street.tracks(), [0], 160, 90)
    assert len({image.tobytes() for image in images[0]}) == 6
    agents = street.tracks()
    gone = type(agents)(**{**agents.__dict__, "valid": np.zeros_like(agents.valid)})
    without = draw_map_views(road(), rig[:1], np.eye(4)[None], gone, [0], 160, 90)
    assert (images[0, 0] != without[0, 0]).any(axis=-1).mean() > 0.01


def test_clipping_keeps_what_is_ahead_of_the_near_plane() -> None:
    square = np.array([[-1.0, 0, -1.0], [1, 0, -1], [1, 0, 3], [-1, 0, 3]])
    clipped = clip_near(square)
    assert clipped[:, 2].min() == pytest.approx(0.3) and len(clipped) == 4
    assert len(clip_near(square - [0, 0, 10.0])) == 0
