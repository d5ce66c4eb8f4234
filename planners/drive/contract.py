"""A drive's planner is asked as AlpaSim's nuPlan track asks a driver, in process or over the wire.

Of the runtime (NVlabs/alpasim 9177bd0, src/runtime/alpasim_runtime: events/, route_generator.py): the first question
comes 17 ms after the first pose, with two poses and one picture of each camera; a question each 0.5 s; pictures, pose
and route are sent at once, and all have to be taken before `drive`. Poses and plans are float32 in a frame whose origin
is the first pose. Both ways the same bytes are handed over.

Who is asked in process is served by planners.alpasim.driver where the messages hold what it needs. Who plans from map,
boxes or samples, which no message holds, is served by `SceneService`, to which the drive shows its scene.
"""

import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

import numpy as np

from factory.alpasim import wire
from factory.config.compose import ConfigError
from planners.alpasim.driver import CONTRACT, SERVICE, add_poses
from planners.alpasim.driver import Driver as AlpasimDriver
from planners.alpasim.session import SECOND_US, STEP_US
from planners.drive.drivers import Driver, MakeSample, PlannerDriver, make_driver
from planners.drive.loop import FIRST_QUESTION_S, first_pose
from planners.evaluation.planner_names import EvaluatedPlanner, needs_of
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.commands import SENT_M, route_points
from tasks.world.frames import AX, AY, HEADING, VX, VY, YAW_RATE, to_local

FIRST_US = round(FIRST_QUESTION_S * SECOND_US)
EVERY_US = SECOND_US // 2
WIRE = "alpasim://"  # begins the spec of who is asked over the wire
PATIENCE_S = 600.0  # for an answer; AlpaSim's own is without end
STARTUP_S = 240.0  # AlpaSim's startup_timeout_s

Ask = Callable[[str, bytes], bytes]  # an RPC by its name: bytes of a request in, bytes of the answer out


def messages() -> Any:
    """The messages' classes. Raises ConfigError without their package."""
    return wire.contract("AlpaSim", "planners")


class SceneService:
    """The driver's service before who plans from the scene itself: the drive shows it before it asks."""

    def __init__(self, driver: Driver) -> None:
        """Raises ConfigError without the messages' package."""
        self._driver, self._shown = driver, dict[str, tuple[Scene, MakeSample, Array]]()
        self._proto = protocol = messages()
        requests = {
            "get_version": (lambda _: protocol.VersionId(), protocol.Empty),
            "start_session": (lambda _: protocol.SessionRequestStatus(), protocol.DriveSessionRequest),
            "close_session": (self._close_session, protocol.DriveSessionCloseRequest),
            "submit_image_observation": (lambda _: protocol.Empty(), protocol.RolloutCameraImage),
            "submit_egomotion_observation": (lambda _: protocol.Empty(), protocol.RolloutEgoTrajectory),
            "submit_route": (lambda _: protocol.Empty(), protocol.RouteRequest),
            "drive": (self._drive, protocol.DriveRequest),
        }
        self.service = wire.Service(SERVICE, requests)

    def show(self, session: str, scene: Scene, look: MakeSample, origin: Array) -> None:
        """What the next question of a session is about; origin: (2,) of its frame in the world [m]."""
        self._shown[session] = scene, look, origin

    def _close_session(self, asked: Any) -> Any:
        self._shown.pop(asked.session_uuid, None)
        return self._proto.Empty()

    def _drive(self, asked: Any) -> Any:
        scene, look, origin = self._shown[asked.session_uuid]
        plan = self._driver.plan(scene, look)
        if plan is None:
            return self._proto.DriveResponse(terminate_session=True)
        poses = np.concatenate([scene.ego_state[None, : HEADING + 1], plan]) - [*origin, 0.0]
        answer = self._proto.DriveResponse()
        add_poses(answer.trajectory, {asked.time_now_us + STEP_US * i: pose for i, pose in enumerate(poses)})
        return answer


@dataclass(frozen=True)
class Peer:
    """Who answers the questions of drives."""

    ask: Ask
    needs_pictures: bool
    service: SceneService | None = None  # that is to be shown the scene


