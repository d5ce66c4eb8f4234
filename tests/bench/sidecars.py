"""Real drives that come in layouts of their own, written as the sidecars that `factory scene build` takes."""

import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from factory.datasets.scenarionet.photos import read_photo_drive
from tasks.world.clip import PhotoDrive
from tests.bench.kitti import IMU_HEIGHT_M, KittiDrive

OPENSCENE_INSTANT_S, FIRST_INSTANT = 0.5, 16
EGO_ABOVE_ROAD_M = 0.28  # as the photos have it
# Of each vehicle that drives by in openscene_0101, which has no boxes, length, width, height [m] and where its middle
# is at an instant in the ego's frame [m], ahead and to the left, read off the photos: it faces the other way.
MOVERS = {
    "saloon": (
        (4.9, 1.86, 1.45),
        {16: (26.2, 3.6), 17: (18.8, 3.1), 18: (12.3, 3.1), 19: (6.4, 3.6), 20: (-0.4, 4.0), 21: (-6.3, 3.6)}
        | {22: (-10.4, 3.1), 23: (-15.6, 3.2), 24: (-19.4, 3.1), 25: (-26.0, 3.5), 27: (-32.5, 3.0), 30: (-48.8, 2.9)},
    ),
    "van": (
        (5.15, 2.0, 1.75),
        {17: (-1.2, 4.6), 18: (-4.8, 4.6), 19: (-7.5, 4.2), 20: (-11.2, 4.3), 21: (-14.8, 4.2), 22: (-23.0, 4.4)},
    ),
}


def openscene_sidecar(root: Path, movers: bool = False) -> dict[str, Any]:
    """Of openscene_0101, whose photos count from `root`; with boxes of MOVERS."""
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
        for name in cameras
    ]
    content = {"cameras": cameras, "frames": frames}
    return content | {"boxes": _boxes_of_movers(told["frames"])} if movers else content


def _boxes_of_movers(frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    poses = {frame["frame"]: np.array(frame["ego_to_world"]) for frame in frames}
    return [
        {"id": name, "t_s": OPENSCENE_INSTANT_S * (instant - FIRST_INSTANT), "size": list(size)}
        | {"center": (poses[instant] @ [*place, size[2] / 2.0 - EGO_ABOVE_ROAD_M, 1.0])[:3].tolist()}
        | {"yaw": float(np.arctan2(poses[instant][1, 0], poses[instant][0, 0]) + np.pi)}
        for name, (size, places) in MOVERS.items()
        for instant, place in places.items()
    ]


def read_openscene(root: Path, movers: bool = False) -> PhotoDrive:
    """The drive of openscene_0101, by its sidecar."""
    with TemporaryDirectory() as folder:
        sidecar = Path(folder, "openscene_0101", "cameras.json")
        sidecar.parent.mkdir()
        sidecar.write_text(json.dumps(openscene_sidecar(root, movers=movers)))
        return read_photo_drive(sidecar, root)


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
