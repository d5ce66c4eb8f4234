"""Poses of KITTI raw drives between their stamps; all else that is read of them, tests/real/test_kitti_real.py says."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.bench.kitti import KittiDrive, steadied


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
