"""Writes second-stage scenes as NAVSIM's `Scene.save_to_disk` does, without nuPlan: classes of the same names, pickled.

Field by field as the real ones: points in space and time have slots, TrackedObjectType carries a second value, a
StaticObject has no velocity.
"""

import enum
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import yaml

from tests.factory.datasets.navsim.openscene_writer import numpy_1_pickle

STATE = "nuplan.common.actor_state.state_representation"
CAMERAS = ("cam_f0", "cam_l0", "cam_l1", "cam_l2", "cam_r0", "cam_r1", "cam_r2", "cam_b0")


class Thing:
    """Whatever fields it is given."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


def _kind(number: int) -> Any:
    return TYPES["nuplan.common.actor_state.tracked_objects_types TrackedObjectType"](number)


class TrafficLightStatusType(enum.IntEnum):
    GREEN = 0
    YELLOW = 1
    RED = 2
    UNKNOWN = 3


class TrackedObjectType(enum.Enum):
    VEHICLE = 0, "vehicle"
    PEDESTRIAN = 1, "pedestrian"
    BICYCLE = 2, "bicycle"
    TRAFFIC_CONE = 3, "traffic_cone"
    BARRIER = 4, "barrier"
    CZONE_SIGN = 5, "czone_sign"
    GENERIC_OBJECT = 6, "generic_object"
    EGO = 7, "ego"

    def __new__(cls, value: int, name: str) -> "TrackedObjectType":
        member = object.__new__(cls)
        member._value_ = value
        return member


def _slotted(name: str, *slots: str) -> Any:
    """A class without a dictionary of its fields."""

    def begin(self: Any, *values: Any, **fields: Any) -> None:
        for key, value in (*zip(slots, values), *fields.items()):
            setattr(self, key, value)

    return type(name, (), {"__slots__": slots, "__init__": begin})


TimePoint = _slotted("TimePoint", "time_us")
SLOTTED = (_slotted("StateSE2", "x", "y", "heading"), _slotted("StateVector2D", "_x", "_y", "_array"), TimePoint)
TYPES: dict[str, Any] = {
    f"{module} {name}": type(name, (Thing,), {})
    for module, names in {
        "nuplan.common.maps.maps_datatypes": ("TrafficLightStatuses", "TrafficLightStatusData"),
        "nuplan.planning.simulation.observation.observation_type": ("DetectionsTracks",),
        "nuplan.common.actor_state.tracked_objects": ("TrackedObjects",),
        "nuplan.common.actor_state.agent": ("Agent",),
        "nuplan.common.actor_state.static_object": ("StaticObject",),
        "nuplan.common.actor_state.scene_object": ("SceneObjectMetadata",),
        "nuplan.common.actor_state.oriented_box": ("OrientedBox",),
    }.items()
    for name in names
}
TYPES["nuplan.common.maps.maps_datatypes TrafficLightStatusType"] = TrafficLightStatusType
TYPES["nuplan.common.actor_state.tracked_objects_types TrackedObjectType"] = TrackedObjectType
TYPES |= {f"{STATE} {kind.__name__}": kind for kind in SLOTTED}


@contextmanager
def importable(types: Mapping[str, Any] = TYPES) -> Iterator[None]:
    """The classes under nuPlan's names, for as long as something is pickled by reference to them."""
    modules: dict[str, ModuleType] = {}
    for words, kind in types.items():
        module, name = words.split(" ")
        for i in range(1, module.count(".") + 2):
            part = ".".join(module.split(".")[:i])
            modules.setdefault(part, ModuleType(part))
        setattr(modules[module], name, kind)
        kind.__module__, kind.__qualname__ = module, name
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]


def new(name: str, **fields: Any) -> Any:
    """An object of nuPlan's class of that name."""
    return next(kind for words, kind in TYPES.items() if words.endswith(f" {name}"))(**fields)


def _statuses(lights: list[tuple[int, TrafficLightStatusType]], stamp_us: int) -> Any:
    stamp = TimePoint(stamp_us)
    return new(
        "TrafficLightStatuses",
        traffic_lights=[
            new("TrafficLightStatusData", status=s, lane_connector_id=lane_id, timestamp=stamp) for lane_id, s in lights
        ],
    )


def detections(things: list[tuple[int, str, np.ndarray, Any, Any]], token: str) -> Any:
    """Of kind, track token, x y heading, length width height, velocity each."""
    found = []
    for number, track, pose, sizes, velocity in things:
        x, y, heading = map(np.float64, pose)
        names = {"token": token, "track_id": None, "track_token": track, "category_name": None}
        center = new("StateSE2", x=x, y=y, heading=heading)
        fields = {
            "_metadata": new("SceneObjectMetadata", timestamp_us=0, **names),
            "instance_token": None,
            "_tracked_object_type": _kind(number),
            "_box": new("OrientedBox", _center=center, **dict(zip(("_length", "_width", "_height"), sizes))),
        }
        moving = {"_velocity": new("StateVector2D", _x=velocity[0], _y=velocity[1], _array=np.array(velocity))}
        found.append(new("StaticObject", **fields) if number >= 3 else new("Agent", **fields, **moving))
    return new("DetectionsTracks", tracked_objects=new("TrackedObjects", tracked_objects=found))


