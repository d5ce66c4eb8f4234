"""A run's traffic behind AlpaSim's `traffic.TrafficService`: the joint rollout of tasks.rollout around its ego.

A session is of one scene, by `map_id`, and of its own tracks. Up to the handover they are where their log has them,
then where the rollout leads around the ego's poses as far as they are known. A rollout looks only back, so that asking
step by step gives what one rollout around the whole drive gives. Poses are box centres on this wire, and the rear
axle's in a rollout: they lie a Pacifica's 1.461 m apart (tasks.world.frames), whatever the ego's box is.
"""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from factory import __version__
from factory.alpasim.scenes import Scenes, ServedScene
from factory.alpasim.wire import (
    Fault,
    Service,
    Sessions,
    bounded,
    contract,
    heading_of,
    pose_of,
    stamp_of,
    vector_of,
    write_pose,
)
from tasks.render.scene.movers import boxes_at, world_from_boxes
from tasks.rollout.simulate import TrafficScene, prepare_traffic, roll_out_longer
from tasks.settings import TrafficSettings
from tasks.world.arrays import Array
from tasks.world.clip import CLIP_STEPS, HISTORY_STEPS, HORIZON_STEPS, NOW, PER_STEP, STEP_S, AgentTracks, Clip, Scene
from tasks.world.frames import EGO_STATE_SIZE, HEADING, PACIFICA, VX, VY

SERVICE = "traffic.TrafficService"
EGO = "EGO"  # its object_id
STEP_US = round(1e6 * STEP_S)
END_US = (CLIP_STEPS - 1) * STEP_US  # of a scene's log, and of its traffic
APART_M = 2.0  # from a track's log, which AlpaSim smooths: a pose further off is of another scene
# Messages of NVlabs/alpasim 9177bd0, src/grpc/alpasim_grpc/v0/traffic.proto (Apache-2.0): field, number, type.
MESSAGES: Mapping[str, tuple[tuple[str, int, str], ...]] = {
    "ObjectTrajectory": (
        ("aabb", 1, ".common.AABB"),
        ("trajectory", 2, ".common.Trajectory"),
        ("object_id", 3, "string"),
        ("is_static", 4, "bool"),
    ),
    "ObjectTrajectoryUpdate": (("object_id", 1, "string"), ("trajectory", 2, ".common.Trajectory")),
    "TrafficSessionRequest": (
        ("session_uuid", 1, "string"),
        ("map_id", 2, "string"),
        ("random_seed", 3, "fixed64"),
        ("logged_object_trajectories", 4, "repeated .traffic.ObjectTrajectory"),
        ("handover_time_us", 5, "optional fixed64"),
    ),
    "TrafficSessionCloseRequest": (("session_uuid", 1, "string"),),
    "TrafficRequest": (
        ("session_uuid", 1, "string"),
        ("time_query_us", 2, "fixed64"),
        ("object_trajectory_updates", 3, "repeated .traffic.ObjectTrajectoryUpdate"),
    ),
    "TrafficReturn": (("object_trajectory_updates", 1, "repeated .traffic.ObjectTrajectoryUpdate"),),
    "TrafficModuleMetadata": (
        ("version_id", 1, ".common.VersionId"),
        ("minimum_history_length_us", 2, "fixed64"),
        ("supported_map_ids", 3, "repeated string"),
    ),
}


