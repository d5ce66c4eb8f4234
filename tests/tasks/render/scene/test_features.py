"""Points without lidar, on a wall whose distance is known."""

import cv2
import numpy as np

from tasks.render.scene.features import KnownPoints, points_without_lidar, triangulate_matches
from tasks.render.scene.sensed import Photo, Tracks
from tasks.world.clip import AgentKind, AgentTracks

WALL_M = 9.0
K = np.array([[120.0, 0.0, 80.0], [0.0, 120.0, 60.0], [0.0, 0.0, 1.0]])
LOOKS_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
STILL = Tracks(None, np.zeros(3))


def wall(right_m: float, time_s: float = 0.0, camera: str = "front") -> Photo:
    """A wall of seeded blobs across the camera's way, seen from `right_m` to the right of the first place."""
    blobs = np.random.default_rng(0).uniform(0, 255, (40, 80)).astype(np.float32)
    picture = cv2.resize(blobs, (640, 320), interpolation=cv2.INTER_CUBIC)
    shift = np.array([[1.0, 0.0, -200.0 - K[0, 0] * right_m / WALL_M], [0.0, 1.0, -100.0]])
    seen = np.clip(cv2.warpAffine(picture, shift, (160, 120), flags=cv2.INTER_CUBIC), 0, 255)
    pose = np.eye(4)
    pose[:3, :3] = LOOKS_ALONG_X
    pose[:3, 3] = [0.0, -right_m, 1.5]
    return Photo(camera, time_s, np.repeat(np.rint(seen)[..., None], 3, 2).astype(np.uint8), K, pose)


def test_points_lie_on_the_wall() -> None:
    points = triangulate_matches([wall(0.0), wall(1.0, 0.1), wall(2.0, 0.2)], STILL)
    assert len(points) > 50
    off = np.abs(points[:, 0] - WALL_M)
    assert np.median(off) < 0.1 and np.percentile(off, 95) < 0.5


def test_nothing_meets_between_cameras_of_different_names_or_too_near() -> None:
    assert triangulate_matches([wall(0.0), wall(1.0, 0.1, "left")], STILL).shape == (0, 3)
    assert triangulate_matches([wall(0.0), wall(0.1, 0.1)], STILL).shape == (0, 3)
    blank = [
        Photo("front", 0.1 * k, np.zeros((120, 160, 3), np.uint8), K, wall(1.0 * k).world_from_camera) for k in (0, 1)
    ]
    assert triangulate_matches(blank, STILL).shape == (0, 3)


def test_what_can_move_is_left_out() -> None:
    boxes = np.tile([[[WALL_M, 2.0, 0.0, 3.0, 4.0]]], (3, 1, 1))
    car = AgentTracks(
        ("car",),
        (AgentKind.VEHICLE,),
        boxes,
        np.zeros((3, 1, 2)),
        np.ones((3, 1), bool),
        np.full((3, 1), 1.5),
        np.array([8.0]),
    )
    photos = [wall(0.0), wall(1.0, 0.1)]
    everything, without = triangulate_matches(photos, STILL), triangulate_matches(photos, Tracks(car, np.zeros(3)))
    inside = np.abs(everything[:, 1] - 2.0) < 1.9
    assert inside.any() and len(without) < len(everything)
    assert not (np.abs(without[:, 1] - 2.0) < 1.9).any()


def test_corners_of_a_rig_are_points_and_corners_of_pairs_are_surfaces() -> None:
    road, corners = np.zeros((4, 3)), np.full((3, 3), 20.0)
    known = points_without_lidar([], STILL, KnownPoints(road, corners).shifted(np.ones(3)))
    assert known.corners is not None and (known.corners == 21.0).all() and (known.dense == 1.0).all()
    assert len(known.every) == 7
    pairs = points_without_lidar([], STILL, KnownPoints(road))
    assert pairs.corners is None and len(pairs.dense) == 4