def scene_of_log(frames: list[dict[str, Any]], at: int, token: str, cameras: bool = False) -> dict[str, Any]:
    """A log's own frames (as OpenScene's dicts) around frame `at`, as if somebody had simulated them.

    cameras: with the log's pictures, by their paths.
    """
    now = frames[at]
    about = {
        "log_name": now["log_name"],
        "scene_token": token,
        "map_name": now["map_location"],
        "initial_token": token,
        "num_history_frames": 4,
        "num_future_frames": 0,
        "corresponding_original_scene": now["token"],
        "corresponding_original_initial_token": frames[at - 8]["token"] if at >= 8 else None,
    }
    return {
        "scene_metadata": about,
        "frames": [
            _log_frame(frame, token if frame is now else frame["token"], cameras) for frame in frames[at - 3 : at + 1]
        ],
        "extended_traffic_light_data": [
            _statuses(
                [(lane, TrafficLightStatusType.RED if red else TrafficLightStatusType.GREEN) for lane, red in lights],
                0,
            )
            for lights in (frame["traffic_lights"] for frame in frames[at + 1 : at + 9])
        ],
        "extended_detections_tracks": [_log_tracks(frame) for frame in frames[at + 1 : at + 9]],
    }


def _heading(frame: dict[str, Any]) -> float:
    w, x, y, z = frame["ego2global_rotation"]
    return float(np.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y**2 + z**2)))


def _log_frame(frame: dict[str, Any], token: str, cameras: bool) -> dict[str, Any]:
    anns, motion = frame["anns"], np.array(frame["ego_dynamic_state"], np.float32)
    return {
        "token": token,
        "timestamp": frame["timestamp"],
        "roadblock_ids": frame["roadblock_ids"],
        "traffic_lights": frame["traffic_lights"],
        "annotations": {
            "boxes": anns["gt_boxes"],
            "names": anns["gt_names"],
            "velocity_3d": anns["gt_velocity_3d"],
            "instance_tokens": anns["instance_tokens"],
            "track_tokens": anns["track_tokens"],
        },
        "ego_status": {
            "ego_pose": np.array([*frame["ego2global_translation"][:2], _heading(frame)]),
            "ego_velocity": motion[:2],
            "ego_acceleration": motion[2:],
            "driving_command": frame["driving_command"],
            "in_global_frame": True,
        },
        "lidar_path": None,
        "camera_dict": {
            name: {**frame["cams"][name.upper()], "data_path": Path(frame["cams"][name.upper()]["data_path"])}
            if cameras
            else {}
            for name in CAMERAS
        },
    }


def _log_tracks(frame: dict[str, Any]) -> Any:
    anns, heading = frame["anns"], _heading(frame)
    c, s = np.cos(heading), np.sin(heading)
    numbers = {kind.name.lower(): kind.value for kind in TrackedObjectType}
    things = []
    for box, name, velocity, track in zip(
        anns["gt_boxes"], anns["gt_names"], anns["gt_velocity_3d"], anns["track_tokens"]
    ):
        x, y = np.array([[c, -s], [s, c]]) @ box[:2] + frame["ego2global_translation"][:2]
        vx, vy = np.array([[c, -s], [s, c]]) @ velocity[:2]
        things.append((numbers[str(name)], track, np.array([x, y, box[6] + heading]), box[3:6], (vx, vy)))
    return detections(things, frame["token"])


def write_scene(folder: Path, value: dict[str, Any]) -> Path:
    """The pickle, named by its scene."""
    path = folder / f"{value['scene_metadata']['scene_token']}.pkl"
    with importable():
        path.write_bytes(numpy_1_pickle(value))
    return path


def write_split(folder: Path, name: str, tokens: Sequence[str], groups: Any, **other: Any) -> Path:
    """<name>.yaml, which says what are follow-ups of what, and scene_filter/<name>.yaml with the public files' keys."""
    chosen = {"_target_": "navsim.common.dataclasses.SceneFilter", "_convert_": "all", "num_history_frames": 4}
    chosen |= {"num_future_frames": 8, "frame_interval": 1, "has_route": True, "max_scenes": None, "log_names": None}
    chosen |= {"tokens": list(tokens), "include_synthetic_scenes": True} | other
    split = {"defaults": [{"scene_filter": name}], "data_split": "test", "reactive_all_mapping": groups}
    (folder / "scene_filter").mkdir(parents=True, exist_ok=True)
    (folder / "scene_filter" / f"{name}.yaml").write_text(yaml.safe_dump(chosen))
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(split))
    return folder / f"{name}.yaml"