def peer_in_process(one: EvaluatedPlanner, changed: Mapping[str, Any], device: str = "cpu") -> Peer:
    """A planner in this process. changed: settings of a trained one. Raises ConfigError."""
    driver = make_driver(one, device)
    needs = getattr(driver.made, "needs_to_plan", needs_of(driver.made)) if isinstance(driver, PlannerDriver) else None
    if needs is not None and needs.bev is None and not needs.n_agents:
        return Peer(AlpasimDriver(one.spec, device, changed=changed).service.answer, driver.needs_pictures)
    service = SceneService(driver)
    return Peer(service.service.answer, driver.needs_pictures, service)


def ask_over_the_wire(address: str, who: str = "driver", service: str = SERVICE) -> Ask:
    """Questions to a driver at host:port, or to another service that `who` names."""
    messages()
    import grpc

    limits = [(f"grpc.max_{way}_message_length", -1) for way in ("send", "receive")]
    channel = grpc.insecure_channel(address, options=limits)

    def ask(method: str, request: bytes) -> bytes:
        call = channel.unary_unary(f"/{service}/{method}")
        patience_s = STARTUP_S if method == "get_version" else PATIENCE_S
        try:
            return bytes(call(request, timeout=patience_s, metadata=CONTRACT, wait_for_ready=method == "get_version"))
        except grpc.RpcError as error:
            raise ValueError(f"{who}={address}: {method}: {error.code().name} {error.details()}") from error

    return ask


def planner_over_the_wire(address: str) -> EvaluatedPlanner:
    """A driver at host:port, as it names itself. Raises ConfigError where nobody answers."""
    name, digest = version_of(ask_over_the_wire(address))
    return EvaluatedPlanner(name or address, digest, spec=f"{WIRE}{address}")


def version_of(ask: Ask) -> tuple[str, str]:
    """How a service names itself, and 16 hex digits of all that it says of its version. Raises ConfigError where nobody
    answers."""
    try:
        version = messages().VersionId.FromString(ask("get_version", b""))
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return version.version_id, sha256(f"{version.version_id} {version.git_hash}".encode()).hexdigest()[:16]


@dataclass
class DriverSession:
    """One drive's questions, a planners.drive.drivers.Driver: open it with `with`."""

    peer: Peer
    start: Scene
    rig: Sequence[Mapping[str, Any]] | None  # the column `cameras`
    session: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __post_init__(self) -> None:
        self._first_pose = first_pose(self.start.ego_history)
        self._origin = self._first_pose[:2]

    @property
    def needs_pictures(self) -> bool:
        """As the planner's."""
        return self.peer.needs_pictures

    def __enter__(self) -> "DriverSession":
        request = messages().DriveSessionRequest(session_uuid=self.session)
        request.debug_info.scene_id = self.start.clip.clip_id
        for camera in self.rig or ():
            declare(request.rollout_spec.vehicle.available_cameras.add(), camera)
        self._ask("start_session", request)
        return self

    def __exit__(self, *_: object) -> None:
        self._ask("close_session", messages().DriveSessionCloseRequest(session_uuid=self.session))

    def plan(self, scene: Scene, look: MakeSample) -> Array | None:
        """(40, 3) world poses; None where the driver ends the session. Raises ValueError for what is no plan."""
        now_us = FIRST_US + STEP_US * (scene.step - self.start.step)
        sent = [self._egomotion(scene, now_us), self._route(scene, now_us)]
        sent += self._pictures(look, now_us) if self.rig else []
        with ThreadPoolExecutor(len(sent)) as pool:
            list(pool.map(lambda one: self._ask(*one), sent))
        if self.peer.service is not None:
            self.peer.service.show(self.session, scene, look, self._origin)
        protocol = messages()
        asked = protocol.DriveRequest(session_uuid=self.session, time_now_us=now_us, time_query_us=now_us + EVERY_US)
        answer = protocol.DriveResponse.FromString(self._ask("drive", asked))
        if answer.terminate_session:
            return None
        return plan_of(answer.trajectory, now_us) + np.append(self._origin, 0.0)

    def _ask(self, method: str, message: Any) -> bytes:
        try:
            return self.peer.ask(method, message.SerializeToString())
        except wire.Fault as fault:
            raise ValueError(f"{method}: {fault.status} {fault}") from fault

    def _egomotion(self, scene: Scene, now_us: int) -> tuple[str, Any]:
        message = messages().RolloutEgoTrajectory(session_uuid=self.session)
        poses = {now_us: scene.ego_state[: HEADING + 1]}
        if now_us == FIRST_US:
            poses = {0: self._first_pose} | poses
        add_poses(message.trajectory, {stamp: pose - [*self._origin, 0.0] for stamp, pose in poses.items()})
        for _ in poses:
            state = message.dynamic_states.add()
            state.linear_velocity.x, state.linear_velocity.y = scene.ego_state[[VX, VY]]
            state.linear_acceleration.x, state.linear_acceleration.y = scene.ego_state[[AX, AY]]
            state.angular_velocity.z = scene.ego_state[YAW_RATE]
        return "submit_egomotion_observation", message

    def _route(self, scene: Scene, now_us: int) -> tuple[str, Any]:
        """Its points from 40 m on, then NaN up to 20."""
        points = np.full((len(SENT_M), 2), np.nan)
        if len(scene.centerline):
            found = route_points(to_local(scene.ego_state[: HEADING + 1], scene.centerline))
            found = found[np.isfinite(found).all(axis=1)]
            points[: len(found)] = found
        message = messages().RouteRequest(session_uuid=self.session)
        message.route.timestamp_us = now_us
        for x, y in points.tolist():
            message.route.waypoints.add(x=x, y=y, z=0.0 if np.isfinite(x) else np.nan)
        return "submit_route", message

    def _pictures(self, look: MakeSample, now_us: int) -> list[tuple[str, Any]]:
        """One of each camera, of now."""
        sent = []
        for image in look()["images"] or ():
            if image["time_s"] == 0.0:
                message = messages().RolloutCameraImage(session_uuid=self.session)
                shown = message.camera_image
                shown.frame_start_us, shown.frame_end_us = now_us - FIRST_US, now_us
                shown.logical_id, shown.image_bytes = image["camera"], image["jpeg"]
                sent.append(("submit_image_observation", message))
        return sent


