"""A scene of NAVSIM's second stage: the pickle that `Scene.save_to_disk` writes, read without nuPlan's devkit.

Four frames of history, as a log's, and what others do in the 4 s after them as objects of nuPlan's classes in the
world's frame (autonomousvision/navsim @ 0a380a9, navsim/common/dataclasses.py:612-730). They are read as records: no
class is imported, and one that is not listed here is refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factory.datasets.navsim.log import (
    LOCATION_OF_ALIAS,
    Frame,
    FrameBoxes,
    Values,
    boxes_of,
    cameras_of,
    command_of,
    lights_of,
)
from factory.readers.base import BadClip, bytes_of
from factory.readers.pickles import Record, load_records
from tasks.world.clip import AgentKind
from tasks.world.frames import to_local, wrap_angle

HISTORY_FRAMES, FUTURE_FRAMES = 4, 8
FRAME_US = 500_000
PATHS = ("pathlib PosixPath", "pathlib PurePosixPath", "pathlib._local PosixPath")
CLASSES = (
    *PATHS,
    "nuplan.common.maps.maps_datatypes TrafficLightStatuses",
    "nuplan.common.maps.maps_datatypes TrafficLightStatusData",
    "nuplan.common.maps.maps_datatypes TrafficLightStatusType",
    "nuplan.planning.simulation.observation.observation_type DetectionsTracks",
    "nuplan.common.actor_state.tracked_objects TrackedObjects",
    "nuplan.common.actor_state.agent Agent",
    "nuplan.common.actor_state.static_object StaticObject",
    "nuplan.common.actor_state.scene_object SceneObjectMetadata",
    "nuplan.common.actor_state.tracked_objects_types TrackedObjectType",
    "nuplan.common.actor_state.oriented_box OrientedBox",
    "nuplan.common.actor_state.oriented_box Dimension",
    "nuplan.common.actor_state.state_representation StateSE2",
    "nuplan.common.actor_state.state_representation StateVector2D",
    "nuplan.common.actor_state.state_representation Point2D",
    "nuplan.common.actor_state.state_representation TimePoint",
)
RED = 2  # nuPlan's TrafficLightStatusType: green, yellow, red, unknown
KINDS = (  # nuPlan's TrackedObjectType, in its order
    *(AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.TRAFFIC_CONE),
    *(AgentKind.BARRIER, AgentKind.CZONE_SIGN, AgentKind.GENERIC_OBJECT),
)
ANNOTATIONS = {"gt_boxes": "boxes", "gt_names": "names", "gt_velocity_3d": "velocity_3d"}  # a log's key -> here


@dataclass(frozen=True)
class SyntheticScene:
    """A second-stage scene: four frames, and the objects and lights of up to eight more.

    The ego of the later frames is unknown: they stand at the pose of the fourth, in whose frame their boxes are. Boxes
    of later frames have no height above the ground (NaN).
    """

    file: str
    token: str  # of the fourth frame, 17 digits
    scene_token: str
    log_name: str
    original_scene: str | None  # token of the log's frame at the same time
    original_token: str | None  # token of the stage-one frame, 4 s before
    frames: tuple[Frame, ...]  # HISTORY_FRAMES and what follows


def read_scene_pickle(path: Path, *, as_shown: bool = False) -> SyntheticScene:
    """The scene in this pickle; as_shown: what an agent is shown of it. Raises BadClip, naming frame and key."""
    return scene_of_pickle(load_records(bytes_of(path), str(path), CLASSES), str(path), as_shown=as_shown)


def scene_of_pickle(value: Any, file: str, *, as_shown: bool = False) -> SyntheticScene:
    """What a scene's pickle holds, checked; as_shown: four frames without boxes, whatever else is there or not.

    Raises BadClip.
    """
    if not isinstance(value, Mapping):
        raise BadClip(file, "scene", f"holds a {type(value).__name__}, expected a dict")
    values = Values(value, file)
    about = values.inner("scene_metadata")
    items = _list(values, "frames")
    if len(items) != about.integer("num_history_frames") + about.integer("num_future_frames"):
        raise values.bad("frames", f"{len(items)}, the scene's metadata say otherwise")
    if about.integer("num_history_frames") != HISTORY_FRAMES:
        raise about.bad("num_history_frames", f"expected {HISTORY_FRAMES}")
    history = [
        _frame(Values(item, file, f"frames[{i}]."), about, as_shown=as_shown)
        for i, item in enumerate(items[:HISTORY_FRAMES])
    ]
    if history[-1].token != about.text("initial_token"):
        raise about.bad("initial_token", f"is not {history[-1].token}, the token of frames[{HISTORY_FRAMES - 1}]")
    return SyntheticScene(
        file=file,
        token=history[-1].token,
        scene_token=about.text("scene_token"),
        log_name=about.text("log_name"),
        original_scene=_token(about, "corresponding_original_scene", "corresponding_orignal_scene"),  # v2.0's spelling
        original_token=_token(about, "corresponding_original_initial_token"),
        frames=(*history, *(() if as_shown else _later(values, history[-1]))),
    )


def _frame(values: Values, about: Values, *, as_shown: bool) -> Frame:
    """One frame's dict. Raises BadClip."""
    if not isinstance(values.items, Mapping):
        raise BadClip(values.file, values.place.rstrip("."), f"is a {type(values.items).__name__}, expected a dict")
    ego = values.inner("ego_status")
    if ego.get("in_global_frame") is not True:
        raise ego.bad("in_global_frame", "must be True: a scene's poses are the world's")
    pose = ego.numbers("ego_pose", (3,))
    location = about.text("map_name")
    motion = [ego.numbers(key, (2,)) for key in ("ego_velocity", "ego_acceleration")]
    return Frame(
        token=values.text("token"),
        timestamp_us=values.integer("timestamp"),
        log_name=about.text("log_name"),
        scene_token=about.text("scene_token"),
        map_location=LOCATION_OF_ALIAS.get(location, location),
        roadblock_ids=values.texts("roadblock_ids"),
        pose=pose,
        world_from_ego=_level(*pose),
        dynamic_state=np.concatenate(motion),
        lights=lights_of(values),
        command=command_of(ego),
        cameras=cameras_of(
            Values(_without_paths(values.get("camera_dict")), values.file, f"{values.place}camera_dict.")
        ),
        lidar_path=None,
        boxes=None if as_shown else boxes_of(values.inner("annotations"), ANNOTATIONS),
    )


