"""A sample as the frames of an OpenScene log, dictionaries as NAVSIM's loader reads them, and its pictures."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from factory.store.reader import decode_stored_image
from factory.store.schema import AGENT_STEPS, NOW_INDEX
from tasks.render.views import pinhole
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, Camera
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, VX, VY, YAW_RATE, pose_on_ground, to_local, to_world

# What an export is asked for.

Missing = Literal["refuse", "black", "none"]
ConsumerName = Literal["simscale", "drivor"]

MAP_LOCATIONS = ("sg-one-north", "us-ma-boston", "us-nv-las-vegas-strip", "us-pa-pittsburgh-hazelwood")
PUBLIC_SIZE = (1920, 1080)  # pixels; the released agents cut their pictures as if they were this large


class CannotExport(ValueError):
    """A sample, or all of them, cannot be written as asked; the message says which, why and what would help."""


@dataclass(frozen=True)
class ExportSettings:
    """What is written of which samples; two exports into one folder have the same."""

    experts: tuple[str, ...] = ()  # of whom; none: all
    rounds: tuple[int, ...] = ()  # which; none: all
    splits: tuple[str, ...] = ()  # train, val, test; none: all
    tag: str = ""  # behind an expert's name, so that a split of ours stands beside the released one
    resize: bool = False  # pictures of other sizes, to PUBLIC_SIZE
    missing: Missing = "refuse"  # pictures of eight cameras and four instants that a sample has not
    map_location: str = ""  # of all samples; empty: what their maps say
    consumer: ConsumerName = "simscale"  # whose training reads it

    def __post_init__(self) -> None:
        if self.consumer == "drivor" and (self.tag or set(self.experts) - {DRIVOR_EXPERT}):
            raise ValueError(f"for=drivor: it reads reaction_pdm alone: without tag=, and expert={DRIVOR_EXPERT}")
        if self.tag and not (self.tag.isascii() and self.tag.replace("_", "").isalnum()):
            raise ValueError(f"tag={self.tag}: letters, digits and _ alone, as it becomes part of names")
        if self.map_location and self.map_location not in MAP_LOCATIONS:
            raise ValueError(
                f"map_location={self.map_location}: the public code knows {', '.join(MAP_LOCATIONS)} "
                "(navsim/common/dataclasses.py:441)"
            )


# What reads an export. Of DrivoR: valeoai/TOAD @ 0110647, the code of valeoai/DrivoR.

DRIVOR_EXPERT, DRIVOR_ROUNDS = "pdm_closed", range(5)  # navsim/agents/drivoR/drivor_agent.py:104-108


@dataclass(frozen=True)
class Consumer:
    """What a public training opens of a log."""

    n_future: int  # frames
    cameras: tuple[str, ...]
    instants: tuple[int, ...]  # frames, of these cameras
    blackened: tuple[str, ...]  # cameras that a rig need not have: a black picture stands for theirs
    opens: str  # the same in words

    @property
    def n_frames(self) -> int:
        """Of a log."""
        return N_HISTORY + self.n_future


def consumer_of(settings: ExportSettings) -> Consumer:
    """Of an export."""
    if settings.consumer == "simscale":
        return Consumer(N_FUTURE, CAMERAS, tuple(range(N_HISTORY)), (), "eight cameras at four instants")
    cameras = ("CAM_F0", "CAM_L0", "CAM_R0", "CAM_B0")  # config/common/agent/drivoR.yaml
    # Its scorer's time to collision looks 1 s behind the 4 s of a plan.
    return Consumer(10, cameras, (NOW_FRAME,), ("CAM_B0",), f"{', '.join(cameras)} at now")


# How logs, frames, splits and files are named, so that the public code finds them and tells real from simulated.
#
# SimScale's own names (its scene filters): log `<source log>-<A>-00k`, sample `<B>-00k`, with A and B the frames of
# the source log at T and at T+H, and k the round. A human sample of ours is `<source log>-<A>`, its token A.

HORIZON_S = HORIZON_STEPS * STEP_S
FRAME_S = 0.5
N_HISTORY, N_FUTURE = 4, 8  # frames; the history's last is now
N_FRAMES = N_HISTORY + N_FUTURE  # that a row reaches to
NOW_FRAME = N_HISTORY - 1
HEX16 = re.compile(r"[0-9a-f]{16}")
RELEASED = {"pdm_closed": "pdm"}  # our names of experts by which SimScale's splits go
NAMING = ("dataset", "log_id", "clip_start_s", "now_s", "frame_tokens", "candidate_index", "expert", "round")


def hex16(*words: object) -> str:
    """16 hex digits of the words: the first of the SHA-256 of their texts with 0x1f between them."""
    return hashlib.sha256("\x1f".join(map(str, words)).encode()).hexdigest()[:16]


def is_simulated(row: Mapping[str, Any]) -> bool:
    """Whether the sample is of an attempt at a candidate, and not of the log's own drive."""
    return bool(row["candidate_index"] >= 0)


