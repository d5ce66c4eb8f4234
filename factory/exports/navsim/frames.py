"""A sample as the twelve frames of an OpenScene log: a list of dictionaries, as NAVSIM's loader reads it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from factory.exports.navsim.motion import INSTANTS, FrameMotion, frame_motion
from factory.exports.navsim.names import N_FRAMES, SampleNames, hex16
from factory.exports.navsim.settings import MAP_LOCATIONS, CannotExport, ExportSettings
from factory.store.schema import AGENT_STEPS
from tasks.world.frames import to_local

COMMANDS = ("left", "straight", "right", "unknown")  # NAVSIM's one-hot, its "forward" being our "straight"
RED = 3
Frame = dict[str, Any]


def log_frames(
    row: Mapping[str, Any], names: SampleNames, cams: tuple[Mapping[str, Any], ...], settings: ExportSettings
) -> list[Frame]:
    """The frames of one sample. Raises CannotExport for a place that the public code does not know."""
    motion, place = frame_motion(row), place_of(row, settings)
    command = np.array([row["command"] == name for name in COMMANDS], dtype=np.int64)
    return [
        {
            "token": names.tokens[i],
            "frame_idx": i,
            "timestamp": round(1e6 * names.times_s[i]),
            "log_name": names.log,
            "log_token": names.scene,
            "scene_name": names.log,
            "scene_token": names.scene,
            "map_location": place,
            "roadblock_ids": [str(block) for block in row["route_roadblock_ids"]],
            "vehicle_name": str(row["dataset"]),
            "can_bus": _can_bus(motion, i),
            "lidar_path": "",
            "lidar2ego_translation": np.zeros(3),
            "lidar2ego_rotation": [1.0, 0.0, 0.0, 0.0],
            "ego2global_translation": motion.global_from_ego[i, :3, 3].copy(),
            "ego2global_rotation": motion.quaternions[i].copy(),
            "ego_dynamic_state": [float(value) for value in motion.dynamics[i]],
            "traffic_lights": _lights(row, i),
            "driving_command": command.copy(),
            "cams": cams[i],
            "sample_prev": names.tokens[i - 1] if i > 0 else None,
            "sample_next": names.tokens[i + 1] if i + 1 < N_FRAMES else None,
            "ego2global": motion.global_from_ego[i].copy(),
            "lidar2ego": np.eye(4),
            "lidar2global": motion.global_from_ego[i].copy(),
            "anns": _annotations(row, names, motion, i),
        }
        for i in range(N_FRAMES)
    ]


def place_of(row: Mapping[str, Any], settings: ExportSettings) -> str:
    """One of MAP_LOCATIONS. Raises CannotExport."""
    place = settings.map_location or str(row["map_location"])
    if place not in MAP_LOCATIONS:
        raise CannotExport(
            f"log {row['log_id']}: its map is of {place or 'no named place'}, and the public code knows only "
            f"{', '.join(MAP_LOCATIONS)}: give map_location=<one of them>, and it the map of these logs in a maps root "
            "of their own"
        )
    return place


def connector_number(lane_id: str) -> int:
    """A lane connector's id as the number that a light is keyed by: its own where it is one, else 60 bits of a hash."""
    return int(lane_id) if lane_id.isascii() and lane_id.isdecimal() else int(hex16(lane_id)[:15], 16)


def _can_bus(motion: FrameMotion, i: int) -> Any:
    """(18,) position, quaternion, acceleration, velocity, angular rate, two zeros; the vectors in ego axes."""
    vx, vy, ax, ay = motion.dynamics[i]
    turning = [ax, ay, 0.0, vx, vy, 0.0, 0.0, 0.0, motion.yaw_rates[i], 0.0, 0.0]
    return np.concatenate([motion.global_from_ego[i, :3, 3], motion.quaternions[i], turning])


def _lights(row: Mapping[str, Any], i: int) -> list[tuple[int, bool]]:
    states = np.asarray(row["light_states"])  # (S, 56)
    ids = [connector_number(str(lane_id)) for lane_id in row["light_lane_ids"]]
    return [(number, bool(state[INSTANTS[i]] == RED)) for number, state in zip(ids, states)]


def _annotations(row: Mapping[str, Any], names: SampleNames, motion: FrameMotion, i: int) -> dict[str, Any]:
    """Boxes and velocities in the frame of the ego at this instant, turned by its heading alone, as they are read."""
    step, ego = INSTANTS[i], motion.local[i]
    shape = (len(row["agent_ids"]), AGENT_STEPS)
    here = np.flatnonzero(np.asarray(row["agent_valid"]).reshape(shape)[:, step])
    stored = np.asarray(row["agent_boxes"], np.float64).reshape(*shape, 5)[here, step]
    pose, c, s = to_local(ego, stored[:, :3]), np.cos(ego[2]), np.sin(ego[2])
    boxes, velocities = np.zeros((len(here), 7)), np.zeros((len(here), 3))
    boxes[:, :2], boxes[:, 3:5], boxes[:, 6] = pose[:, :2], stored[:, 3:], pose[:, 2]
    center_z = np.asarray(row["agent_center_z"], np.float64).reshape(shape)[here, step]
    boxes[:, 2] = center_z - motion.global_from_ego[i, 2, 3]
    boxes[:, 5] = np.asarray(row["agent_heights"])[here]
    of_now = np.asarray(row["agent_velocities"], np.float64).reshape(*shape, 2)[here, step]
    velocities[:, :2] = of_now @ np.array([[c, -s], [s, c]])
    tracks = [str(row["agent_ids"][k]) for k in here]
    return {
        "gt_boxes": boxes,
        "gt_names": np.array([str(row["agent_kinds"][k]).lower() for k in here], dtype=np.str_),
        "gt_velocity_3d": velocities,
        "instance_tokens": [hex16(names.tokens[i], track) for track in tracks],
        "track_tokens": tracks,
    }
