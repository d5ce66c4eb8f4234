"""Writes logs as OpenScene does, every key of a frame, those nobody reads too: fixtures of what NAVSIM reads.

Keys, shapes, types and frames of OpenDriveLab/OpenScene @ 7286074, create_openscene_metadata.py. A log is any
`WholeLog` of ours at 10 Hz, whose every fifth step becomes a frame.
"""

import hashlib
import pickle
import pickletools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.feather
import shapely
from scipy.spatial.transform import Rotation

from factory.datasets.av2.reader import AV2Log, step_times, world_from_ego_at
from factory.datasets.navsim.log import CAMERA_NAMES
from factory.readers.logs import WholeLog
from tasks.world.clip import STEP_S, AgentKind, Camera
from tasks.world.frames import AX, HEADING, VX, points_to_local
from tasks.world.road_map import LightState

FRAME_STEPS = 5
FIRST_STAMP_US = 1_623_693_600_000_000
TOWN_CAMERAS = dict(  # of the town's eight, by where they look
    zip(
        (
            *("ring_front_center", "ring_front_left", "ring_side_left", "ring_rear_left"),
            *("ring_front_right", "ring_side_right", "ring_rear_right", "ring_rear_center"),
        ),
        CAMERA_NAMES,
    )
)


@dataclass(frozen=True)
class Place:
    """Where on earth a log is put, and what its lanes and roadblocks are called there."""

    location: str = "us-ma-boston"
    offset: np.ndarray = field(default_factory=lambda: np.array([331_000.0, 4_690_000.0, 0.0]))  # world -> UTM [m]
    lane_number: Callable[[str], str] = str  # our lane id -> id on the map there
    roadblock_number: Callable[[str], str] = str


@dataclass(frozen=True)
class Sensed:
    """Pictures and points by frame."""

    cameras: tuple[Camera, ...] = ()  # named as OpenScene's
    images: Mapping[tuple[str, int], bytes] = field(default_factory=dict)  # camera, frame -> JPEG
    sweeps: Mapping[int, np.ndarray] = field(default_factory=dict)  # frame -> (N, 4) x, y, z, intensity, ego frame


def hex16(*words: object) -> str:
    """A token as nuPlan's: 16 hex digits."""
    return hashlib.sha256("\x1f".join(map(str, words)).encode()).hexdigest()[:16]


def write_openscene(
    root: Path,
    split: str,
    name: str,
    log: WholeLog,
    place: Place | None = None,
    sensed: Sensed | None = None,
    world_from_ego: np.ndarray | None = None,
) -> Path:
    """The log's pickle, root/navsim_logs/<split>/<name>.pkl; its blobs lie under root/sensor_blobs/<split>.

    world_from_ego: (S, 4, 4) of the log's steps; None: upright, or an Argoverse log's own.
    """
    place, sensed = place or Place(), sensed or Sensed()
    if world_from_ego is None:
        world_from_ego = _poses(log)
    frames = log_frames(name, log, place, sensed, world_from_ego)
    blobs = {frames[k]["cams"][camera]["data_path"]: data for (camera, k), data in sensed.images.items()}
    blobs |= {frames[k]["lidar_path"]: merged_pcd(points) for k, points in sensed.sweeps.items()}
    for path, data in blobs.items():
        file = root / "sensor_blobs" / split / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    return write_frames(root, split, name, frames)


def write_frames(root: Path, split: str, name: str, frames: Sequence[Mapping[str, Any]]) -> Path:
    """The pickle as OpenScene's: a plain list, highest protocol."""
    path = root / "navsim_logs" / split / f"{name}.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(numpy_1_pickle(list(frames)))
    return path


def numpy_1_pickle(value: Any) -> bytes:
    """As NumPy 1 writes it, which OpenScene and NAVSIM run: NumPy 2 has moved what its pickles name."""
    data = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    opcodes = list(pickletools.genops(data))
    ends = [position for _, _, position in opcodes[1:]] + [len(data)]
    out = bytearray()
    for (opcode, argument, position), end in zip(opcodes, ends):
        if isinstance(argument, str) and argument.startswith("numpy._core."):
            moved = argument.replace("numpy._core.", "numpy.core.").encode()
            out += b"\x8c" + bytes([len(moved)]) + moved
        elif opcode.name != "FRAME":  # frames say their length, which is another now, and are optional
            out += data[position:end]
    return bytes(out)