def source_log_name(dataset: str, log_id: str) -> str:
    """The source log's name with exactly one dash, from which WorldEngine cuts it off again.

    A log named so already (nuPlan's `..._veh-35_...`) keeps its name. Of another, what is no letter, digit, dot or _
    becomes _, and a dash and 8 digits of the hash of data set and log follow.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", log_id)
    if plain == log_id and log_id.count("-") == 1:
        return log_id
    return f"{plain.replace('-', '_')}-{hex16(dataset, log_id)[:8]}"


def frame_token(row: Mapping[str, Any], time_s: float) -> str:
    """The name of the source log's frame at `time_s` since its first instant: the log's own at T and T+H, else a hash.

    The hash is of data set, log and milliseconds, so that overlapping windows agree on it.
    """
    start_s = float(row["clip_start_s"]) + float(row["now_s"]) - (HORIZON_S if is_simulated(row) else 0.0)
    given = row["frame_tokens"]
    if given is not None and all(HEX16.fullmatch(token) for token in given):
        for token, at_s in zip(given, (start_s, start_s + HORIZON_S)):
            if abs(time_s - at_s) < STEP_S / 2:
                return str(token)
    return hex16(row["dataset"], row["log_id"], round(1000.0 * time_s))


@dataclass(frozen=True)
class SampleNames:
    """What one sample is called."""

    log: str  # the pickle's stem and every frame's log_name
    scene: str  # scene_token and log_token
    tokens: tuple[str, ...]  # (F,)
    times_s: tuple[float, ...]  # (F,) since the source log's first instant
    suffix: str  # of every token: the round of a simulated sample, empty for a human one

    @property
    def token(self) -> str:
        """Of the sample."""
        return self.tokens[NOW_FRAME]

    @property
    def blobs(self) -> str:
        """The folder of its pictures."""
        return self.scene if self.suffix else self.log


def sample_names(row: Mapping[str, Any], settings: ExportSettings) -> SampleNames:
    """Names of a row with the columns NAMING.

    DrivoR takes a log for one of round k when its name holds -00k anywhere (run_training_full_simscale.py:87-97): what
    reads so before the round becomes -f0k.
    """
    now_s = float(row["clip_start_s"]) + float(row["now_s"])
    times_s = tuple(now_s + (i - NOW_FRAME) * FRAME_S for i in range(consumer_of(settings).n_frames))
    suffix = f"-{int(row['round']):03d}" if is_simulated(row) else ""
    tokens = tuple(frame_token(row, time_s) + suffix for time_s in times_s)
    scene = frame_token(row, now_s - HORIZON_S if suffix else now_s)
    log = f"{source_log_name(row['dataset'], row['log_id'])}-{scene}"
    if settings.consumer == "drivor":
        log = re.sub("-00(?=[0-4])", "-f0", log)
    return SampleNames(log + suffix, scene + suffix, tokens, times_s, suffix)


CONFIG = "devkit/navsim/planning/script/config"  # below NAVSIM_DEVKIT_ROOT, once devkit/ is copied over it
REWARDS = "traj_pdm_v2"  # what NAVSIM_TRAJPDM_ROOT names


@dataclass(frozen=True, order=True)
class SplitNames:
    """What the samples of one expert and round are called, all together; paths are below the export's folder."""

    folder: str  # of logs and of pictures: where SimScale's tools/move.sh puts a download
    yaml: str  # of the scene filter and the split; its cache is <yaml>_cache
    log_split: str  # path of the training's list of logs ("reation" is how the public code spells it)
    rewards: str  # path of the file below NAVSIM_TRAJPDM_ROOT

    def log(self, name: str) -> str:
        """The path of a log's pickle."""
        return f"navsim_logs/{self.folder}/{name}.pkl"

    def picture(self, data_path: str) -> str:
        """The path of a picture, or of the folder of all of them."""
        return f"sensor_blobs/{self.folder}/{data_path}"


