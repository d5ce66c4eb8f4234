"""Real drives that come in layouts of their own, written as the sidecars that `factory scene build` takes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.kitti import IMU_HEIGHT_M, KittiDrive

OPENSCENE_INSTANT_S = 0.5


def openscene_sidecar(root: Path, left_out: tuple[int, ...] = ()) -> dict[str, Any]:
    """Of openscene_0101, whose photos count from `root`, without some instants."""
    told = json.loads((root / "cameras.json").read_text())
    size = {name: told[name] for name in ("width", "height")}
    cameras = {
        name: size | {"K": row["K"], "distortion": row["dist_k1k2p1p2k3"], "cam_to_ego": row["cam_to_ego"]}
        for name, row in told["cameras"].items()
    }
    frames = [
        {"camera": name, "t_s": OPENSCENE_INSTANT_S * k, "ego_to_world": frame["ego_to_world"]}
        | {"file": f"frame_{frame['frame']}/{name}.jpg"}
        for k, frame in enumerate(told["frames"])
        for name in (cameras if frame["frame"] not in left_out else ())
    ]
    return {"cameras": cameras, "frames": frames}


def write_kitti_sidecar(drive: KittiDrive, folder: Path, camera: str = "image_02", lidar: bool = True) -> Path:
    """`cameras.json` of one camera of a drive, with copies of its photos, and of its sweeps with a column more."""
    ego_from_imu = np.eye(4)
    ego_from_imu[2, 3] = IMU_HEIGHT_M
    poses, rig = drive.world_from_imu @ np.linalg.inv(ego_from_imu), drive.cameras[camera]
    (folder / camera).mkdir(parents=True)
    frames, sweeps = [], []
    for k, photo in enumerate(drive.photos(camera)):
        height, width = photo.rgb.shape[:2]
        frames.append({"t_s": photo.time_s, "file": f"{camera}/{k}.png", "ego_to_world": poses[k].tolist()})
        shutil.copy(drive.folder / camera / "data" / f"{k:010d}.png", folder / camera / f"{k}.png")
    for sweep in drive.sweeps() if lidar else ():
        file = f"{len(sweeps)}.pcd.bin"
        np.pad(sweep.points, ((0, 0), (0, 2))).astype("<f4").tofile(folder / file)
        sweeps.append({"t_s": sweep.time_s, "file": file, "ego_to_world": sweep.world_from_ego.tolist()})
    mount = ego_from_imu @ np.linalg.inv(rig.camera_from_imu)
    one = {"K": rig.intrinsics_of(width, height).tolist(), "width": width, "height": height}
    content = {"cameras": {camera: one | {"cam_to_ego": mount.tolist()}}, "frames": frames}
    if sweeps:
        content |= {"lidar": {"velodyne": {"lidar_to_ego": np.eye(4).tolist()}}, "sweeps": sweeps}
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder / "cameras.json"
