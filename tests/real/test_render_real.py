"""The render room on KITTI raw drive 2011_09_26_0001: held-out photos of a real street."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tasks.render.scene.build import AssetSettings, build_asset
from tasks.render.scene.sensed import Photo, Sweep

EGO_HEIGHT_M = 0.93  # of KITTI's IMU above the ground
FRAMES = range(20, 52, 2)


def read_drive(folder: Path) -> tuple[list[Photo], list[Sweep]]:
    """Every second frame of the left colour camera; all sweeps there are."""
    derived = json.loads((folder / "derived" / "cameras.json").read_text())
    intrinsics = np.array(derived["K"])
    intrinsics[:2, 2] += 0.16  # the file scales centre-based coordinates; the room counts from the pixel's corner
    photos = []
    for view in derived["frames"]:
        if view["camera"] == "image_02" and view["frame"] in FRAMES:
            image = cv2.imread(str(folder / view["file"]))
            rgb = np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
            photos.append(Photo("image_02", 0.1 * view["frame"], rgb, intrinsics, np.array(view["c2w"])))
    lines = (folder / "calib_imu_to_velo.txt").read_text().splitlines()
    values = {line[0]: np.array(line.split(":")[1].split(), float) for line in lines if line[:2] in ("R:", "T:")}
    velo_from_imu = np.eye(4)
    velo_from_imu[:3, :3], velo_from_imu[:3, 3] = values["R"].reshape(3, 3), values["T"]
    imu_from_velo = np.linalg.inv(velo_from_imu)
    ground_from_imu = np.eye(4)
    ground_from_imu[2, 3] = EGO_HEIGHT_M
    ego_from_velo = ground_from_imu @ imu_from_velo
    sweeps = []
    for path in sorted(folder.glob("*_sync/velodyne_points/data/*.bin")):
        frame = int(path.stem)
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3] @ ego_from_velo[:3, :3].T + ego_from_velo[:3, 3]
        pose = np.array(derived["imu_to_world"][frame]) @ np.linalg.inv(ground_from_imu)
        sweeps.append(Sweep(0.1 * frame, points.astype(np.float32), pose))
    return photos, sweeps


@pytest.mark.slow
def test_held_out_photos_of_a_real_street_are_recognised(shared_root: Path) -> None:
    photos, sweeps = read_drive(shared_root / "data" / "kitti_raw" / "2011_09_26")
    asset = build_asset(photos, sweeps, None, AssetSettings())
    assert asset.n_held_out == 2  # of 16, each 2.2 m of driving from its neighbours
    assert asset.psnr_db > 18.5  # 19.3 as measured