def _later(values: Values, now: Frame) -> list[Frame]:
    """The frames after the last, 0.5 s apart. Raises BadClip."""
    tracks, lights = _list(values, "extended_detections_tracks"), _list(values, "extended_traffic_light_data")
    if len(tracks) < FUTURE_FRAMES or len(lights) < FUTURE_FRAMES:
        found = f"{len(tracks)} and {len(lights)} of extended_traffic_light_data"
        raise values.bad("extended_detections_tracks", f"{found}, expected {FUTURE_FRAMES}: 4 s are driven")
    return [
        replace(
            now,
            token=f"{now.token}+{i}",
            timestamp_us=now.timestamp_us + i * FRAME_US,
            cameras=(),
            lights=_lights(values, light, f"extended_traffic_light_data[{i - 1}]"),
            boxes=_boxes(values, track, f"extended_detections_tracks[{i - 1}]", now),
        )
        for i, (track, light) in enumerate(zip(tracks[:FUTURE_FRAMES], lights), 1)
    ]


def _lights(values: Values, statuses: Any, place: str) -> tuple[tuple[str, bool], ...]:
    found = _list(_fields(values, statuses, "TrafficLightStatuses", place), "traffic_lights")
    out = []
    for k, light in enumerate(found):
        fields = _fields(values, light, "TrafficLightStatusData", f"{place}.traffic_lights[{k}]")
        out.append((str(fields.integer("lane_connector_id")), _enum(fields, "status", "TrafficLightStatusType") == RED))
    return tuple(out)