def log_frames(
    name: str, log: WholeLog, place: Place, sensed: Sensed, world_from_ego: np.ndarray
) -> list[dict[str, Any]]:
    """The log's frames as dicts."""
    steps = range(0, len(log.ego_states), FRAME_STEPS)
    tokens = [hex16(name, "frame", step) for step in steps]
    frames = []
    for k, step in enumerate(steps):
        pose = world_from_ego[step].copy()
        pose[:3, 3] += place.offset
        can_bus = _can_bus(pose, log.ego_states[step])
        frames.append(
            {
                "token": tokens[k],
                "frame_idx": k,
                "timestamp": FIRST_STAMP_US + 500_000 * k,
                "log_name": name,
                "log_token": hex16(name),
                "scene_name": f"log-0001-{hex16(name, 'scene')}",
                "scene_token": hex16(name, "scene"),
                "map_location": place.location,
                "roadblock_ids": [place.roadblock_number(block) for block in log.route.roadblock_ids],
                "vehicle_name": "veh-51",
                "can_bus": can_bus,
                "lidar_path": f"{name}/MergedPointCloud/{tokens[k]}.pcd",
                "lidar2ego_translation": np.zeros(3),
                "lidar2ego_rotation": [1.0, 0.0, 0.0, 0.0],
                "ego2global_translation": can_bus[:3],  # a view, as there
                "ego2global_rotation": can_bus[3:7],
                "ego_dynamic_state": [float(log.ego_states[step, c]) for c in (VX, VX + 1, AX, AX + 1)],
                "traffic_lights": _lights(log, step, place),
                "driving_command": _command(log, step),
                "cams": {camera: _camera(camera, name, k, sensed) for camera in CAMERA_NAMES},
                "sample_prev": tokens[k - 1] if k else None,
                "sample_next": tokens[k + 1] if k + 1 < len(tokens) else None,
                "ego2global": pose,
                "lidar2ego": np.eye(4),
                "lidar2global": pose,
                "anns": _annotations(log, step, world_from_ego[step]),
                "occ_gt_final_path": f"{name}/occ/{tokens[k]}.npy",
                "flow_gt_final_path": f"{name}/flow/{tokens[k]}.npy",
            }
        )
    return frames


def merged_pcd(points: np.ndarray) -> bytes:
    """A merged sweep (N, 4) x, y, z, intensity as nuPlan's binary PCD."""
    record = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<u1"), ("ring", "<u1"), ("lidar_info", "<u1")]
    rows = np.zeros(len(points), record)
    for column, (name, _) in enumerate(record[:4]):
        rows[name] = points[:, column]
    header = [
        "# .PCD v.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in record)}",
        f"SIZE {' '.join(kind[2:] for _, kind in record)}",
        f"TYPE {' '.join(kind[1].upper() for _, kind in record)}",
        f"COUNT {' '.join('1' for _ in record)}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
    ]
    return ("\n".join(header) + "\n").encode() + rows.tobytes()


def sensed_by_town(log: AV2Log) -> Sensed:
    """What a town's log with all eight cameras recorded at its frames, under OpenScene's names."""
    cameras = {
        TOWN_CAMERAS[camera.name]: Camera(
            TOWN_CAMERAS[camera.name],
            *(camera.width, camera.height, camera.intrinsics, camera.distortion, camera.ego_from_camera),
        )
        for camera in log.cameras
    }
    images, sweeps = {}, {}
    for photo in log.images:
        k, between = divmod(round(photo.time_s / STEP_S), FRAME_STEPS)
        if not between:
            images[TOWN_CAMERAS[photo.sensor], k] = Path(photo.uri).read_bytes()
    for sweep in log.sweeps:
        k, between = divmod(round(sweep.time_s / STEP_S), FRAME_STEPS)
        if not between:
            table = pyarrow.feather.read_table(sweep.uri)
            sweeps[k] = np.stack([table[c].to_numpy().astype(np.float32) for c in ("x", "y", "z", "intensity")], axis=1)
    return Sensed(tuple(cameras[name] for name in CAMERA_NAMES if name in cameras), images, sweeps)