def split_names(row: Mapping[str, Any], tag: str = "") -> SplitNames:
    """Of a row with the columns NAMING. The rewards' file is always named 16384, whatever K is (gtrs_agent.py:232)."""
    who = RELEASED.get(row["expert"], row["expert"]) + (f"_{tag}" if tag else "")
    if is_simulated(row):
        name = f"{who}_v1.0-{row['round']}"
        folder, yaml = f"synthetic_reaction_{name}", f"navtrain_reaction_{name}"
        log_split, rewards = f"synthetic_reation_{name}", f"sim/simcale_16384_{name}.pkl"
    else:
        folder = yaml = log_split = f"navtrain_{who}"
        rewards = f"ori/{folder}_16384.pkl"
    return SplitNames(folder, yaml, f"{CONFIG}/training/default_log_split_{log_split}.yaml", f"{REWARDS}/{rewards}")


# The ego at the twelve frames of a log: poses in the plane and in space, velocities, accelerations, yaw rates.

STEPS_PER_FRAME = 5
INSTANTS = np.arange(0, AGENT_STEPS, STEPS_PER_FRAME)  # of a row's 56 steps
DRIVEN = slice(HORIZON_STEPS - NOW_INDEX, HORIZON_STEPS, STEPS_PER_FRAME)  # of perturbed_states, before now
MOTION = (
    *("ego_history_10hz", "label_10hz", "now_pose", "world_from_ego", "perturbed_states", "ego_status"),
    *("parent_states", "images"),
)


@dataclass(frozen=True)
class EgoMotion:
    """The ego at F frames; velocity and acceleration in ego axes, at the rear axle."""

    poses: Array  # (F, 3) x, y [m], heading [rad], world
    local: Array  # (F, 3) the same in the frame of the ego at now
    global_from_ego: Array  # (F, 4, 4) m
    quaternions: Array  # (F, 4) w, x, y, z of its rotation
    dynamics: Array  # (F, 4) vx, vy [m/s], ax, ay [m/s2]
    yaw_rates: Array  # (F,) rad/s


