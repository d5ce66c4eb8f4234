"""What moves in a log of 123D, at steps of 0.1 s: rear-axle poses, boxes, lights.

The poses are the IMU's, and the file says where the rear axle is from there; boxes are in the world frame. Velocities
stored beside them are not read: for some data sets they are zeros. Modalities come at rates of their own:

* up to 0.15 s apart: the rules of Argoverse 2's logs (factory/datasets/av2/log.py);
* keyframes further apart, 2 Hz as a rule: boxes linear between two that are not much further apart than usual, the ego
  smoothed as ScenarioNet's (factory/datasets/scenarionet/tracks.py).
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from factory.datasets.av2.log import (
    EGO_FIT_HALF_WINDOW_S,
    MIN_POSE_SPACING_S,
    ROUNDING_S,
    SAME_FRAME_S,
    BoxTrack,
    LogMotion,
    agents_at,
    ego_states_at,
    observed_at,
    rotations,
    seconds_since,
    seen_at,
    spaced,
    step_times,
    tracks_of,
    yaw_of,
)
from factory.datasets.py123d.arrow import KINDS_OF_LABELS, ArrowFile, numbers, open_file
from factory.datasets.scenarionet.tracks import FIT_STEPS, MAX_GAP_S, smooth_drive
from factory.readers.base import BadClip
from factory.readers.logs import LoggedDrive
from factory.readers.pickles import id_text
from tasks.world.arrays import Array, Indices
from tasks.world.clip import STEP_S, AgentKind
from tasks.world.frames import EGO_STATE_SIZE
from tasks.world.road_map import LightState, RoadMap, TrafficLights

EGO, BOXES, LIGHTS = "ego_state_se3.arrow", "box_detections_se3.arrow", "traffic_light_detections.arrow"
DENSE_S = 0.15  # what comes at most this far apart are no keyframes
FILLED_SPACINGS = 1.3  # of the usual one: nuScenes' keyframes lie 0.4 to 0.6 s apart
SMOOTHING = 300.0  # as of nuScenes' drives through ScenarioNet
MIN_FIT_POSES, MIN_KEYFRAMES = 4, 3
STATES = (LightState.GREEN, LightState.YELLOW, LightState.RED, LightState.UNKNOWN, LightState.UNKNOWN)  # off, unknown


def read_motion(folder: Path) -> LogMotion:
    """Poses and boxes of the log in `folder`: of the frames that have a pose, from the first to the last with a box.

    Raises BadClip, also where there is none or frames lie too far apart for 10 Hz.
    """
    ego, boxes = open_file(folder / EGO), open_file(folder / BOXES)
    pose_stamps, frame_stamps = ego.stamps_ns(), boxes.stamps_ns()
    for file, stamps in ((ego, pose_stamps), (boxes, frame_stamps)):
        if len(stamps) == 0 or (np.diff(stamps) < 0).any():
            raise BadClip(str(file.path), "timestamp_us", "holds no rows, or time runs backwards")
    row, values = boxes.lists("bounding_box_se3")
    since_first, until_last = frame_stamps - pose_stamps[0], pose_stamps[-1] - frame_stamps
    posed = (since_first >= -MIN_POSE_SPACING_S * 1e9) & (until_last >= -SAME_FRAME_S * 1e9)
    boxed = np.flatnonzero(posed[row])
    if len(boxed) == 0:
        raise BadClip(str(boxes.path), "bounding_box_se3", "no box in any frame that has a pose")
    start_ns = int(frame_stamps[row[boxed[0]]])
    times_s = seconds_since(start_ns, frame_stamps)
    frames = np.unique(times_s[row[boxed[0]] : row[boxed[-1]] + 1])
    keep = spaced(seconds_since(start_ns, pose_stamps))
    world_from_rear, positions = _rear_axle(ego)
    return LogMotion(
        folder=folder,
        start_ns=start_ns,
        frame_times_s=frames,
        pose_times_s=seconds_since(start_ns, pose_stamps[keep]),
        positions=positions[keep],
        rotations=world_from_rear[keep],
        yaws=np.unwrap(yaw_of(world_from_rear[keep])),
        tracks=_tracks(boxes, row, values, boxed, times_s),
        fill_s=_filled_s(boxes, frames),
    )


def drive_of(motion: LogMotion) -> LoggedDrive:
    """Ego and agents every 0.1 s; a segment ends where poses or frames are missing. Raises BadClip."""
    times_s = step_times(0, motion.n_steps)
    states = ego_states_of(motion, times_s)
    here = np.isfinite(states).all(axis=1) & observed_at(motion, times_s)
    begins = here & ~np.concatenate([[False], here[:-1]])
    return LoggedDrive(states, agents_at(motion, times_s), np.where(here, np.cumsum(begins) - 1, -1))


def ego_states_of(motion: LogMotion, times_s: Array) -> Array:
    """Ego states (S, 11) at the log's steps; NaN where poses are missing."""
    states = np.full((len(times_s), EGO_STATE_SIZE), np.nan)
    usual_s = float(np.median(np.diff(motion.pose_times_s))) if len(motion.pose_times_s) > 1 else np.inf
    if usual_s <= DENSE_S:
        reach = EGO_FIT_HALF_WINDOW_S + ROUNDING_S
        first, last = (np.searchsorted(motion.pose_times_s, times_s + offset) for offset in (-reach, reach))
        enough = last - first >= MIN_FIT_POSES
        states[enough] = ego_states_at(motion, times_s[enough])
        return states
    place = [np.interp(times_s, motion.pose_times_s, column) for column in (*motion.positions[:, :2].T, motion.yaws)]
    nearest = np.rint(motion.pose_times_s / STEP_S).astype(np.int64)
    weight = np.isin(np.arange(len(times_s)), nearest).astype(np.float64)
    between = seen_at(motion.pose_times_s, times_s, FILLED_SPACINGS * min(usual_s, MAX_GAP_S))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], between, [False]])))
    for start, stop in pairwise(edges.tolist()):
        run = slice(start, stop)
        if between[start] and stop - start >= FIT_STEPS and weight[run].sum() >= MIN_KEYFRAMES:
            weight[[start, stop - 1]] = 1.0
            states[run] = smooth_drive(np.stack(place[:2], axis=1)[run], place[2][run], weight[run], SMOOTHING)
    return states


