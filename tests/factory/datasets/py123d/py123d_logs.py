"""Writes the files of 123D, for tests: of an Argoverse 2 log as its converter would, or of a map given as objects.

Columns, types and metadata are those of kesai-labs/py123d (src/py123d/api), checked table by table against what its own
converter made of four logs of the town. Two things are simpler here: a lane group is one lane, and intersections have
no polygons of their own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.feather
import shapely
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factory.datasets.av2.reader import map_file, read_map
from tasks.world.road_map import RoadMap

LABELS = {  # of AV2SensorBoxDetectionLabel, those that appear in the tests' logs
    "BICYCLIST": 3,
    "BOX_TRUCK": 5,
    "BUS": 6,
    "CONSTRUCTION_CONE": 8,
    "PEDESTRIAN": 16,
    "REGULAR_VEHICLE": 18,
}
STATUS = {"GREEN": 0, "YELLOW": 1, "RED": 2}
STORED = {str: pa.string(), bytes: pa.binary(), int: pa.int32()}
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
TELL_OF_MAP = ("av2-sensor", "nuplan")  # whose parsers of 0.6 and 0.7 say in a log which map is its own
LANE, LANE_GROUP, INTERSECTION, CROSSWALK, CARPARK, GENERIC_DRIVABLE = 0, 1, 2, 3, 5, 6


@dataclass(frozen=True)
class Made:
    """How a log is said to have been converted."""

    dataset: str = "av2-sensor"
    split: str = "av2-sensor_train"
    version: str = "0.7.0"
    location: str | None = "SYN00"
    map_is_per_log: bool = True
    labels: str = "AV2SensorBoxDetectionLabel"
    label_of: Mapping[str, int] = field(default_factory=lambda: LABELS)
    every: int = 1  # which of the annotated frames and, with it, of the poses are kept
    imu_to_rear: Sequence[float] = IDENTITY  # pose of the rear axle in the IMU's frame

    def map_metadata(self, log: str) -> dict[str, Any]:
        """Of the map of this log."""
        own = {"split": self.split, "log_name": log} if self.map_is_per_log else {"split": None, "log_name": None}
        told = {"map_has_z": True, "map_is_per_log": self.map_is_per_log, "version": self.version}
        return {"dataset": self.dataset, **own, "location": self.location, **told}


@dataclass(frozen=True)
class MapObject:
    """A row of a map."""

    layer: int
    object_id: int
    shape: Any
    features: dict[str, Any]


def convert(log: Path, root: Path, made: Made | None = None, objects: Sequence[MapObject] | None = None) -> Path:
    """The log's folder under root/logs, its map there or under root/maps; objects: instead of the log's own map."""
    made = made or Made()
    folder = root / "logs" / made.split / log.name
    folder.mkdir(parents=True)
    _write_motion(folder, log, made)
    _write_lights(folder, log)
    _write_cameras(folder, log)
    told = made.map_metadata(log.name)
    header: dict[str, Any] = {
        "dataset": made.dataset,
        "split": made.split,
        "log_name": log.name,
        "location": made.location,
    }
    write(
        folder / "sync.arrow",
        {"sync.timestamp_us": pa.array([0])},
        {**header, "version": made.version, "map_metadata": told if made.dataset in TELL_OF_MAP else None},
    )
    shared = root / "maps" / made.dataset / f"{made.dataset}_{made.location}.arrow"
    path = folder / "map.arrow" if made.map_is_per_log else shared
    path.parent.mkdir(parents=True, exist_ok=True)
    write_map(path, objects_of(read_map(map_file(log))[0]) if objects is None else objects, told)
    return folder


def write(path: Path, columns: Mapping[str, pa.Array], metadata: Mapping[str, Any]) -> None:
    """An Arrow file with the metadata in its schema."""
    table = pa.table(dict(columns)).replace_schema_metadata({b"metadata": packed(metadata)})
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)


def rewrite(path: Path, columns: Mapping[str, pa.Array | None] | None = None, **metadata: Any) -> None:
    """The file with columns (None: without) and values of its metadata changed."""
    with pa.OSFile(str(path)) as source:
        table = pa.ipc.open_file(source).read_all()
    told = msgpack.unpackb(table.schema.metadata[b"metadata"], raw=False, strict_map_key=False)
    kept = {name: table[name].combine_chunks() for name in table.column_names} | dict(columns or {})
    write(path, {name: column for name, column in kept.items() if column is not None}, told | metadata)


def packed(value: object) -> bytes:
    """As msgpack, arrays as 123D writes them."""
    return bytes(msgpack.packb(value, default=_array, use_bin_type=True))


def fixed(values: NDArray[np.float64]) -> pa.Array:
    """(n, width) as lists of fixed size."""
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).ravel()), values.shape[1])


def lists(rows: NDArray[np.int64], n_rows: int, items: pa.Array) -> pa.Array:
    """A list in each of n rows; rows: (m,) of the m items, ascending."""
    return pa.ListArray.from_arrays(pa.array(np.searchsorted(rows, np.arange(n_rows + 1)), pa.int32()), items)


def write_lights(folder: Path, stamps_us: NDArray[np.int64], rows: NDArray[np.int64], lanes: Any, status: Any) -> None:
    """The table of the lights: rows, lanes, status (m,) of m lights, rows ascending."""
    key = "traffic_light_detections"
    columns = {
        f"{key}.timestamp_us": pa.array(stamps_us),
        f"{key}.lane_id": lists(rows, len(stamps_us), pa.array(lanes, pa.int32())),
        f"{key}.status": lists(rows, len(stamps_us), pa.array(status, pa.uint8())),
    }
    write(folder / f"{key}.arrow", columns, {})


def write_map(path: Path, objects: Sequence[MapObject], told: Mapping[str, Any]) -> None:
    """The table of a map."""
    columns = {
        "object_id": pa.array([one.object_id for one in objects], pa.int64()),
        "map_layer": pa.array([one.layer for one in objects], pa.int8()),
        "features": pa.array([packed(one.features) for one in objects], pa.binary()),
        "wkb": pa.array([shapely.to_wkb(one.shape) for one in objects], pa.binary()),
    }
    write(path, columns, told)


def lane(lane_id: int, left: Any, right: Any, **features: Any) -> MapObject:
    """A lane between two lines (P, 2) or (P, 3); its centreline is their mean."""
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    told: dict[str, Any] = {
        "lane_type": 2,
        "lane_group_id": None,
        "left_boundary": left,
        "right_boundary": right,
        "centerline": (left + right) / 2.0 if len(left) == len(right) else left,
        "left_lane_id": None,
        "right_lane_id": None,
        "predecessor_ids": [],
        "successor_ids": [],
        "speed_limit_mps": None,
        "outline": np.concatenate([left, right[::-1], left[:1]]),
    }
    return MapObject(LANE, lane_id, shapely.Polygon(told["outline"]), told | features)


def surface(layer: int, object_id: int, shape: Any, **features: Any) -> MapObject:
    """An area of any layer but lanes."""
    return MapObject(layer, object_id, shape, features)


def objects_of(road_map: RoadMap) -> list[MapObject]:
    """The map of an Argoverse 2 log as its converter lays it out."""
    lanes = road_map.lanes
    out = []
    for number, one in enumerate(lanes.values()):
        points = one.centerline
        out.append(
            lane(
                int(one.lane_id),
                one.left_boundary,
                one.right_boundary,
                lane_type=2 if one.drives_cars else 3,
                lane_group_id=number,
                centerline=np.column_stack([points[:, :2], np.zeros(len(points))]),
                left_lane_id=_known(one.left_neighbor, lanes),
                right_lane_id=_known(one.right_neighbor, lanes),
                predecessor_ids=[int(other) for other in one.predecessors if other in lanes],
                successor_ids=[int(other) for other in one.successors if other in lanes],
            )
        )
    for number, one in enumerate(lanes.values()):
        told = {"lane_ids": [int(one.lane_id)], "intersection_id": 0 if one.is_intersection else None}
        out.append(surface(LANE_GROUP, number, shapely.Polygon(one.ring), **told))
    out += [surface(CROSSWALK, 501 + k, shapely.Polygon(ring)) for k, ring in enumerate(road_map.crossings)]
    for area in road_map.drivable_areas:
        out.append(surface(GENERIC_DRIVABLE, int(area.token.removeprefix("da_")), shapely.Polygon(area.ring)))
    return out


def _write_motion(folder: Path, log: Path, made: Made) -> None:
    boxes, poses = _columns(log / "annotations.feather"), _columns(log / "city_SE3_egovehicle.feather")
    stamps = np.unique(boxes["timestamp_ns"])[:: made.every]
    kept = np.isin(poses["timestamp_ns"], stamps) if made.every > 1 else np.full(len(poses["timestamp_ns"]), True)
    _write_ego(folder, poses["timestamp_ns"][kept] // 1000, _poses(poses)[kept], made)

    order = np.argsort(boxes["timestamp_ns"], kind="stable")
    order = order[np.isin(boxes["timestamp_ns"][order], stamps)]
    boxes = {name: column[order] for name, column in boxes.items()}
    row = np.searchsorted(stamps, boxes["timestamp_ns"])
    seen_from = _poses(poses)[np.searchsorted(poses["timestamp_ns"], boxes["timestamp_ns"])]
    world, own = _turned(seen_from), _poses(boxes)
    places = world.apply(own[:, :3]) + seen_from[:, :3]
    sizes = np.column_stack([boxes[name] for name in ("length_m", "width_m", "height_m")])
    states = np.column_stack([places, _wxyz(world * _turned(own)), sizes])
    at, n = "box_detections_se3", len(stamps)
    columns = {
        f"{at}.timestamp_us": pa.array(stamps // 1000),
        f"{at}.bounding_box_se3": lists(row, n, fixed(states)),
        f"{at}.track_token": lists(row, n, pa.array(boxes["track_uuid"].tolist(), pa.string())),
        f"{at}.label": lists(row, n, pa.array([made.label_of[name] for name in boxes["category"]], pa.uint16())),
        f"{at}.velocity_3d": lists(row, n, fixed(np.zeros((len(row), 3)))),
        f"{at}.num_lidar_points": lists(row, n, pa.array(np.ones(len(row)), pa.int32())),
    }
    write(folder / f"{at}.arrow", columns, {"box_detection_label_class": f"py123d.parser.registry.{made.labels}"})


def _write_ego(folder: Path, stamps_us: NDArray[np.int64], rear: NDArray[np.float64], made: Made) -> None:
    mount = np.asarray(made.imu_to_rear, np.float64)
    turned = _turned(rear) * _turned(mount[None])[0].inv()
    at = "ego_state_se3"
    columns = {
        f"{at}.timestamp_us": pa.array(stamps_us),
        f"{at}.imu_se3": fixed(np.column_stack([rear[:, :3] - turned.apply(mount[:3]), _wxyz(turned)])),
        f"{at}.dynamic_state_se3": fixed(np.zeros((len(rear), 9))),
    }
    told = {"vehicle_name": "any", "width": 2.0, "length": 5.0, "height": 1.5, "wheel_base": 2.9}
    write(
        folder / f"{at}.arrow",
        columns,
        told | {"center_to_imu_se3": list(IDENTITY), "rear_axle_to_imu_se3": mount.tolist()},
    )


def _write_lights(folder: Path, log: Path) -> None:
    if not (log / "traffic_lights.feather").exists():
        return
    lights = _columns(log / "traffic_lights.feather")
    order = np.argsort(lights["timestamp_ns"], kind="stable")
    stamps = np.unique(lights["timestamp_ns"])
    status = [STATUS[name] for name in lights["state"][order]]
    rows = np.searchsorted(stamps, lights["timestamp_ns"][order])
    write_lights(folder, stamps // 1000, rows, lights["lane_id"][order], status)


def _write_cameras(folder: Path, log: Path) -> None:
    if not (log / "calibration").exists():
        return
    mounts = _columns(log / "calibration" / "egovehicle_SE3_sensor.feather")
    intrinsics = pyarrow.feather.read_table(log / "calibration" / "intrinsics.feather").to_pylist()
    for number, one in enumerate(intrinsics):
        name = one["sensor_name"]
        photos = sorted((log / "sensors" / "cameras" / name).glob("*.jpg"))
        write_camera(
            folder,
            number,
            [int(photo.stem) // 1000 for photo in photos],
            [str(photo.relative_to(log.parent.parent)) for photo in photos],
            camera_name=name,
            intrinsics=[one["fx_px"], one["fy_px"], one["cx_px"], one["cy_px"], 0.0],
            distortion=[one["k1"], one["k2"], 0.0, 0.0, one["k3"]],
            width=one["width_px"],
            height=one["height_px"],
            camera_to_imu_se3=_poses(mounts)[mounts["sensor_name"] == name][0].tolist(),
        )


def write_camera(
    folder: Path,
    number: int,
    stamps_us: Sequence[int],
    data: Sequence[str] | Sequence[bytes] | Sequence[int],
    pose: Any = None,
    **changed: Any,
) -> Path:
    """The table of a camera and its photos, a small one that looks ahead but for what is `changed`; pose: of all.

    data: paths, pictures in bytes, or frames of the video beside it.
    """
    key, n = f"camera.pcam_{number}", len(data)
    told = {
        "camera_model": "pinhole",
        "camera_name": "front",
        "camera_id": number,
        "intrinsics": [50.0, 50.0, 32.0, 18.0, 0.0],
        "distortion": None,
        "width": 64,
        "height": 36,
        "camera_to_imu_se3": [1.6, 0.0, 1.0, 0.5, -0.5, 0.5, -0.5],
        "is_undistorted": True,
    }
    columns = {
        f"{key}.timestamp_us": pa.array(stamps_us, pa.int64()),
        f"{key}.data": pa.array(data, STORED[type(data[0])] if data else pa.string()),
        f"{key}.camera_to_global_se3": pa.array([pose] * n, pa.list_(pa.float64(), 7)),
        f"{key}.exposure_factor": pa.nulls(n, pa.float32()),
    }
    write(folder / f"{key}.arrow", columns, told | changed)
    return folder / f"{key}.arrow"


def write_lidar(
    folder: Path, stamps_us: Sequence[int], data: Sequence[str] | Sequence[bytes | None], turn_us: int = 100_000
) -> Path:
    """The table of a merged lidar 1.8 m above the IMU; data: paths, or points in bytes."""
    key = "lidar.lidar_merged"
    packed = {} if isinstance(data[0], str) else {f"{key}.kwargs": None}
    columns = {
        f"{key}.timestamp_us": pa.array(stamps_us, pa.int64()),
        f"{key}.end_timestamp_us": pa.array(np.asarray(stamps_us) + turn_us, pa.int64()),
        f"{key}.data": pa.array(data, STORED[type(data[0])]),
        f"{key}.kwargs": pa.nulls(len(data), pa.string()),
    }
    top = {"lidar_name": "top", "lidar_id": 2, "lidar_to_imu_se3": [0.9, 0.0, 1.8, 1.0, 0.0, 0.0, 0.0]}
    kept = {name: column for name, column in columns.items() if name not in packed}
    write(folder / f"{key}.arrow", kept, {"2": top | {"segmentation_label_class": None}})
    return folder / f"{key}.arrow"


def _columns(path: Path) -> dict[str, Any]:
    table = pyarrow.feather.read_table(path)
    return {name: np.array(table[name].to_numpy()) for name in table.column_names}


def _poses(columns: Mapping[str, Any]) -> NDArray[np.float64]:
    return np.column_stack([columns[name] for name in ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")])


def _turned(poses: NDArray[np.float64]) -> Rotation:
    return Rotation.from_quat(np.roll(poses[:, 3:], -1, axis=1))


def _wxyz(turned: Rotation) -> NDArray[np.float64]:
    return np.roll(turned.as_quat(), 1, axis=-1)


def _known(lane_id: str | None, lanes: Mapping[str, Any]) -> int | None:
    return int(lane_id) if lane_id in lanes else None


def _array(value: object) -> dict[bytes, object]:
    assert isinstance(value, np.ndarray)
    return {b"__ndarray__": True, b"dtype": value.dtype.str, b"shape": value.shape, b"data": value.tobytes()}
