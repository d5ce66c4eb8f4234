"""Cameras of a log of 123D, and where its photos and sweeps lie.

123D keeps photos by their path under the data set's own sensor root, or packed into its tables. Only files are taken:
photos where `sensor_root` says where they are, sweeps where they are Argoverse 2's feathers.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from factory.files import matching
from factory.readers.av2.log import LogMotion, seconds_since, world_from_ego_at
from factory.readers.base import BadClip
from factory.readers.py123d.arrow import ArrowFile, numbers, open_file, open_metadata
from factory.readers.py123d.log import EGO, matrices
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.camera import Camera, SensorFile

PINHOLE, LIDAR, SWEEP_SUFFIX = "pinhole", "lidar.lidar_merged.arrow", ".feather"


def camera_files(folder: Path) -> tuple[Path, ...]:
    """The tables of the log's cameras, by name."""
    return tuple(matching(folder, "camera.*.arrow"))


def read_rig(folder: Path) -> dict[Path, Camera]:
    """Table -> pinhole camera; fisheyes are left out. Raises BadClip."""
    mount = open_metadata(folder / EGO).vector("rear_axle_to_imu_se3", 7)
    rear_from_imu = np.linalg.inv(matrices(folder / EGO, mount[None])[0])
    files = {path: open_metadata(path) for path in camera_files(folder)}
    return {
        path: _camera(file, rear_from_imu) for path, file in files.items() if file.value("camera_model", str) == PINHOLE
    }


def has_photos(folder: Path) -> bool:
    """Whether the log's photos are files."""
    return any(pa.types.is_string(_data_type(open_metadata(path))) for path in camera_files(folder))


def recorded_photos(motion: LogMotion, rig: dict[Path, Camera], sensor_root: Path) -> tuple[SensorFile, ...]:
    """The log's photos, seconds since its first annotated frame, posed as their tables say. Raises BadClip."""
    out: list[SensorFile] = []
    for path, camera in rig.items():
        file = open_file(path)
        if pa.types.is_string(_data_type(file)) and file.table.num_rows:
            times_s = seconds_since(motion.start_ns, file.stamps_ns())
            out += _files(file, camera.name, sensor_root, times_s, _poses(file, camera, motion, times_s))
    return tuple(out)


def recorded_sweeps(motion: LogMotion, sensor_root: Path) -> tuple[SensorFile, ...]:
    """The log's sweeps where they are Argoverse 2's files, seconds since its first annotated frame. Raises BadClip."""
    path = motion.folder / LIDAR
    if not path.exists():
        return ()
    file = open_file(path)
    if not pa.types.is_string(_data_type(file)) or not file.table.num_rows:
        return ()
    times_s = seconds_since(motion.start_ns, file.stamps_ns())
    sweeps = _files(file, "lidar", sensor_root, times_s, world_from_ego_at(motion, times_s))
    return tuple(sweep for sweep in sweeps if sweep.uri.endswith(SWEEP_SUFFIX))


def _camera(file: ArrowFile, rear_from_imu: Array) -> Camera:
    fx, fy, cx, cy, skew = file.vector("intrinsics", 5)
    if skew:
        raise BadClip(str(file.path), "metadata.intrinsics", f"skew of {skew}, only cameras without are read")
    flat = file.value("is_undistorted", bool) or file.metadata.get("distortion") is None
    distortion = np.zeros(5) if flat else file.vector("distortion", 5)
    mount = rear_from_imu @ matrices(file.path, file.vector("camera_to_imu_se3", 7)[None])[0]
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    size = file.value("width", int), file.value("height", int)
    try:
        return Camera(file.value("camera_name", str), *size, intrinsics, distortion, mount)
    except ValueError as error:
        raise BadClip(str(file.path), "metadata", str(error)) from error


def _data_type(file: ArrowFile) -> pa.DataType:
    name = f"{file.path.stem}.data"
    if name not in file.table.column_names:
        raise BadClip(str(file.path), name, "column is missing")
    return file.table.schema.field(name).type


def _poses(file: ArrowFile, camera: Camera, motion: LogMotion, times_s: Array) -> Array:
    """(n, 4, 4) world from ego at each photo: from the photo's own pose, the ego's where it has none."""
    poses = world_from_ego_at(motion, times_s)
    column = file.table[f"{file.path.stem}.camera_to_global_se3"].combine_chunks()
    posed = np.flatnonzero(np.asarray(column.is_valid()))
    if len(posed):
        own = matrices(file.path, numbers(file.path, "camera_to_global_se3", column.drop_null(), 7))
        poses[posed] = own @ np.linalg.inv(camera.ego_from_camera)
    return poses


def _files(file: ArrowFile, sensor: str, root: Path, times_s: Array, poses: Array) -> list[SensorFile]:
    """Files in time order. Raises BadClip for a path that leads out of the root."""
    names = file.column("data").to_pylist()
    for name in names:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise BadClip(str(file.path), "data", f"{shown(name)} is no path under the sensor root")
    order = np.argsort(times_s, kind="stable")
    return [SensorFile(sensor, str(root / names[i]), float(times_s[i]), poses[i]) for i in order]