def lights_of(motion: LogMotion, road_map: RoadMap, times_s: Array) -> TrafficLights:
    """Phases at times (S,) of the lanes on the map: of the latest frame, where one is at most 0.55 s old.

    Two lights of one lane count as the more restrictive. No lanes where the log has no lights. Raises BadClip.
    """
    path = motion.folder / LIGHTS
    if not path.exists():
        return TrafficLights((), np.zeros((len(times_s), 0), np.int8))
    file = open_file(path)
    changed_at = seconds_since(motion.start_ns, file.stamps_ns())
    if (np.diff(changed_at) < 0.0).any():
        raise BadClip(str(path), "timestamp_us", "time runs backwards")
    (row, lane), (also_row, status) = file.lists("lane_id"), file.lists("status")
    if not np.array_equal(row, also_row) or lane.null_count or status.null_count:
        raise BadClip(str(path), "lane_id status", "not one status a lane")
    if len(status) and int(np.max(status)) >= len(STATES):
        raise BadClip(str(path), "status", f"unknown status {int(np.max(status))}")
    names = np.array([str(number) for number in lane.to_pylist()], dtype=np.str_)
    lane_ids = tuple(sorted(set(names.tolist()) & road_map.lanes.keys()))
    states = np.full((len(changed_at) + 1, len(lane_ids)), LightState.UNKNOWN, np.int8)  # the last: of no frame
    for column, lane_id in enumerate(lane_ids):
        of_lane = np.flatnonzero(names == lane_id)
        phases = np.array(STATES, np.int8)[np.asarray(status, np.int64)[of_lane]]
        np.maximum.at(states[:, column], row[of_lane], phases)
    latest = np.searchsorted(changed_at, times_s + SAME_FRAME_S) - 1
    fresh = (latest >= 0) & (times_s - np.append(changed_at, np.inf)[latest] <= MAX_GAP_S)
    return TrafficLights(lane_ids, states[np.where(fresh, latest, -1)])


