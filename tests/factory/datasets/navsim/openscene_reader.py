"""A folder in NAVSIM's layout, read as NAVSIM and SimScale read it: written from their public code alone.

Nothing here knows how such a folder is written by the factory, so that its tests can hold one against the other. The
lines that each rule follows are those of autonomousvision/navsim at 0a380a9 (`dataclasses`, `dataloader`) and of
OpenDriveLab/SimScale at f51ad64 (`gtrs_agent`, `dataset`, `hydra_features`). What the public code would stop at, or
pass by in silence, raises: KeyError for a key that it looks up, Unreadable for all else.
"""

import importlib
import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

CAMERAS = ("cam_f0", "cam_l0", "cam_l1", "cam_l2", "cam_r0", "cam_r1", "cam_r2", "cam_b0")
CAMERA_KEYS = ("data_path", "sensor2lidar_rotation", "sensor2lidar_translation", "cam_intrinsic", "distortion")
CAMERA_SHAPE = (1080, 1920, 3)  # the agents' crops assume it (transfuser_features)
MAP_LOCATIONS = {"sg-one-north", "us-ma-boston", "us-nv-las-vegas-strip", "us-pa-pittsburgh-hazelwood"}
OBJECT_NAMES = {"vehicle", "pedestrian", "bicycle", "traffic_cone", "barrier", "czone_sign", "generic_object", "ego"}
SYNTHETIC_LENGTH = 17  # characters of a second stage's token (metric_cache_processor, compute_metric_cache)
PLANNED_FRAMES = 8  # 4 s of 0.5 s

Numbers = NDArray[Any]


class Unreadable(ValueError):
    """What the public code cannot use, or would leave out without a word."""


@dataclass(frozen=True)
class SceneFilter:
    """`navsim.common.dataclasses.SceneFilter`: which windows of which logs are scenes."""

    num_history_frames: int = 4
    num_future_frames: int = 10
    frame_interval: int | None = None
    has_route: bool = True
    max_scenes: int | None = None
    log_names: Sequence[str] | None = None
    tokens: Sequence[str] | None = None
    include_synthetic_scenes: bool = False
    all_mapping: Any = None
    synthetic_scene_tokens: Sequence[str] | None = None
    reactive_synthetic_initial_tokens: Sequence[str] | None = None
    non_reactive_synthetic_initial_tokens: Sequence[str] | None = None

    @property
    def num_frames(self) -> int:
        return self.num_history_frames + self.num_future_frames


@dataclass(frozen=True)
class Shot:
    """One camera of one frame. p_lidar = rotation p_camera + translation, camera axes right, down, ahead."""

    file: Path
    rotation: Numbers  # (3, 3)
    translation: Numbers  # (3,) m
    intrinsics: Numbers  # (3, 3) px
    distortion: Numbers  # (5,) k1, k2, p1, p2, k3

    def image(self) -> NDArray[np.uint8]:
        """(1080, 1920, 3) RGB, decoded as `Cameras.from_camera_dict` does."""
        try:
            pixels = np.array(Image.open(self.file))
        except OSError as error:
            raise Unreadable(f"{self.file}: {error}") from error
        if pixels.shape != CAMERA_SHAPE or pixels.dtype != np.uint8:
            raise Unreadable(f"{self.file}: {pixels.shape} of {pixels.dtype}; agents cut {CAMERA_SHAPE} of uint8")
        return pixels


@dataclass(frozen=True)
class Frame:
    """One moment of a scene, as `Scene` holds it."""

    token: str
    timestamp_us: int
    pose: Numbers  # (3,) float64 x, y, yaw, global
    velocity: Numbers  # (2,) float32 m/s, ego axes
    acceleration: Numbers  # (2,) float32 m/s2, ego axes
    command: Numbers  # (4,) one-hot left, straight, right, unknown
    boxes: Numbers  # (N, 7) centre x, y, z, length, width, height, yaw in the ego frame
    names: Numbers  # (N,) str
    velocities: Numbers  # (N, 3) m/s, ego axes
    track_tokens: tuple[str, ...]
    roadblock_ids: tuple[str, ...]
    traffic_lights: tuple[tuple[int, bool], ...]  # lane connector, red
    cameras: Mapping[str, Shot]


@dataclass(frozen=True)
class Scene:
    """One sample: `AgentInput` and what training targets are made of."""

    token: str  # of the current frame
    log_name: str
    scene_token: str
    map_name: str
    frames: tuple[Frame, ...]
    n_history: int  # frames up to now

    @property
    def simulated(self) -> bool:
        """Whether SimScale takes it for a simulated sample (gtrs_agent.compute_loss)."""
        return "-" in self.token

    @property
    def second_stage(self) -> bool:
        """Whether the metric takes it for a synthetic scene of a second stage, without a human to compare with."""
        return len(self.token) == SYNTHETIC_LENGTH

    @property
    def now(self) -> Frame:
        return self.frames[self.n_history - 1]

    def history(self) -> NDArray[np.float32]:
        """(n_history, 3) poses in the ego frame at now, float32 as `AgentInput.from_scene_dict_list` makes them."""
        poses = np.stack([frame.pose for frame in self.frames[: self.n_history]])
        return local_poses(self.now.pose, poses).astype(np.float32)

    def status(self) -> NDArray[np.float32]:
        """(8,) command, velocity, acceleration: `status_feature` of hydra_features."""
        return np.concatenate([self.now.command, self.now.velocity, self.now.acceleration], dtype=np.float32)

    def future(self, n: int = PLANNED_FRAMES) -> NDArray[np.float64]:
        """(n, 3) poses in the ego frame at now: `Scene.get_future_trajectory(n)`."""
        ahead = self.frames[self.n_history : self.n_history + n]
        if len(ahead) < n:
            raise Unreadable(f"{self.token}: {len(ahead)} frames after now, a plan's label takes {n}")
        return local_poses(self.now.pose, np.stack([frame.pose for frame in ahead]))


