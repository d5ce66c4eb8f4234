"""The reader of KITTI raw drives, on a drive of two frames whose poses are known in closed form."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.bench.kitti import EARTH_RADIUS_M, IMU_HEIGHT_M, KittiDrive, read_drive, steadied

DATE = "2011_09_26"
WEST_OF_HERE = 8.0
AXES = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"  # camera x right, y down, z forward from x forward, y left, z up


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Frame 1: ten metres east of frame 0 and turned from east to north; images half the size calibrated for."""
    date = tmp_path / DATE
    drive = date / f"{DATE}_drive_0001_sync"
    for name in ("image_02/data", "image_03/data", "oxts/data", "velodyne_points/data"):
        (drive / name).mkdir(parents=True)
    (date / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -1 0 0\n")
    (date / "calib_velo_to_cam.txt").write_text(AXES)
    lines = ["R_rect_00: 1 0 0 0 1 0 0 0 1"]
    for k, shift in enumerate((0.0, -50.0, 10.0, -40.0)):
        lines += [f"S_rect_0{k}: 200 100", f"P_rect_0{k}: 100 0 99.5 {shift} 0 100 49.5 0 0 0 1 0"]
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines))
    east = np.degrees(10.0 / EARTH_RADIUS_M)  # at the equator
    for frame, (longitude, yaw) in enumerate(((WEST_OF_HERE, 0.0), (WEST_OF_HERE + east, np.pi / 2))):
        values = [0.0, longitude, 100.0, 0.0, 0.0, yaw] + [float("nan")] * 24
        (drive / "oxts" / "data" / f"{frame:010d}.txt").write_text(" ".join(f"{v:.15g}" for v in values))
        image = np.full((50, 100, 3), 10 * frame, np.uint8)
        image[..., 2] = 200  # blue, green, RED
        for camera in ("image_02", "image_03"):
            cv2.imwrite(str(drive / camera / "data" / f"{frame:010d}.png"), image)
    (drive / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.900000000\n2011-09-26 13:02:26.000000000\n")
    np.array([[5.0, 0.0, 0.0, 0.0]], np.float32).tofile(drive / "velodyne_points" / "data" / "0000000001.bin")
    return tmp_path


def test_photos_have_poses_in_the_world_and_intrinsics_of_their_own_size(root: Path) -> None:
    photos = read_drive(root).photos("image_02")
    assert [p.time_s for p in photos] == pytest.approx([0.0, 0.1])
    np.testing.assert_allclose(photos[0].intrinsics, [[50, 0, 50], [0, 50, 25], [0, 0, 1]])
    assert photos[1].rgb[0, 0].tolist() == [200, 10, 10]
    # The camera is 0.1 m left of the lidar (10 / 100), the lidar 1 m in front of the IMU.
    np.testing.assert_allclose(photos[0].world_from_camera[:3, 3], [1.0, 0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(photos[0].world_from_camera[:3, 2], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(photos[1].world_from_camera[:3, 3], [10.0 - 0.1, 1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(photos[1].world_from_camera[:3, 2], [0, 1, 0], atol=1e-9)
    right = read_drive(root).photos("image_03", [0])[0]
    np.testing.assert_allclose(right.world_from_camera[:3, 3], [1.0, -0.4, 0.0], atol=1e-6)


def test_sweeps_stand_on_the_road_and_land_in_the_same_world(root: Path) -> None:
    (sweep,) = read_drive(root).sweeps()
    np.testing.assert_allclose(sweep.points[0], [6.0, 0.0, IMU_HEIGHT_M], atol=1e-6)
    point = sweep.world_from_ego @ np.append(sweep.points[0], 1.0)
    np.testing.assert_allclose(point[:3], [10.0, 6.0, 0.0], atol=1e-5)


def test_poses_stamped_in_ticks_are_moved_to_when_the_cameras_were_triggered(tmp_path: Path) -> None:
    """Ten metres a second and a steady turn, every 103.2 ms, stamped and posed at the closest tick of 10 ms."""

    def poses(times: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.tile(np.eye(4), (len(times), 1, 1))
        out[:, :3, :3] = Rotation.from_rotvec(0.3 * times[:, None] * [0.0, 0.0, 1.0]).as_matrix()
        out[:, 0, 3] = 10.0 * times
        return out

    true = 0.1032 * np.arange(60)
    stamps = np.rint(true * 100) / 100
    drive = steadied(KittiDrive(tmp_path, {}, poses(stamps), stamps))
    assert np.abs(poses(stamps)[:, 0, 3] - 10.0 * true).max() > 0.04
    np.testing.assert_allclose(drive.times_s, true, atol=0.002)
    np.testing.assert_allclose(drive.world_from_imu, poses(drive.times_s), atol=1e-6)
    assert np.ptp(np.diff(drive.world_from_imu[:, 0, 3])) < 0.01