def _boxes(values: Values, tracks: Any, place: str, now: Frame) -> FrameBoxes:
    """The objects of one instant, in the frame of the ego at now."""
    holder = _fields(values, tracks, "DetectionsTracks", place)
    inner = f"{place}.tracked_objects"
    found = _list(_fields(values, holder.get("tracked_objects"), "TrackedObjects", inner), "tracked_objects")
    poses, sizes, velocities = np.zeros((len(found), 3)), np.zeros((len(found), 3)), np.zeros((len(found), 3))
    kinds, names, instances = [], [], []
    for k, item in enumerate(found):
        thing = _fields(values, item, None, f"{inner}[{k}]")
        number = _enum(thing, "_tracked_object_type", "TrackedObjectType")
        if number >= len(KINDS):
            raise thing.bad("_tracked_object_type", f"is {number}, expected 0 .. {len(KINDS) - 1}")
        kinds.append(KINDS[number])
        about = _fields(values, thing.get("_metadata"), "SceneObjectMetadata", f"{thing.place}_metadata")
        names.append(about.text("track_token"))
        instances.append(about.text("token"))
        box = _fields(values, thing.get("_box"), "OrientedBox", f"{thing.place}_box")
        center = _fields(values, box.get("_center"), "StateSE2", f"{box.place}_center")
        poses[k] = [_number(center, key) for key in ("x", "y", "heading")]
        sizes[k] = [_number(box, key) for key in ("_length", "_width", "_height")]
        if "_velocity" in thing.items:  # nuPlan's static objects have none
            moves = _fields(values, thing.get("_velocity"), "StateVector2D", f"{thing.place}_velocity")
            velocities[k, :2] = _number(moves, "_x"), _number(moves, "_y")
    if len(set(names)) < len(names):
        raise values.bad(place, "a track stands twice")
    if (sizes <= 0.0).any():
        raise values.bad(place, "a box has a size that is not positive")
    local = to_local(now.pose, poses)
    c, s = np.cos(now.pose[2]), np.sin(now.pose[2])
    velocities[:, :2] = velocities[:, :2] @ np.array([[c, -s], [s, c]])
    boxes = np.column_stack([local[:, :2], np.full(len(found), np.nan), sizes, wrap_angle(local[:, 2])])
    return FrameBoxes(boxes, tuple(kinds), velocities, tuple(names), tuple(instances))


def _fields(values: Values, record: Any, name: str | None, place: str) -> Values:
    """The fields of an object of the class `name`, of Agent or StaticObject where it is None. Raises BadClip."""
    wanted = ("Agent", "StaticObject") if name is None else (name,)
    if not isinstance(record, Record) or record.name not in wanted:
        got = record.name if isinstance(record, Record) else type(record).__name__
        raise values.bad(place, f"is a {got}, expected {' or '.join(wanted)}")
    return Values(record.state, values.file, f"{place}.")


def _enum(values: Values, key: str, name: str) -> int:
    """The number of an enumeration's member. Raises BadClip."""
    record = values.get(key)
    if not isinstance(record, Record) or record.name != name or len(record.arguments) != 1:
        raise values.bad(key, f"is no {name}")
    return Values({key: record.arguments[0]}, values.file, values.place).integer(key)


def _number(values: Values, key: str) -> float:
    return float(values.numbers(key, ()))


def _list(values: Values, key: str) -> list[Any]:
    found = values.get(key)
    if not isinstance(found, list):
        raise values.bad(key, f"is a {type(found).__name__}, expected a list")
    return found


def _token(values: Values, *keys: str) -> str | None:
    """The first of the keys that is there; None where none is, or it is null. Raises BadClip."""
    key = next((key for key in keys if key in values.items), None)
    return None if key is None or values.get(key) is None else values.text(key)


def _without_paths(value: Any) -> Any:
    """With pathlib's paths as text."""
    if isinstance(value, Record) and f"{value.module} {value.name}" in PATHS:
        return str(Path(*map(str, value.arguments)))
    if isinstance(value, dict):
        return {key: _without_paths(item) for key, item in value.items()}
    return value


def _level(x: float, y: float, heading: float) -> Any:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    pose[:2, 3] = x, y
    return pose