def _poses(log: WholeLog) -> np.ndarray:
    if isinstance(log, AV2Log):
        return world_from_ego_at(log.motion, step_times(0, len(log.ego_states)))
    poses = np.tile(np.eye(4), (len(log.ego_states), 1, 1))
    for pose, (x, y, heading) in zip(poses, log.ego_states[:, :3]):
        pose[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
        pose[:2, 3] = x, y
    return poses


def _can_bus(pose: np.ndarray, state: np.ndarray) -> np.ndarray:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    acceleration, velocity = [*state[[AX, AX + 1]], 0.0], [*state[[VX, VX + 1]], 0.0]
    return np.array([*pose[:3, 3], w, x, y, z, *acceleration, *velocity, 0.0, 0.0, 0.0, 0.0, 0.0])


def _lights(log: WholeLog, step: int, place: Place) -> list[tuple[int | str, bool]]:
    """Yellow and unknown lights are not red."""
    named = [place.lane_number(lane_id) for lane_id in log.lights.lane_ids]
    red = log.lights.states[step] == LightState.RED
    return [(int(lane) if lane.isdecimal() else lane, bool(is_red)) for lane, is_red in zip(named, red)]


def _command(log: WholeLog, step: int) -> np.ndarray:
    """By OpenScene's rule (helpers/driving_command.py), without our `driving_command`: the side of the route's point
    20 m ahead, seen along the route at the ego; 2 m or more are a turn, a route that ends before it is unknown.
    """
    pose = log.ego_states[step, :3]
    line = shapely.LineString(log.finder.centerline_from(pose)[:, :2])
    here = line.project(shapely.Point(pose[:2]))
    word = "unknown"
    if here + 20.0 <= line.length:
        points = [line.interpolate(here + ahead) for ahead in (0.0, 0.2, 20.0)]
        (x, y), (near_x, near_y), (far_x, far_y) = ((point.x, point.y) for point in points)
        length = np.hypot(near_x - x, near_y - y)
        side = ((near_x - x) * (far_y - y) - (near_y - y) * (far_x - x)) / length
        word = "left" if side >= 2.0 else "right" if side <= -2.0 else "straight"
    return np.array([int(word == known) for known in ("left", "straight", "right", "unknown")])


def _camera(camera: str, name: str, frame: int, sensed: Sensed) -> dict[str, Any]:
    found = next((known for known in sensed.cameras if known.name == camera), None)
    mount = np.eye(4) if found is None else found.ego_from_camera
    return {
        "data_path": f"{name}/{camera}/{hex16(name, camera, frame)}.jpg",
        "sensor2lidar_rotation": mount[:3, :3].copy(),
        "sensor2lidar_translation": mount[:3, 3].copy(),
        "cam_intrinsic": np.eye(3) if found is None else found.intrinsics.copy(),
        "distortion": np.zeros(5) if found is None else found.distortion.copy(),
    }


def _annotations(log: WholeLog, step: int, pose: np.ndarray) -> dict[str, Any]:
    agents = log.agents
    shown = np.flatnonzero(agents.valid[step])
    boxes, ego = agents.boxes[step, shown], log.ego_states[step]
    ego_heading = ego[HEADING]
    xy = points_to_local(ego[:3], boxes[:, :2])
    z = agents.center_z[step, shown] - pose[2, 3]
    c, s = np.cos(ego_heading), np.sin(ego_heading)
    velocities = agents.velocities[step, shown] @ np.array([[c, -s], [s, c]])
    return {
        "gt_boxes": np.column_stack([xy, z, boxes[:, 3:], agents.heights[shown], boxes[:, 2] - ego_heading]),
        "gt_names": np.array([AgentKind(agents.kinds[i]).value.lower() for i in shown]),
        "gt_velocity_3d": np.column_stack([velocities, np.zeros(len(shown))]),
        "instance_tokens": [hex16(agents.track_ids[i], step) for i in shown],
        "track_tokens": [hex16(agents.track_ids[i]) for i in shown],
    }