def ego_motion(row: Mapping[str, Any], n_frames: int = N_FRAMES) -> EgoMotion:
    """Of a row with the columns MOTION: what it holds exactly where it does, else from its poses at 10 Hz.

    Frames beyond the row's 4 s go straight on at its last velocity.
    """
    local = np.concatenate([row["ego_history_10hz"], row["label_10hz"]]).astype(np.float64)  # (56, 3)
    dynamics, yaw_rates = (derived[INSTANTS] for derived in derivatives(local))
    poses = to_world(np.asarray(row["now_pose"]), local[INSTANTS])
    poses[NOW_FRAME] = row["now_pose"]
    dynamics[NOW_FRAME] = row["ego_status"]
    driven = row["perturbed_states"]  # null of human rows and of imported ones, whose own log is the drive
    if driven is not None:
        before = np.asarray(driven)[DRIVEN]  # float64, of the very drive
        poses[:NOW_FRAME], dynamics[:NOW_FRAME] = before[:, : HEADING + 1], before[:, [VX, VY, AX, AY]]
        yaw_rates[: NOW_FRAME + 1] = np.append(before[:, YAW_RATE], driven[-1, YAW_RATE])
    else:  # that log at T is now, and at T+H the last frame
        logged = np.asarray(row["parent_states"])[:, [VX, VY, AX, AY]]
        dynamics[[NOW_FRAME, N_FRAMES - 1]] = logged
    after_s = FRAME_S * np.arange(1, n_frames - N_FRAMES + 1)[:, None]
    ahead = np.hstack([dynamics[-1:, :2] * after_s, np.zeros_like(after_s)])
    poses = np.concatenate([poses, to_world(poses[-1], ahead)])
    dynamics = np.concatenate([dynamics, np.tile([*dynamics[-1, :2], 0.0, 0.0], (len(after_s), 1))])
    yaw_rates = np.append(yaw_rates, np.zeros(len(after_s)))
    stored = [] if row["world_from_ego"] is None else [np.asarray(row["world_from_ego"])]  # at now, and of its pictures
    stored += [np.asarray(image["ego_pose"]).reshape(4, 4) for image in row["images"] or ()]
    matrices, quaternions = poses_in_space(poses, np.stack(stored) if stored else np.eye(4)[None])
    return EgoMotion(poses, to_local(poses[NOW_FRAME], poses), matrices, quaternions, dynamics, yaw_rates)


def derivatives(poses: Array) -> tuple[Array, Array]:
    """Of poses (S, 3) at 10 Hz: (S, 4) vx, vy, ax, ay in the axes of each pose, and (S,) yaw rates.

    Velocities are differences over one step to either side, at both ends the slope of the parabola through three
    frames. Accelerations are second differences over a frame to either side, nearer to an end those of the nearest
    step: a log at 2 Hz is straight between its frames, and over single steps its speed would change in one of them.
    """
    xy, heading = poses[:, :2], np.unwrap(poses[:, 2])
    velocity, yaw_rate = np.gradient(xy, STEP_S, axis=0), np.gradient(heading, STEP_S)
    n, frame_s = STEPS_PER_FRAME, STEPS_PER_FRAME * STEP_S
    velocity[0] = (4.0 * xy[n] - 3.0 * xy[0] - xy[2 * n]) / (2.0 * frame_s)
    velocity[-1] = (3.0 * xy[-1] - 4.0 * xy[-1 - n] + xy[-1 - 2 * n]) / (2.0 * frame_s)
    acceleration = np.zeros_like(xy)
    acceleration[n:-n] = (xy[2 * n :] - 2.0 * xy[n:-n] + xy[: -2 * n]) / frame_s**2
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    turned = [np.hstack([c * v[:, :1] + s * v[:, 1:], c * v[:, 1:] - s * v[:, :1]]) for v in (velocity, acceleration)]
    turned[1][:n], turned[1][-n:] = turned[1][n], turned[1][-n - 1]
    return np.hstack(turned), yaw_rate


def poses_in_space(poses: Array, known: Array) -> tuple[Array, Array]:
    """Planar poses (F, 3) as (F, 4, 4) matrices and (F, 4) quaternions w, x, y, z, on the plane of the nearest `known`.

    The heading is what the public code reads as such, pyquaternion's `yaw_pitch_roll[0]`: the rotation is one about x,
    then y, then z, whose last angle it is. On a slope that is not quite the direction of the forward axis in the plane.
    """
    states = np.zeros((len(poses), EGO_STATE_SIZE))
    states[:, : HEADING + 1] = poses
    matrices = pose_on_ground(known, states)
    up = matrices[:, :3, 2]
    pitch, roll = np.arcsin(np.clip(up[:, 0], -1.0, 1.0)), np.arctan2(-up[:, 1], up[:, 2])
    rotation = Rotation.from_euler("XYZ", np.column_stack([roll, pitch, poses[:, HEADING]]))
    matrices[:, :3, :3] = rotation.as_matrix()
    return matrices, rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]