def matrices(path: Path, poses: Array) -> Array:
    """(n, 4, 4) of poses (n, 7) x, y, z, qw, qx, qy, qz. Raises BadClip for a quaternion that is no rotation."""
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    if len(poses):
        out[:, :3, :3], out[:, :3, 3] = rotations(path, poses[:, 3:]).as_matrix(), poses[:, :3]
    return out


def _rear_axle(ego: ArrowFile) -> tuple[Rotation, Array]:
    """Rotations and positions (n, 3) of the rear axle from the IMU's. Raises BadClip."""
    poses, mount = ego.rows("imu_se3", 7), ego.vector("rear_axle_to_imu_se3", 7)
    world_from_imu = rotations(ego.path, poses[:, 3:])
    turned = rotations(ego.path, mount[None, 3:])[0]
    return world_from_imu * turned, world_from_imu.apply(mount[:3]) + poses[:, :3]


def _tracks(boxes: ArrowFile, row: Indices, values: pa.Array, boxed: Indices, times_s: Array) -> tuple[BoxTrack, ...]:
    """Tracks of the boxes numbered `boxed`; row: (m,) the frame of each box, times_s: of the frames."""
    path = boxes.path
    (id_row, ids), (kind_row, labels) = boxes.lists("track_token"), boxes.lists("label")
    if not (np.array_equal(row, id_row) and np.array_equal(row, kind_row)) or ids.null_count or labels.null_count:
        raise BadClip(str(path), "track_token label", "not one of each for every box")
    box = numbers(path, "bounding_box_se3", values, 10)[boxed]
    if (box[:, 7:] <= 0.0).any():
        raise BadClip(str(path), "bounding_box_se3", "a box has a size that is not positive")
    named = [id_text(token) for token in ids.to_pylist()]
    if None in named:
        frame = int(row[named.index(None)])
        raise BadClip(str(path), "track_token", f"frame {frame} has a box that no token names: it is empty or no text")
    tokens = np.array(named, dtype=np.str_)[boxed]
    kinds = _kinds(boxes, np.asarray(labels, np.int64)[boxed])
    headings = yaw_of(rotations(path, box[:, 3:7]))
    return tracks_of(path, "track_token", tokens, kinds, times_s[row[boxed]], box[:, :3], headings, box[:, 7:])


def _kinds(boxes: ArrowFile, labels: Indices) -> list[AgentKind]:
    name = str(boxes.value("box_detection_label_class", str)).rpartition(".")[2]
    if name not in KINDS_OF_LABELS:
        known = ", ".join(KINDS_OF_LABELS)
        raise BadClip(str(boxes.path), "metadata.box_detection_label_class", f"unknown labels {name}; known: {known}")
    kinds = KINDS_OF_LABELS[name]
    if labels.max() >= len(kinds):
        raise BadClip(str(boxes.path), "label", f"{labels.max()}: {name} has {len(kinds)}")
    return [kinds[label] for label in labels.tolist()]


def _filled_s(boxes: ArrowFile, frames_s: Array) -> float:
    """The largest gap between two frames that is filled in; 0: none."""
    usual_s = float(np.median(np.diff(frames_s))) if len(frames_s) > 1 else 0.0
    if usual_s > MAX_GAP_S:
        raise BadClip(
            str(boxes.path), "timestamp_us", f"frames {usual_s:.2f} s apart; over {MAX_GAP_S} s is too few for 10 Hz"
        )
    return 0.0 if usual_s <= DENSE_S else FILLED_SPACINGS * usual_s
