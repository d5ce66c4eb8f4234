"""KITTI raw drives for the scene engine's benches: photos, their poses, lidar. No boxes, no map: no source of clips.

Layout, calibration and poses are those of Geiger et al. 2013 and of its development kit: `<date>/calib_*.txt`,
`<date>/<date>_drive_<n>_sync/{image_0k,velodyne_points,oxts}`. World: east, north, up [m] from where the IMU was first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factory.files import matching
from factory.readers.pictures import decode_rgb
from tasks.render.scene.sensed import Photo, Sweep
from tasks.world.arrays import Array

EARTH_RADIUS_M = 6378137.0  # of the kit's Mercator projection
IMU_HEIGHT_M = 0.93  # above the road


@dataclass(frozen=True)
class KittiCamera:
    """A rectified camera of the rig."""

    name: str  # image_00 .. image_03
    intrinsics: Array  # (3, 3) pixels of `size`, the centre of pixel (0, 0) at (0.5, 0.5)
    size: tuple[int, int]  # width, height the calibration was made for
    camera_from_imu: Array  # (4, 4)

    def intrinsics_of(self, width: int, height: int) -> Array:
        """(3, 3) for images that were scaled to another size."""
        return np.diag([width / self.size[0], height / self.size[1], 1.0]) @ self.intrinsics


@dataclass(frozen=True)
class KittiDrive:
    """Where a drive's files are, and where its IMU was at every frame."""

    folder: Path  # <date>_drive_<n>_sync
    cameras: dict[str, KittiCamera]
    world_from_imu: Array  # (frames, 4, 4)
    times_s: Array  # (frames,) since the first

    def photos(self, camera: str, frames: Sequence[int] | None = None) -> list[Photo]:
        """Photos of one camera at the frames asked for, all by default."""
        rig = self.cameras[camera]
        out = []
        for frame in range(len(self.times_s)) if frames is None else frames:
            rgb = decode_rgb((self.folder / camera / "data" / f"{frame:010d}.png").read_bytes())
            pose = self.world_from_imu[frame] @ np.linalg.inv(rig.camera_from_imu)
            intrinsics = rig.intrinsics_of(rgb.shape[1], rgb.shape[0])
            out.append(Photo(camera, float(self.times_s[frame]), rgb, intrinsics, pose))
        return out

    def sweeps(self) -> list[Sweep]:
        """Every lidar sweep there is, in the ego frame (on the road under the IMU, its axes)."""
        date = self.folder.parent
        imu_from_velo = np.linalg.inv(_rigid(date / "calib_imu_to_velo.txt"))
        ego_from_imu = np.eye(4)
        ego_from_imu[2, 3] = IMU_HEIGHT_M
        turn = ego_from_imu @ imu_from_velo
        out = []
        for path in matching(self.folder / "velodyne_points" / "data", "*.bin"):
            values, frame = np.fromfile(path, np.float32), int(path.stem)
            points = values.reshape(-1, 4)[:, :3] @ turn[:3, :3].T + turn[:3, 3]
            pose = self.world_from_imu[frame] @ np.linalg.inv(ego_from_imu)
            out.append(Sweep(float(self.times_s[frame]), points.astype(np.float32), pose))
        return out

    def fused(self) -> list[Sweep]:
        """The sweeps of all frames as one, positions only, where somebody fused them (`derived/points_fused.npz`)."""
        with np.load(self.folder.parent / "derived" / "points_fused.npz", allow_pickle=False) as arrays:
            return [Sweep(0.0, arrays["xyz"].astype(np.float32), np.eye(4))]


def read_drive(root: Path, date: str = "2011_09_26", drive: str = "0001") -> KittiDrive:
    """Calibration, poses and times."""
    folder = root / date / f"{date}_drive_{drive}_sync"
    lines = (folder / "oxts" / "timestamps.txt").read_text().split("\n")
    stamps = [datetime.fromisoformat(line[:26]) for line in lines if line.strip()]
    times = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps])
    return KittiDrive(folder, _cameras(root / date), _poses(folder / "oxts" / "data"), times)


def steadied(drive: KittiDrive) -> KittiDrive:
    """The drive with its poses at the moments when the cameras were triggered.

    The scanner that triggers them turns at a steady rate; stamps and poses are those of the closest tick of 10 ms, up
    to 8 cm from where a photo of drive 0001 was taken. The rate is the stamps' own, with what it drifts (a cubic).
    """
    stamps, frames = drive.times_s, np.arange(len(drive.times_s))
    times = np.asarray(np.polyval(np.polyfit(frames, stamps, 3), frames), np.float64)
    before = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(frames) - 2)
    share = (times - stamps[before]) / (stamps[before + 1] - stamps[before])
    start, end = drive.world_from_imu[before], drive.world_from_imu[before + 1]
    turns = Rotation.from_matrix(np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3]).as_rotvec()
    poses = start.copy()
    poses[:, :3, :3] = start[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turns).as_matrix()
    poses[:, :3, 3] += share[:, None] * (end - start)[:, :3, 3]
    return replace(drive, world_from_imu=poses, times_s=times)


def _calibration(path: Path) -> dict[str, Array]:
    rows = (line.partition(":") for line in path.read_text().splitlines())
    return {name: np.array(text.split(), np.float64) for name, _, text in rows if text.strip() and name != "calib_time"}


def _rigid(path: Path) -> Array:
    values = _calibration(path)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = values["R"].reshape(3, 3), values["T"]
    return out


def _cameras(date: Path) -> dict[str, KittiCamera]:
    values = _calibration(date / "calib_cam_to_cam.txt")
    rectify = np.eye(4)
    rectify[:3, :3] = values["R_rect_00"].reshape(3, 3)
    rectified_from_imu = rectify @ _rigid(date / "calib_velo_to_cam.txt") @ _rigid(date / "calib_imu_to_velo.txt")
    out = {}
    for k in range(4):
        projection = values[f"P_rect_0{k}"].reshape(3, 4)
        size = values[f"S_rect_0{k}"]
        beside = np.eye(4)
        beside[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
        intrinsics = projection[:, :3].copy()
        intrinsics[:2, 2] += 0.5  # the kit counts from the centre of the first pixel
        out[f"image_0{k}"] = KittiCamera(
            f"image_0{k}", intrinsics, (int(size[0]), int(size[1])), beside @ rectified_from_imu
        )
    return out


def _poses(folder: Path) -> Array:
    """World from IMU (frames, 4, 4): Mercator at the first latitude, then yaw, pitch, roll."""
    rows = [np.array(path.read_text().split(), np.float64)[:6] for path in matching(folder, "*.txt")]
    latitude, longitude, altitude, roll, pitch, yaw = np.stack(rows, axis=1)
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS_M
    north = scale * np.log(np.tan(np.radians(90.0 + latitude) / 2.0))
    place = np.column_stack([scale * np.radians(longitude), north, altitude])
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3, 3] = place - place[0]
    out[:, :3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return out


def _turn(axis: int, angle: Array) -> Array:
    out = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i], out[:, i, j] = np.sin(angle), -np.sin(angle)
    return out