COMMANDS = ("left", "straight", "right", "unknown")  # NAVSIM's one-hot, its "forward" being our "straight"
RED = 3
Frame = dict[str, Any]


def openscene_frames(
    row: Mapping[str, Any], names: SampleNames, cams: tuple[Mapping[str, Any], ...], settings: ExportSettings
) -> list[Frame]:
    """The frames of one sample. Raises CannotExport for a place that the public code does not know."""
    motion, place = ego_motion(row, len(names.tokens)), public_map_location(row, settings)
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
            "sample_next": names.tokens[i + 1] if i + 1 < len(names.tokens) else None,
            "ego2global": motion.global_from_ego[i].copy(),
            "lidar2ego": np.eye(4),
            "lidar2global": motion.global_from_ego[i].copy(),
            "anns": _annotations(row, names, motion, i),
        }
        for i in range(len(names.tokens))
    ]


def public_map_location(row: Mapping[str, Any], settings: ExportSettings) -> str:
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


def _can_bus(motion: EgoMotion, i: int) -> Any:
    """(18,) position, quaternion, acceleration, velocity, angular rate, two zeros; the vectors in ego axes."""
    vx, vy, ax, ay = motion.dynamics[i]
    turning = [ax, ay, 0.0, vx, vy, 0.0, 0.0, 0.0, motion.yaw_rates[i], 0.0, 0.0]
    return np.concatenate([motion.global_from_ego[i, :3, 3], motion.quaternions[i], turning])


def _lights(row: Mapping[str, Any], i: int) -> list[tuple[int, bool]]:
    states = np.asarray(row["light_states"])  # (S, 56)
    ids = [connector_number(str(lane_id)) for lane_id in row["light_lane_ids"]]
    return [(number, bool(state[_step_of(i)[0]] == RED)) for number, state in zip(ids, states)]


def _step_of(frame: int) -> tuple[int, float]:
    """The row's step of a frame, and how many seconds after the row's last the frame lies."""
    return int(INSTANTS[min(frame, N_FRAMES - 1)]), FRAME_S * max(0, frame + 1 - N_FRAMES)


def _annotations(row: Mapping[str, Any], names: SampleNames, motion: EgoMotion, i: int) -> dict[str, Any]:
    """Boxes and velocities in the frame of the ego at this instant, turned by its heading alone, as they are read.

    After the row's 4 s everyone goes straight on at the last velocity.
    """
    (step, after_s), ego = _step_of(i), motion.local[i]
    shape = (len(row["agent_ids"]), AGENT_STEPS)
    here = np.flatnonzero(np.asarray(row["agent_valid"]).reshape(shape)[:, step])
    stored = np.asarray(row["agent_boxes"], np.float64).reshape(*shape, 5)[here, step]
    of_now = np.asarray(row["agent_velocities"], np.float64).reshape(*shape, 2)[here, step]
    stored[:, :2] += after_s * of_now
    pose, c, s = to_local(ego, stored[:, :3]), np.cos(ego[2]), np.sin(ego[2])
    boxes, velocities = np.zeros((len(here), 7)), np.zeros((len(here), 3))
    boxes[:, :2], boxes[:, 3:5], boxes[:, 6] = pose[:, :2], stored[:, 3:], pose[:, 2]
    center_z = np.asarray(row["agent_center_z"], np.float64).reshape(shape)[here, step]
    boxes[:, 2] = center_z - motion.global_from_ego[i, 2, 3]
    boxes[:, 5] = np.asarray(row["agent_heights"])[here]
    velocities[:, :2] = of_now @ np.array([[c, -s], [s, c]])
    tracks = [str(row["agent_ids"][k]) for k in here]
    return {
        "gt_boxes": boxes,
        "gt_names": np.array([str(row["agent_kinds"][k]).lower() for k in here], dtype=np.str_),
        "gt_velocity_3d": velocities,
        "instance_tokens": [hex16(names.tokens[i], track) for track in tracks],
        "track_tokens": tracks,
    }


