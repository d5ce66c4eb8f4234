"""A clip: one real recording window with its agents and cameras; a scene: the world at one of its instants."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from tasks.world.arrays import Array, Bools
from tasks.world.frames import EGO_STATE_SIZE
from tasks.world.repair.records import Repair
from tasks.world.road_map import NO_LIGHTS, RoadMap, Route, TrafficLights

# Everything that is tracked around the ego, over time.


class AgentKind(StrEnum):
    """Classes the reward tells apart (nuPlan's tracked object types)."""

    VEHICLE = "VEHICLE"
    PEDESTRIAN = "PEDESTRIAN"
    BICYCLE = "BICYCLE"  # motorcycles too, as in nuPlan
    TRAFFIC_CONE = "TRAFFIC_CONE"
    BARRIER = "BARRIER"
    CZONE_SIGN = "CZONE_SIGN"
    GENERIC_OBJECT = "GENERIC_OBJECT"


MOVING_KINDS = frozenset({AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE})  # "Agent" in docs/reward.md 2b


PER_STEP = ("boxes", "velocities", "valid", "center_z")  # fields of AgentTracks


@dataclass(frozen=True, eq=False)
class AgentTracks:
    """N tracks over S steps of 0.1 s, world frame. Absent entries hold NaN and valid = False."""

    track_ids: tuple[str, ...]  # (N,) unique
    kinds: tuple[AgentKind, ...]  # (N,)
    boxes: Array  # (S, N, 5) centre x [m], centre y [m], heading [rad], length [m], width [m]
    velocities: Array  # (S, N, 2) world frame [m/s]
    valid: Bools  # (S, N)
    center_z: Array  # (S, N) height of the box centre, world frame [m]
    heights: Array  # (N,) box height [m]

    @property
    def n_steps(self) -> int:
        return self.valid.shape[0]

    def __len__(self) -> int:
        return len(self.track_ids)

    def window(self, start: int, stop: int) -> "AgentTracks":
        """The same tracks over steps start..stop-1 (views, not copies)."""
        return replace(self, **{name: getattr(self, name)[start:stop] for name in PER_STEP})

    def overwritten(self, start: int, part: "AgentTracks") -> "AgentTracks":
        """A copy whose steps start..start+part.n_steps-1 come from `part` (same tracks, same order)."""
        if part.track_ids != self.track_ids:
            raise ValueError("overwritten() needs the same tracks in the same order")
        stop = start + part.n_steps
        out = {}
        for name in PER_STEP:
            whole = getattr(self, name).copy()
            whole[start:stop] = getattr(part, name)
            out[name] = whole
        return replace(self, **out)


# Cameras and where a clip's sensor files are.

ROTATION_SLACK = 1e-3  # of calibrations written with few digits
MAX_READOUT_S = 0.2  # slower is no camera of a car: seconds were meant to be milliseconds


@dataclass(frozen=True)
class Fisheye:
    """A lens by the angle theta to its axis, as OpenCV's `fisheye` has it (Kannala and Brandt 2006).

    What is seen at theta lies theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal lengths from the
    centre. Photos become those of a pinhole with the same `intrinsics` as they are opened.
    """

    intrinsics: Array  # (3, 3) pixels
    terms: Array  # (4,) k1, k2, k3, k4


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with lens distortion, mounted on the ego. Camera frame: x right, y down, z forward.

    Distortion is OpenCV's and nuPlan's: radial k1, k2, k3 and tangential p1, p2 (`tasks.render.views.undistorted`).
    Raises ValueError that names camera and field for what is no calibration.
    """

    name: str
    width: int  # pixels
    height: int
    intrinsics: Array  # (3, 3) pixels
    distortion: Array  # (5,) k1, k2, p1, p2, k3; zeros for an undistorted image
    ego_from_camera: Array  # (4, 4) rigid
    fisheye: Fisheye | None = None  # the lens its photos were taken with, which all else knows nothing of
    readout_s: float = 0.0  # from the first row's exposure to the last one's; below 0: from below; 0: all rows at once

    def __post_init__(self) -> None:
        for name, shape in (("intrinsics", (3, 3)), ("distortion", (5,)), ("ego_from_camera", (4, 4))):
            array = getattr(self, name)
            if np.shape(array) != shape:
                raise ValueError(f"camera {self.name}: {name}: shape {np.shape(array)}, expected {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"camera {self.name}: {name}: NaN or infinity")
        if not abs(self.readout_s) <= MAX_READOUT_S:
            raise ValueError(f"camera {self.name}: readout_s: {self.readout_s}, expected {MAX_READOUT_S:g} s at most")
        if self.readout_s and self.fisheye is not None:
            raise ValueError(f"camera {self.name}: readout_s: not for a fisheye, whose rows a pinhole has not")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera {self.name}: size: {self.width}x{self.height} pixels")
        if min(self.intrinsics[0, 0], self.intrinsics[1, 1]) <= 0.0:
            raise ValueError(f"camera {self.name}: intrinsics: focal lengths must be positive")
        turned = self.ego_from_camera[:3, :3]
        if np.abs(turned @ turned.T - np.eye(3)).max() > ROTATION_SLACK or np.linalg.det(turned) < 0.0:
            raise ValueError(f"camera {self.name}: ego_from_camera: not a rotation and a shift")

    def window(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, width, height [px] of the largest centred part of the image with the shape width : height."""
        scale = min(self.width / width, self.height / height)
        w, h = min(round(width * scale), self.width), min(round(height * scale), self.height)
        return (self.width - w) // 2, (self.height - h) // 2, w, h

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of a width x height image: `window`, scaled. A portrait camera's view is cut, not squashed."""
        left, top, w, h = self.window(width, height)
        cut = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
        scale = np.diag([width / w, height / h, 1.0])
        return Camera(self.name, width, height, scale @ cut @ self.intrinsics, self.distortion, self.ego_from_camera)


AS_STRAIGHT = math.radians(2.0)  # of cameras that look ahead equally well the first by name is the front one


def front_camera(names: Sequence[str], axes: Array) -> str | None:
    """The camera whose optical axis is nearest to ahead; None where none looks ahead. axes: (C, 2) x, y, ego frame."""
    off = np.abs(np.arctan2(axes[:, 1], axes[:, 0])).tolist()
    ahead = [(name, angle) for name, angle in zip(names, off) if angle < math.pi / 2]
    best = min((angle for _, angle in ahead), default=0.0)
    return min((name for name, angle in ahead if angle <= best + AS_STRAIGHT), default=None)


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion somewhere in the world. Raises ValueError for arrays that are no camera."""

    intrinsics: Array  # (3, 3) pixels, without skew, the centre of pixel (0, 0) at (0.5, 0.5)
    world_from_camera: Array  # (4, 4) rigid; camera x right, y down, z forward
    width: int  # pixels
    height: int

    def __post_init__(self) -> None:
        shapes = (self.intrinsics.shape, self.world_from_camera.shape)
        if shapes != ((3, 3), (4, 4)):
            raise ValueError(f"Pinhole: intrinsics, pose are {shapes[0]}, {shapes[1]}, expected (3, 3) and (4, 4)")
        if not (np.isfinite(self.intrinsics).all() and np.isfinite(self.world_from_camera).all()):
            raise ValueError("Pinhole: intrinsics or pose hold NaN or infinity")
        if min(self.intrinsics[0, 0], self.intrinsics[1, 1], self.width, self.height) <= 0:
            raise ValueError("Pinhole: focal lengths, width and height must be positive")


@dataclass(frozen=True)
class SensorFile:
    """One image or lidar sweep of the clip; opened by the factory, never by a task."""

    sensor: str  # camera name or lidar name
    uri: str  # path, of a frame of a video or a row of a table with #frame=<k>
    time_s: float  # relative to the clip's start (its first step)
    world_from_ego: Array  # (4, 4) at this time
    ego_from_sensor: Array | None = None  # (4, 4) of a sweep whose points are in its sensor's frame; None: in the ego's


STEP_S = 0.1  # every state array runs at 10 Hz
HISTORY_STEPS = 15  # 1.5 s before T
HORIZON_STEPS = 40  # H = 4 s
NOW = HISTORY_STEPS  # index of T in a clip's arrays
CLIP_STEPS = HISTORY_STEPS + 1 + 2 * HORIZON_STEPS  # 96
OTHER_LOG = "/"  # in the name of a track, camera or lidar of a block that is another log's: <log id>/<its own name>
DRIVES_APART_S = 10.0  # between two drives through one place, on the clock of a block


@dataclass(frozen=True)
class Block:
    """The stretch of a log that is reconstructed as one scene; several clips lie in it and share it."""

    start_s: float  # since the log's first annotated instant; times of the files below count from here
    agents: AgentTracks  # 10 Hz from `start_s` on
    images: tuple[SensorFile, ...]
    sweeps: tuple[SensorFile, ...]
    ground_m: float | None = None  # z of the road under the ego in the ego's frame; None: not known
    own_s: float = math.inf  # what comes later are other logs' drives through the place, one after the other
    other_cameras: tuple[Camera, ...] = ()  # of those drives


@dataclass(frozen=True)
class PhotoDrive:
    """A drive of which nothing is known but what its sensors saw: one block, without a map and an ego at 10 Hz."""

    dataset: str
    log_id: str
    content_digest: str  # of what says where its files are
    cameras: tuple[Camera, ...]
    block: Block


def is_of_other_log(name: str) -> bool:
    """Whether a track, camera or lidar of a block is of another log than the block."""
    return OTHER_LOG in name


def own_name(name: str) -> str:
    """What a log itself calls a track, camera or lidar of a block."""
    return name.rpartition(OTHER_LOG)[2]


@dataclass(frozen=True)
class Clip:
    """History 1.5 s before T, then 2H, at 10 Hz; all poses in the map's metric world frame."""

    clip_id: str
    dataset: str
    log_id: str
    split: str  # train | val | test
    start_s: float  # of the first step, since the log's first annotated instant
    ego_states: Array  # (96, 11), columns tasks.world.frames
    world_from_ego: Array  # (96, 4, 4) rear-axle pose in 3-D (z, roll and pitch for rendering)
    agents: AgentTracks  # 96 steps
    road_map: RoadMap
    route: Route
    centerline: Array  # (P, 3) from the lane of the pose at T along the route
    lights: TrafficLights = NO_LIGHTS  # 96 steps
    cameras: tuple[Camera, ...] = ()
    images: tuple[SensorFile, ...] = ()  # 2 Hz or denser, within the clip
    sweeps: tuple[SensorFile, ...] = ()  # lidar, within the clip
    block: Block | None = None  # what the clip is rendered from; None: it has no photos
    licence: str = ""
    frame_tokens: tuple[str, str] | None = None  # the log's own names of its frames at T and T+H
    content_digest: str = ""  # of everything the clip was read from, but pixels and points
    repairs: tuple[Repair, ...] = ()  # in what it was read from, as far as it shows in the clip


@dataclass(frozen=True)
class Scene:
    """The world at step `step` of a clip, as the ego at `ego_history[-1]` finds it.

    `agents` spans the clip's 96 steps: up to and including `step` what happened (log or simulation), after it the log.
    """

    clip: Clip
    step: int
    ego_history: Array  # (16, 11) the last 1.5 s and now
    agents: AgentTracks
    centerline: Array  # (P, 3) the route ahead of this ego
    ever_simulated: Bools | None = None  # (N,) agents that a rollout already moved off their log

    @property
    def ego_state(self) -> Array:
        """(11,) the ego now."""
        return self.ego_history[-1]

    @property
    def log_ahead(self) -> Array:
        """(41, 11) the logged ego from now to 4 s later. Raises ValueError where the clip ends before."""
        ahead = self.clip.ego_states[self.step : self.step + HORIZON_STEPS + 1]
        if len(ahead) <= HORIZON_STEPS:
            missing = f"{len(ahead) - 1} steps after step {self.step}; {HORIZON_STEPS} are needed"
            raise ValueError(f"the clip ends {missing}")
        return ahead


@dataclass(frozen=True)
class Rollout:
    """Ego and agents simulated together for H from step `start_step`."""

    start_step: int
    ego_states: Array  # (41, 11), row 0 = the scene's ego state
    agents: AgentTracks  # 41 steps, row 0 = the scene's agents
    simulated: Bools  # (N,) True: moved by IDM at some step, False: replayed or standing

    def __post_init__(self) -> None:
        assert self.ego_states.shape == (HORIZON_STEPS + 1, EGO_STATE_SIZE)
        assert self.agents.n_steps == HORIZON_STEPS + 1


def scene_of_clip(clip: Clip) -> Scene:
    """The logged scene at T."""
    return Scene(
        clip=clip,
        step=NOW,
        ego_history=clip.ego_states[NOW - HISTORY_STEPS : NOW + 1],
        agents=clip.agents,
        centerline=clip.centerline,
    )


# Random streams: a function of the run's seed and of what is drawn for, never of settings, code, round or order.


def random_stream(seed: int, clip_id: str, stage: str, candidate: int = -1) -> np.random.Generator:
    """The Philox stream of one stage of one clip (and candidate); equal arguments give equal numbers anywhere."""
    key = "\x1f".join((str(seed), clip_id, stage, str(candidate)))
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest[:16], dtype=np.uint64)))
