"""A clip: one real recording window, validated; a scene: the world at one of its instants."""

import math
from dataclasses import dataclass

from tasks.world.agents import AgentTracks
from tasks.world.arrays import Array, Bools
from tasks.world.camera import Camera, SensorFile
from tasks.world.lanes import NO_LIGHTS, RoadMap, Route, TrafficLights
from tasks.world.vehicle import EGO_STATE_SIZE

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


def of_other_log(name: str) -> bool:
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
    ego_states: Array  # (96, 11), columns tasks.world.vehicle
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