# A sample's pictures as files of eight cameras, and what the frames say of these cameras.

# Which camera of a rig stands for which of the eight that NAVSIM knows.

# Where nuPlan's cameras look, degrees to the left of the ego's heading.
YAW_DEG = {
    "CAM_F0": 0.0,
    "CAM_L0": 55.0,
    "CAM_L1": 111.0,
    "CAM_L2": 141.0,
    "CAM_R0": -55.0,
    "CAM_R1": -111.0,
    "CAM_R2": -141.0,
    "CAM_B0": 180.0,
}
CAMERAS = tuple(YAW_DEG)
MOST_DEG = 30.0  # off the direction that a camera stands for
NOMINAL_VIEW_DEG = 63.7  # horizontal, of nuPlan's cameras: 1920 px at a focal length of 1545 px


def match_cameras(cameras: Sequence[Camera]) -> Mapping[str, Camera]:
    """NAVSIM's name -> the rig's camera: by name where the rig has these names, else by viewing direction.

    Directions are paired so that their squared differences sum up to the least, and none differs by more than MOST_DEG.
    What is not paired is left out.
    """
    by_name = {camera.name.upper(): camera for camera in cameras}
    if by_name.keys() <= YAW_DEG.keys():
        return {name: by_name[name] for name in CAMERAS if name in by_name}
    looks = np.degrees([np.arctan2(*camera.ego_from_camera[1::-1, 2]) for camera in cameras])
    off = np.abs((looks[:, None] - np.array(list(YAW_DEG.values())) + 180.0) % 360.0 - 180.0)
    cost = np.where(off <= MOST_DEG, off, 1e3) ** 2
    pairs = sorted((int(slot), int(i)) for i, slot in zip(*linear_sum_assignment(cost)) if off[i, slot] <= MOST_DEG)
    return {CAMERAS[slot]: cameras[i] for slot, i in pairs}


JPEG_QUALITY = 95  # of resized pictures; others keep their bytes
NEAR_S = 0.1  # a photo belongs to a frame when it was taken this close to it
BLACK = "black.jpg"  # beside the folders of pictures


@dataclass(frozen=True)
class SamplePictures:
    """A sample's pictures."""

    pictures: tuple[tuple[str, bytes], ...]  # where below the split's folder of pictures, and the JPEG
    cams: tuple[Mapping[str, Mapping[str, Any]], ...]  # (F,) the frames' `cams`
    absent: int  # of those that the consumer opens
    left_out: tuple[str, ...]  # cameras of the rig that stand for none of the eight
    sizes: tuple[str, ...]  # width x height [px], as written
    distorted: bool  # as a lens makes them; else of pinholes


def sample_pictures(row: Mapping[str, Any], names: SampleNames, settings: ExportSettings) -> SamplePictures:
    """The pictures of a row (columns cameras, images) under its names.

    Raises CannotExport where one that the consumer opens is absent and settings.missing is "refuse".
    """
    opened = consumer_of(settings)
    rig = [_camera(camera) for camera in row["cameras"] or ()]
    chosen = match_cameras(rig)
    stored = {name: _by_frame(row["images"] or (), camera.name) for name, camera in chosen.items()}
    absent = [(name, i) for name in opened.cameras for i in opened.instants if i not in stored.get(name, {})]
    black = [lack for lack in absent if settings.missing == "black" or lack[0] in opened.blackened]
    if settings.missing == "refuse" and len(black) < len(absent):
        raise CannotExport(_lacks(row, absent, chosen, opened))
    written = {name: PUBLIC_SIZE if settings.resize else (c.width, c.height) for name, c in chosen.items()}
    cams: list[dict[str, Mapping[str, Any]]] = [{} for _ in names.tokens]
    pictures = []
    for name in CAMERAS:
        camera = chosen.get(name)
        size = written.get(name, PUBLIC_SIZE)
        level = pinhole(name, YAW_DEG[name], NOMINAL_VIEW_DEG, *size)  # for one that the rig has not
        calibration = level if camera is None else camera.resized(*size)
        for i, token in enumerate(names.tokens):
            path = f"{names.blobs}/{name}/{hex16(token.removesuffix(names.suffix), name)}{names.suffix}.jpg"
            image = stored.get(name, {}).get(i)
            if image is not None:
                assert camera is not None
                pictures.append((path, _jpeg(image, camera, size)))
            elif (name, i) in black:
                path = BLACK
            cams[i][name] = _entry(path, calibration)
    left_out = tuple(sorted({camera.name for camera in rig} - {camera.name for camera in chosen.values()}))
    sizes = tuple(sorted({f"{width}x{height}" for width, height in written.values()}))
    distorted = any(camera.distortion.any() for camera in chosen.values())
    return SamplePictures(tuple(pictures), tuple(cams), len(absent), left_out, sizes, distorted)