def declare(message: Any, camera: Mapping[str, Any]) -> None:
    """An AvailableCamera of an entry of the column `cameras`."""
    mounted = np.reshape(camera["ego_from_camera"], (4, 4))
    pinhole = np.reshape(camera["intrinsics"], (3, 3))
    message.logical_id = message.intrinsics.logical_id = camera["name"]
    message.intrinsics.resolution_w, message.intrinsics.resolution_h = camera["width"], camera["height"]
    lens = message.intrinsics.opencv_pinhole_param
    lens.focal_length_x, lens.focal_length_y = pinhole[0, 0], pinhole[1, 1]
    lens.principal_point_x, lens.principal_point_y = pinhole[:2, 2]
    wire.write_pose(message.rig_to_camera, mounted)


def plan_of(trajectory: Any, now_us: int) -> Array:
    """(40, 3) x, y, heading 0.1 .. 4.0 s from now of an answer; after its last pose it stays there, as for AlpaSim.

    Raises ValueError, as AlpaSim fails, for an answer without poses, or with one before or after now as its first.
    """
    stamps = np.array([pose.timestamp_us for pose in trajectory.poses], np.int64)
    if not len(stamps) or stamps[0] != now_us or (np.diff(stamps) <= 0).any():
        told = f"stamps {stamps[:3].tolist()} ..., " if len(stamps) else ""
        raise ValueError(f"drive: the answer has {told}{len(stamps)} poses: the first at time_now_us={now_us}, then on")
    q = np.array([(at.pose.quat.w, at.pose.quat.x, at.pose.quat.y, at.pose.quat.z) for at in trajectory.poses], float)
    poses = np.array([(at.pose.vec.x, at.pose.vec.y, 0.0) for at in trajectory.poses], float)
    w, x, y, z = q.T
    poses[:, HEADING] = np.unwrap(np.arctan2(2.0 * (w * z + x * y), w**2 + x**2 - y**2 - z**2))
    if not np.isfinite(poses).all() or not (np.abs((q**2).sum(axis=1) - 1.0) < 0.01).all():
        raise ValueError("drive: the answer has poses that are not finite, or whose quaternion is not one")
    at_us = now_us + STEP_US * np.arange(1, HORIZON_STEPS + 1)
    return np.stack([np.interp(at_us, stamps, poses[:, i]) for i in range(3)], axis=-1)