def traffic_messages(common_pb2: Any) -> SimpleNamespace:
    """The classes of MESSAGES and of common.proto, in a pool of their own beside the vendored ones."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool, proto = descriptor_pool.DescriptorPool(), descriptor_pb2.FieldDescriptorProto
    pool.AddSerializedFile(common_pb2.DESCRIPTOR.serialized_pb)
    file = descriptor_pb2.FileDescriptorProto(name="traffic.proto", package="traffic", syntax="proto3")
    file.dependency.append(common_pb2.DESCRIPTOR.name)
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field_name, number, kind in fields:
            one = message.field.add(name=field_name, number=number, label=proto.LABEL_OPTIONAL)
            *how, kind = kind.split()
            if how == ["repeated"]:
                one.label = proto.LABEL_REPEATED
            elif how == ["optional"]:  # its presence is a oneof of its own
                one.proto3_optional, one.oneof_index = True, len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field_name}")
            if kind.startswith("."):
                one.type, one.type_name = proto.TYPE_MESSAGE, kind
            else:
                one.type = getattr(proto, f"TYPE_{kind.upper()}")
    pool.Add(file)
    found = {name: pool.FindMessageTypeByName(f"traffic.{name}") for name in MESSAGES}
    found |= {name: pool.FindMessageTypeByName(f"common.{name}") for name in ("Empty", "SessionRequestStatus")}
    return SimpleNamespace(**{name: message_factory.GetMessageClass(kind) for name, kind in found.items()})


@dataclass
class _Session:
    """What one rollout is about, and where its ego is known to have been: x, y, heading of the rear axle, by stamp."""

    scene: ServedScene
    traffic: TrafficScene
    order: tuple[str, ...]  # of the tracks
    logged: dict[int, Array]
    driven: dict[int, Array] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def ego(self) -> dict[int, Array]:
        """The log until the first pose that was driven."""
        first = min(self.driven, default=END_US + 1)
        return {stamp: pose for stamp, pose in self.logged.items() if stamp < first} | self.driven


class Traffic:
    """The service."""

    def __init__(self, scenes: Scenes, settings: TrafficSettings) -> None:
        """Raises ConfigError without the messages' package."""
        proto = contract("scene serve", "run,alpasim")
        self._scenes, self._settings, self._api = scenes, settings, proto.ALPASIM_API_VERSION
        self._proto = messages = traffic_messages(proto.common_pb2)
        self.sessions: Sessions[_Session] = Sessions()
        requests = {
            "get_metadata": (self._get_metadata, messages.Empty),
            "start_session": (self._start_session, messages.TrafficSessionRequest),
            "simulate": (self._simulate, messages.TrafficRequest),
            "close_session": (self._close_session, messages.TrafficSessionCloseRequest),
        }
        self.service = Service(SERVICE, requests)

    def _get_metadata(self, _: Any) -> Any:
        answer = self._proto.TrafficModuleMetadata(minimum_history_length_us=HISTORY_STEPS * STEP_US)
        answer.version_id.version_id = f"driving-data-factory {__version__} {self._settings.mode}"
        for name in ("major", "minor", "patch"):
            setattr(answer.version_id.grpc_api_version, name, getattr(self._api, name))
        answer.supported_map_ids.extend(self._scenes.ids)
        return answer

    def _start_session(self, message: Any) -> Any:
        scene = self._scenes.find("map_id", message.map_id)
        if scene.clip is None:
            raise Fault("FAILED_PRECONDITION", f"start_session: map_id={message.map_id}: a scene of photos has no map")
        objects = bounded("logged_object_trajectories", message.logged_object_trajectories)
        order, logged = _checked_log(objects, scene)
        handover = stamp_of("handover_time_us", message.handover_time_us)
        step = max(-(-handover // STEP_US), NOW)
        if step >= CLIP_STEPS:
            raise ValueError(f"handover_time_us={handover}: the log of the scene ends at {END_US}")
        clip = _with_tracks(scene.clip, order)
        history = clip.ego_states[step - HISTORY_STEPS : step + 1]
        traffic = prepare_traffic(Scene(clip, step, history, clip.agents, clip.centerline), self._settings)
        self.sessions.begin(message.session_uuid, _Session(scene, traffic, order, logged))
        return self._proto.SessionRequestStatus()

    def _close_session(self, message: Any) -> Any:
        self.sessions.end(message.session_uuid)
        return self._proto.Empty()

    def _simulate(self, message: Any) -> Any:
        session, at = self.sessions[message.session_uuid], "object_trajectory_updates"
        query = stamp_of("time_query_us", message.time_query_us)
        if query > END_US:
            raise ValueError(f"time_query_us={query}: the log of the scene ends at {END_US}")
        driven: dict[int, Array] = {}
        for i, update in enumerate(bounded(at, message.object_trajectory_updates)):
            if update.object_id != EGO:
                raise ValueError(f"{at}[{i}].object_id={update.object_id[:64]!r}: {EGO} alone is driven elsewhere")
            driven |= _rear_axles(f"{at}[{i}]", update.trajectory, session.scene)
        with session.lock:
            session.driven.update(driven)
            ego = session.ego
        if query > max(ego):
            raise ValueError(f"{at}: poses of {EGO} up to time_query_us={query} are expected, known: to {max(ego)}")
        answer, scene = self._proto.TrafficReturn(), session.scene
        tracks, first = tracks_until(session.traffic, ego, query)
        boxes, valid = boxes_at(scene.lifted(tracks, first), 1e-6 * query - STEP_S * first)
        poses = world_from_boxes(boxes)
        for track_id in session.order:
            if valid[j := tracks.track_ids.index(track_id)]:
                poses[j, :3, 3] -= scene.origin
                told = answer.object_trajectory_updates.add(object_id=track_id)
                write_pose(told.trajectory.poses.add(timestamp_us=query).pose, poses[j])
        return answer


def tracks_until(traffic: TrafficScene, ego: Mapping[int, Array], query_us: int) -> tuple[AgentTracks, int]:
    """The tracks as far as a stamp and maybe on, and the scene's step that their first row is: up to the handover the
    log, then the rollout around an ego at x, y, heading of its rear axle (3,) by stamp."""
    step, clip = traffic.scene.step, traffic.scene.clip
    if query_us <= step * STEP_US:
        return clip.agents, 0
    rows = max(-(-query_us // STEP_US) - step, HORIZON_STEPS) + 1
    return roll_out_longer(traffic, ego_states(ego, step * STEP_US, rows)), step


def ego_states(ego: Mapping[int, Array], first_us: int, rows: int) -> Array:
    """(rows, 11) every 0.1 s from a stamp on of an ego whose poses (3,) are known by stamp: straight between them, and
    after the last straight on; each row's velocity is that of the 0.1 s before it."""
    stamps = np.array(sorted(ego), np.float64)
    known = np.stack([ego[int(stamp)] for stamp in stamps])
    known[:, HEADING] = np.unwrap(known[:, HEADING])
    at = first_us + STEP_US * np.arange(-1, rows)
    poses = np.stack([np.interp(at, stamps, known[:, i]) for i in range(3)], axis=-1)
    if len(stamps) > 1:
        last = (known[-1] - known[-2]) / (stamps[-1] - stamps[-2])
        poses[:, :HEADING] += np.maximum(at - stamps[-1], 0.0)[:, None] * last[:HEADING]
    out = np.zeros((rows, EGO_STATE_SIZE))
    out[:, : HEADING + 1] = poses[1:]
    (dx, dy), cos, sin = np.diff(poses[:, :HEADING], axis=0).T / STEP_S, np.cos(poses[1:, 2]), np.sin(poses[1:, 2])
    out[:, VX], out[:, VY] = cos * dx + sin * dy, cos * dy - sin * dx
    return out


def _checked_log(objects: Sequence[Any], scene: ServedScene) -> tuple[tuple[str, ...], dict[int, Array]]:
    """The scene's tracks in the order of a request, and the ego's poses. Raises ValueError."""
    at, order, ego = "logged_object_trajectories", dict[str, None](), dict[int, Array]()
    columns = {track_id: j for j, track_id in enumerate(scene.agents.track_ids)}
    for i, one in enumerate(objects):
        name = f"{at}[{i}].object_id={one.object_id[:64]!r}"
        if one.object_id in order or (one.object_id == EGO and ego):
            raise ValueError(f"{name}: stands there twice")
        if one.object_id == EGO:
            ego = _rear_axles(f"{at}[{i}]", one.trajectory, scene)
            continue
        if (j := columns.get(one.object_id)) is None:
            raise ValueError(f"{name}: no track of this scene")
        order[one.object_id] = None
        there = np.flatnonzero(scene.agents.valid[:, j])
        for k, pose in enumerate(bounded(f"{at}[{i}].trajectory.poses", one.trajectory.poses)):
            xy = np.array(vector_of(f"{at}[{i}].trajectory.poses[{k}].pose.vec", pose.pose.vec)[:2]) + scene.origin[:2]
            log = [np.interp(pose.timestamp_us, there * STEP_US, scene.agents.boxes[there, j, c]) for c in range(2)]
            if (off := float(np.hypot(*(xy - log)))) > APART_M:
                raise ValueError(f"{name}: poses[{k}] lies {off:.1f} m from the track's log: another scene, or `local`")
    if not ego:
        raise ValueError(f"{at}: no poses of {EGO}")
    return tuple(order), ego


def _rear_axles(name: str, trajectory: Any, scene: ServedScene) -> dict[int, Array]:
    """Stamp -> x, y, heading in the world, of a trajectory of the ego's box centre. Raises ValueError."""
    found = {}
    for k, one in enumerate(bounded(f"{name}.trajectory.poses", trajectory.poses)):
        pose = pose_of(f"{name}.trajectory.poses[{k}].pose", one.pose)
        heading = heading_of(pose)
        ahead = PACIFICA.rear_axle_to_center * np.array([np.cos(heading), np.sin(heading)])
        stamp = stamp_of(f"{name}.trajectory.poses[{k}].timestamp_us", one.timestamp_us)
        found[stamp] = np.array([*(pose[:2, 3] + scene.origin[:2] - ahead), heading])
    return found


def _with_tracks(clip: Clip, track_ids: Sequence[str]) -> Clip:
    """The clip with these of its tracks alone, in its own order."""
    agents = clip.agents
    kept = np.isin(agents.track_ids, track_ids)
    if kept.all():
        return clip
    rows = np.flatnonzero(kept).tolist()
    columns = {name: getattr(agents, name)[:, rows] for name in PER_STEP}
    ids, kinds = tuple(agents.track_ids[j] for j in rows), tuple(agents.kinds[j] for j in rows)
    return replace(clip, agents=AgentTracks(ids, kinds, heights=agents.heights[rows], **columns))