@cache
def black_picture() -> bytes:
    """What stands for a picture that there is none of, at PUBLIC_SIZE."""
    width, height = PUBLIC_SIZE
    return _encoded(np.zeros((height, width, 3), np.uint8))


def _camera(stored: Mapping[str, Any]) -> Camera:
    return Camera(
        str(stored["name"]),
        int(stored["width"]),
        int(stored["height"]),
        np.asarray(stored["intrinsics"]).reshape(3, 3),
        np.asarray(stored["distortion"]),
        np.asarray(stored["ego_from_camera"]).reshape(4, 4),
    )


def _by_frame(images: Sequence[Mapping[str, Any]], camera: str) -> Mapping[int, Mapping[str, Any]]:
    """Frame -> the camera's picture nearest to it."""
    found: dict[int, tuple[float, Mapping[str, Any]]] = {}
    for image in images:
        frame = round(image["time_s"] / FRAME_S) + NOW_FRAME
        off_s = abs(image["time_s"] - (frame - NOW_FRAME) * FRAME_S)
        if image["camera"] == camera and 0 <= frame < N_FRAMES and off_s <= min(NEAR_S, found.get(frame, (NEAR_S,))[0]):
            found[frame] = (off_s, image)
    return {frame: image for frame, (_, image) in found.items()}


def _jpeg(image: Mapping[str, Any], camera: Camera, size: tuple[int, int]) -> bytes:
    """The stored bytes, or the part of the picture that has the wanted shape, resized."""
    if (camera.width, camera.height) == size:
        return bytes(image["jpeg"])
    left, top, width, height = camera.window(*size)
    pixels = decode_stored_image(image)[top : top + height, left : left + width]
    shrinks = size[0] < width
    return _encoded(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def _encoded(pixels: Any) -> bytes:
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done, "any array of bytes (H, W, 3) is a picture"
    return bytes(data.tobytes())


def _entry(path: str, camera: Camera) -> Mapping[str, Any]:
    return {
        "data_path": path,
        "sensor2lidar_rotation": camera.ego_from_camera[:3, :3].copy(),
        "sensor2lidar_translation": camera.ego_from_camera[:3, 3].copy(),
        "cam_intrinsic": camera.intrinsics.copy(),
        "distortion": camera.distortion.copy(),
    }


def _lacks(
    row: Mapping[str, Any], absent: Sequence[tuple[str, int]], chosen: Mapping[str, Camera], opened: Consumer
) -> str:
    nowhere = [name for name in opened.cameras if name not in chosen]
    of_rig = [name for name in chosen if any(camera == name for camera, _ in absent)]
    what = f"no camera stands for {', '.join(nowhere)}" if nowhere else f"{', '.join(of_rig)} lack earlier instants"
    return (
        f"sample {row['attempt_id']}: {what} (images from source {row['image_source']}). The released agents open "
        f"{opened.opens}: render with eight cameras and render.frames=history or all, or export with "
        "missing=black (a black picture stands for what is not there) or missing=none (logs name files that are not "
        "there)"
    )