def local_poses(origin: Numbers, poses: Numbers) -> NDArray[np.float64]:
    """`convert_absolute_to_relative_se2_array`."""
    cos, sin = np.cos(-origin[2]), np.sin(-origin[2])
    relative = poses - origin
    relative[:, :2] = relative[:, :2] @ np.array([[cos, -sin], [sin, cos]]).T
    relative[:, 2] = np.arctan2(np.sin(relative[:, 2]), np.cos(relative[:, 2]))
    return relative


def yaw_of(wxyz: Sequence[float]) -> float:
    """pyquaternion's `yaw_pitch_roll[0]`. Of a tilted pose it is not the angle of the heading seen from above."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    return float(np.arctan2(2 * (w * z - x * y), 1 - 2 * (y**2 + z**2)))


def read_scenes(logs: Path, blobs: Path, chosen: SceneFilter) -> dict[str, Scene]:
    """Token -> scene of `navsim_logs/<split>` and `sensor_blobs/<split>`: `filter_scenes` and `SceneLoader`.

    A token or a log that the filter names and the folder lacks raises, where the public code goes on with fewer.
    """
    files = sorted(logs.iterdir())
    if chosen.log_names is not None:
        names = set(chosen.log_names)
        files = [file for file in files if file.name.replace(".pkl", "") in names]
        if len(files) < len(names):
            raise Unreadable(f"{logs}: no file for {sorted(names - {file.stem for file in files})}")
    scenes: dict[str, Scene] = {}
    for file in files:
        for window in _windows(_load(file), chosen):
            scene = _scene(window, chosen, blobs)
            if scene.log_name != file.stem or window[0]["log_name"] != file.stem:
                raise Unreadable(f"{file}: frames of log {scene.log_name}; scenes are looked for by the file's name")
            if scene.token in scenes:
                raise Unreadable(f"{file}: token {scene.token} once more; the later one replaces the earlier")
            scenes[scene.token] = scene
            if chosen.max_scenes is not None and len(scenes) >= chosen.max_scenes:
                return scenes
    missing = set(chosen.tokens or ()) - set(scenes)
    if missing:
        raise Unreadable(f"{logs}: no scene for tokens {sorted(missing)}")
    return scenes


def _windows(frames: list[dict[str, Any]], chosen: SceneFilter) -> Iterator[list[dict[str, Any]]]:
    now = chosen.num_history_frames - 1
    for start in range(0, len(frames), chosen.frame_interval or chosen.num_frames):
        window = frames[start : start + chosen.num_frames]
        if len(window) < chosen.num_frames or (chosen.has_route and not len(window[now]["roadblock_ids"])):
            continue
        if chosen.tokens is None or window[now]["token"] in chosen.tokens:
            yield window


def _scene(window: list[dict[str, Any]], chosen: SceneFilter, blobs: Path) -> Scene:
    now = window[chosen.num_history_frames - 1]
    name = now["token"]
    if now["map_location"] not in MAP_LOCATIONS:
        raise Unreadable(f"{name}: map_location {now['map_location']}: none of {sorted(MAP_LOCATIONS)}")
    frames = tuple(_frame(frame, blobs) for frame in window)
    times = [frame.timestamp_us for frame in frames]
    if np.any(np.diff(times) <= 0):
        raise Unreadable(f"{name}: timestamps do not increase; histories are interpolated over them")
    scene = Scene(name, now["log_name"], now["scene_token"], now["map_location"], frames, chosen.num_history_frames)
    if scene.simulated and scene.second_stage:
        raise Unreadable(f"{name}: {SYNTHETIC_LENGTH} characters make it a scene of the second stage")
    return scene


def _frame(frame: Mapping[str, Any], blobs: Path) -> Frame:
    name = frame["token"]
    found = frame["anns"]
    arrays = [found[k] for k in ("gt_boxes", "gt_names", "gt_velocity_3d", "instance_tokens", "track_tokens")]
    boxes, names, velocities, _, tracks = arrays
    if len({len(array) for array in arrays}) != 1:
        raise Unreadable(f"{name}: anns of lengths {[len(array) for array in arrays]}; they must be equal")
    if not isinstance(names, np.ndarray):
        raise Unreadable(f"{name}: gt_names is a {type(names).__name__}; it is indexed with a mask")
    for array, width in ((boxes, 7), (velocities, 3)):
        if len(array) and np.shape(array) != (len(array), width):
            raise Unreadable(f"{name}: anns of shape {np.shape(array)}, not (N, {width})")
    unknown = {str(n) for n in names} - OBJECT_NAMES
    if unknown:
        raise KeyError(f"{name}: gt_names {sorted(unknown)}")
    if len(set(tracks)) < len(tracks):
        raise Unreadable(f"{name}: a track token twice in a frame; boxes are interpolated by it")
    if not isinstance(frame["lidar_path"], str):
        raise Unreadable(f"{name}: lidar_path {frame['lidar_path']}: NAVSIM makes a Path of it; none is ''")
    shape = np.shape(frame["driving_command"])
    if shape != (4,):
        raise Unreadable(f"{name}: driving_command of shape {shape}, not (4,)")
    x, y = np.asarray(frame["ego2global_translation"], np.float64)[:2]
    dynamic = frame["ego_dynamic_state"]
    if len(dynamic) != 4:
        raise Unreadable(f"{name}: ego_dynamic_state of {len(dynamic)} numbers, not vx, vy, ax, ay")
    return Frame(
        token=name,
        timestamp_us=int(frame["timestamp"]),
        pose=np.array([x, y, yaw_of(frame["ego2global_rotation"])]),
        velocity=np.array(dynamic[:2], np.float32),
        acceleration=np.array(dynamic[2:], np.float32),
        command=np.asarray(frame["driving_command"]),
        boxes=np.asarray(boxes, np.float64).reshape(-1, 7),
        names=names,
        velocities=np.asarray(velocities, np.float64).reshape(-1, 3),
        track_tokens=tuple(tracks),
        roadblock_ids=tuple(frame["roadblock_ids"]),
        traffic_lights=tuple((int(connector), bool(red)) for connector, red in frame["traffic_lights"]),
        cameras=_cameras(frame["cams"], blobs),
    )


def _cameras(cams: Mapping[str, Mapping[str, Any]], blobs: Path) -> dict[str, Shot]:
    by_name = {name.lower(): camera for name, camera in cams.items()}
    shots = {}
    for name in CAMERAS:
        file, *numbers = [by_name[name][key] for key in CAMERA_KEYS]
        rotation, translation, intrinsics, distortion = [np.asarray(array, np.float64) for array in numbers]
        shapes = rotation.shape, translation.shape, intrinsics.shape, distortion.shape
        if shapes != ((3, 3), (3,), (3, 3), (5,)):
            raise Unreadable(f"{name} of {file}: calibration of shapes {shapes}")
        shots[name] = Shot(blobs / file, rotation, translation, intrinsics, distortion)
    return shots


def read_scene_filter(file: Path) -> SceneFilter:
    """A file of `train_test_split/scene_filter`, which Hydra makes the dataclass of. A key it has not raises."""
    values = dict(yaml.safe_load(file.read_text()))
    target = values.pop("_target_", None)
    if target != "navsim.common.dataclasses.SceneFilter":
        raise Unreadable(f"{file}: _target_ {target}")
    values.pop("_convert_", None)
    unknown = set(values) - {field.name for field in fields(SceneFilter)}
    if unknown:
        raise Unreadable(f"{file}: SceneFilter takes no {sorted(unknown)}")
    chosen = SceneFilter(**values)
    if chosen.num_history_frames < 1 or chosen.num_future_frames < 0 or (chosen.frame_interval or 1) < 1:
        raise Unreadable(f"{file}: frames {chosen.num_history_frames}, {chosen.num_future_frames}")
    return chosen


def read_split(file: Path) -> tuple[str, SceneFilter]:
    """A file of `train_test_split`: its `data_split`, and the scene filter that its defaults name, beside it."""
    values = yaml.safe_load(file.read_text())
    names = [
        entry["scene_filter"] for entry in values["defaults"] if isinstance(entry, dict) and "scene_filter" in entry
    ]
    if len(names) != 1:
        raise Unreadable(f"{file}: defaults name {len(names)} scene filters")
    return values["data_split"], read_scene_filter(file.parent / "scene_filter" / f"{names[0]}.yaml")


def _load(file: Path) -> Any:
    try:
        return _NumpyOnly(io.BytesIO(file.read_bytes())).load()
    except (pickle.UnpicklingError, EOFError) as error:
        raise Unreadable(f"{file}: {error}") from error


class _NumpyOnly(pickle.Unpickler):
    """Plain values and arrays, by the names that numpy 1.23 has: NAVSIM pins 1.23.4, which knows no `numpy._core`."""

    NAMES = frozenset(
        {
            ("numpy", "dtype"),
            ("numpy", "ndarray"),
            ("numpy.core.multiarray", "_reconstruct"),
            ("numpy.core.multiarray", "scalar"),
            ("numpy.core.numeric", "_frombuffer"),
        }
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.NAMES:
            raise pickle.UnpicklingError(f"{module}.{name}: not there in NAVSIM's environment, or no data")
        return getattr(importlib.import_module(module.replace("numpy.core", "numpy._core")), name)
