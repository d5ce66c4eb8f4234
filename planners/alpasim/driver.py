"""A planner behind AlpaSim's `egodriver.EgodriverService`: bytes of a request in, bytes of the answer out.

`Driver.service` is all of it without a socket; `serve` puts gRPC in front of it. Nothing that comes in is unpickled:
`renderer_data` is not looked at, and `debug_info` stays empty.
"""

import logging
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from queue import Empty, Queue
from typing import Any

import numpy as np

from factory import __version__
from factory.alpasim import wire
from factory.alpasim.wire import LARGEST, Fault, Service, Sessions, bounded, rotation_of, stamp_of, vector_of
from factory.config.compose import ConfigError
from planners.alpasim.session import (
    SECOND_US,
    Moment,
    PoseUnknown,
    Session,
    Unseen,
    local_poses,
    moment_of,
    straight_on,
)
from planners.data.batch import COMMANDS, ImageLayout, Needs
from planners.data.decode import BatchBuffer
from planners.data.images import chosen_cameras
from planners.evaluation.planner_names import find_planner
from planners.evaluation.planning import check_plan, plan_batch
from planners.navsim.serve import AgentObservation, ObservationRow, load_for_agent
from tasks.world.arrays import Array
from tasks.world.commands import CommandRule

SERVICE = "egodriver.EgodriverService"
QUERY_US = 60 * SECOND_US  # how far ahead a trajectory may be asked for
PATIENCE_S = 600.0  # of a question for its plan
# carla-driver-interface turns the cameras of a peer that does not name this revision of the contract (its contract.py).
CONTRACT = (("carla-driver-interface-contract", "2"),)
log = logging.getLogger(__name__)


def states_of(message: Any) -> dict[int, Array]:
    """Stamp -> state (9,) of a RolloutEgoTrajectory. Raises ValueError."""
    poses, dynamics = bounded("trajectory.poses", message.trajectory.poses), message.dynamic_states
    if len(dynamics) != len(poses):
        raise ValueError(f"dynamic_states: {len(dynamics)}, one for each of the {len(poses)} trajectory.poses expected")
    states = {}
    for i, (at, dynamic) in enumerate(zip(poses, dynamics)):
        x, y, z = vector_of(f"trajectory.poses[{i}].pose.vec", at.pose.vec)
        turned = rotation_of(f"trajectory.poses[{i}].pose.quat", at.pose.quat)
        name = f"dynamic_states[{i}]."
        vx, vy, _ = vector_of(f"{name}linear_velocity", dynamic.linear_velocity)
        ax, ay, _ = vector_of(f"{name}linear_acceleration", dynamic.linear_acceleration)
        yaw_rate = vector_of(f"{name}angular_velocity", dynamic.angular_velocity)[2]
        heading = np.arctan2(turned[1, 0], turned[0, 0])
        stamp = stamp_of(f"trajectory.poses[{i}].timestamp_us", at.timestamp_us)
        states[stamp] = np.array([x, y, heading, z, vx, vy, ax, ay, yaw_rate])
    return states


def route_of(route: Any) -> Array:
    """(N, 2) of a Route; NaN where there is no point. Raises ValueError for what is neither."""
    points = np.array([(p.x, p.y) for p in bounded("route.waypoints", route.waypoints)], np.float64).reshape(-1, 2)
    wrong = np.flatnonzero((np.abs(points) > LARGEST).any(axis=1))
    if len(wrong):
        raise ValueError(f"route.waypoints[{wrong[0]}]: beyond {LARGEST:g} m; NaN says that there is none")
    return points


def add_poses(trajectory: Any, poses: Mapping[int, Array], z: float = 0.0) -> None:
    """Add poses (3,) x, y, heading by their stamps to a Trajectory."""
    for stamp, (x, y, heading) in poses.items():
        at = trajectory.poses.add(timestamp_us=stamp)
        at.pose.vec.x, at.pose.vec.y, at.pose.vec.z = x, y, z
        at.pose.quat.w, at.pose.quat.z = np.cos(heading / 2.0), np.sin(heading / 2.0)


def session_cameras(declared: Sequence[Any], layout: ImageLayout | None, given: Sequence[str]) -> tuple[str, ...]:
    """Whose pictures a planner looks at, left to right: those given, else of its names, else by direction.

    declared: AvailableCameras; names in lower case. Raises ValueError.
    """
    field_name = "rollout_spec.vehicle.available_cameras"
    names = [camera.logical_id.lower() for camera in bounded(field_name, declared)]
    if len(set(names)) < len(names):
        raise ValueError(f"{field_name}: a logical_id stands there twice: {', '.join(names)}")
    if layout is None:
        return ()
    wanted = tuple(name.lower() for name in given or layout.cameras)
    if not wanted:
        quats = ((f"{field_name}[{i}].rig_to_camera.quat", c.rig_to_camera.quat) for i, c in enumerate(declared))
        axes = np.array([rotation_of(*quat)[:2, 2] for quat in quats])  # the optical frame looks along z
        wanted = chosen_cameras(names, axes.reshape(-1, 2), layout)
    if missing := [name for name in wanted if name not in names]:
        there = ", ".join(names) or "none"
        raise ValueError(f"{field_name}: no {', '.join(missing)}, which the planner looks at; sent: {there}")
    return wanted


# Plans, by one thread, of all sessions that ask at a time.


class BatchedPlanner:
    """A planner that is asked from many threads, by one of its own.

    In batches of one a plan depends on its row alone, to the last bit. In larger ones its rounding depends on how many
    are planned with it, and at which place.
    """

    def __init__(self, made: Any, needs: Needs, device: str, size: int, wait_s: float) -> None:
        """size: of a batch at most; wait_s: for others, once one has asked."""
        self._made, self._needs, self._device, self._size, self._wait_s = made, needs, device, size, wait_s
        self._asked: Queue[tuple[ObservationRow, Future[Array]] | None] = Queue()
        self._thread = threading.Thread(target=self._work, name="planner", daemon=True)
        self._thread.start()

    def plan(self, row: ObservationRow) -> Array:
        """(8 or 40, 3), not checked. Raises what the planner raises for this row alone."""
        future: Future[Array] = Future()
        self._asked.put((row, future))
        return future.result(PATIENCE_S)

    def close(self) -> None:
        """End the thread, after what is asked."""
        self._asked.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (first := self._asked.get()) is not None:
            asked = [first]
            while len(asked) < self._size:
                try:
                    following = self._asked.get(timeout=self._wait_s)
                except Empty:
                    break
                if following is None:
                    self._asked.put(None)
                    break
                asked.append(following)
            self._answer(asked)

    def _answer(self, asked: Sequence[tuple[ObservationRow, Future[Array]]]) -> None:
        try:
            plans = self._planned([row for row, _ in asked])
        except Exception as error:  # handed to who asked; where several did, each is asked about alone
            if len(asked) == 1:
                asked[0][1].set_exception(error)
            else:
                for one in asked:
                    self._answer([one])
            return
        for plan, (_, future) in zip(plans, asked):
            future.set_result(plan)

    def _planned(self, rows: Sequence[ObservationRow]) -> Array:
        import torch

        buffer = BatchBuffer(len(rows), self._needs, 0)
        for i, row in enumerate(rows):
            buffer.fill(i, row, 0)
        nobody = np.zeros(len(rows), bool)
        torch.manual_seed(0)  # of a planner that draws, as the public DiffusionDrive does
        return plan_batch(self._made, buffer.batch(["alpasim"] * len(rows), nobody, nobody).to(self._device))


# The service.


@dataclass
class _Rollout:
    """A session, who may touch it, and what came of its questions."""

    session: Session
    lock: threading.Lock = field(default_factory=threading.Lock)
    counts: Counter[str] = field(default_factory=Counter)


class Driver:
    """Every RPC of the service."""

    def __init__(
        self,
        planner: str,
        device: str = "cpu",
        cameras: Sequence[str] = (),
        command: CommandRule | None = None,
        batch: int = 1,
        wait_s: float = 0.002,
        changed: Mapping[str, Any] | None = None,
    ) -> None:
        """Loads the planner and plans once. The arguments: planners.serve.Request; changed: settings of a trained one.

        Raises ConfigError for a planner that wants more than AlpaSim sends, and without the messages' package.
        """
        self._proto, self._given = wire.contract("protocol=alpasim", "planners"), cameras
        made, needs = load_for_agent(planner, device, "AlpaSim", changed)
        self._rule: CommandRule = command or needs.command
        self._needs = replace(needs, command="navsim")  # the rows have one already, by the rule
        layout = needs.image
        places = () if layout is None else layout.cameras or cameras
        if len(cameras) not in (0, len(places)):
            raise ConfigError(f"cameras: {len(cameras)}, in the places of {len(places)}: {', '.join(places) or 'none'}")
        who = find_planner(planner)
        self._version = f"driving-data-factory {__version__} {who.label} {who.digest}"
        self.counts: Counter[str] = Counter()
        self.rollouts: Sessions[_Rollout] = Sessions()
        self._lock = threading.Lock()
        self._planner = BatchedPlanner(made, self._needs, device, batch, wait_s)
        protocol = self._proto
        requests = {
            "get_version": (self._get_version, protocol.Empty),
            "start_session": (self._start_session, protocol.DriveSessionRequest),
            "close_session": (self._close_session, protocol.DriveSessionCloseRequest),
            "submit_image_observation": (self._submit_image, protocol.RolloutCameraImage),
            "submit_egomotion_observation": (self._submit_egomotion, protocol.RolloutEgoTrajectory),
            "submit_route": (self._submit_route, protocol.RouteRequest),
            "submit_recording_ground_truth": (self._ignore, protocol.GroundTruthRequest),
            "drive": (self._drive, protocol.DriveRequest),
            "shut_down": (lambda _: protocol.Empty(), protocol.Empty),  # of old versions; a signal ends the server
        }
        self.service = Service(SERVICE, requests, {"get_version": CONTRACT})
        seen = AgentObservation(np.zeros((4, 3)), np.eye(8)[COMMANDS.index("straight")])
        try:
            self._plan_of(seen, None if layout is None else np.zeros((layout.height, layout.width, 3), np.uint8))
        except Unseen as error:
            raise ConfigError(f"planner={planner}: at rest, on a black picture: {error}") from error

    def close(self) -> None:
        """Say what came of all questions, and end the planner's thread."""
        log.warning("all sessions: %s", _told(self.counts))
        self._planner.close()

    def _get_version(self, _: Any) -> Any:
        return self._proto.VersionId(version_id=self._version, grpc_api_version=self._proto.ALPASIM_API_VERSION)

    def _start_session(self, message: Any) -> Any:
        declared = message.rollout_spec.vehicle.available_cameras
        cameras = session_cameras(declared, self._needs.image, self._given)
        session = Session(cameras, frozenset(camera.logical_id.lower() for camera in declared))
        self.rollouts.begin(message.session_uuid, _Rollout(session))
        return self._proto.SessionRequestStatus()

    def _close_session(self, message: Any) -> Any:
        rollout = self.rollouts.end(message.session_uuid)
        level = logging.WARNING if rollout.counts["fallbacks"] else logging.INFO
        log.log(level, "session %s: %s", message.session_uuid, _told(rollout.counts))
        return self._proto.Empty()

    def _submit_image(self, message: Any) -> Any:
        rollout, image = self.rollouts[message.session_uuid], message.camera_image
        stamp = stamp_of("camera_image.frame_end_us", image.frame_end_us)
        with rollout.lock:
            rollout.session.keep_frame(image.logical_id.lower(), stamp, image.image_bytes)
        return self._proto.Empty()

    def _submit_egomotion(self, message: Any) -> Any:
        rollout, states = self.rollouts[message.session_uuid], states_of(message)
        with rollout.lock:
            rollout.session.keep_states(states)
        return self._proto.Empty()

    def _submit_route(self, message: Any) -> Any:
        rollout, points = self.rollouts[message.session_uuid], route_of(message.route)
        stamp = stamp_of("route.timestamp_us", message.route.timestamp_us)
        with rollout.lock:
            rollout.session.keep_route(stamp, points)
        return self._proto.Empty()

    def _ignore(self, message: Any) -> Any:
        self.rollouts[message.session_uuid]
        return self._proto.Empty()

    def _drive(self, message: Any) -> Any:
        rollout = self.rollouts[message.session_uuid]
        now, query = (stamp_of(name, getattr(message, name)) for name in ("time_now_us", "time_query_us"))
        if not now <= query <= now + QUERY_US:
            raise ValueError(f"time_query_us={query}: from time_now_us={now} to {QUERY_US} us later")
        try:
            with rollout.lock:
                plan, state, begin = self._planned_now(rollout, now, message.session_uuid)
        except PoseUnknown as error:
            raise Fault("FAILED_PRECONDITION", f"drive: {error}") from error
        answer = self._proto.DriveResponse()
        add_poses(answer.trajectory, local_poses(plan, state, begin, now, query), state[3])
        return answer

    def _planned_now(self, rollout: _Rollout, now: int, uuid: str) -> tuple[Array, Array, int]:
        """A plan, the state and the stamp that it begins at; the fallback where the planner has none."""
        try:
            moment = moment_of(rollout.session, now)
            seen, layout = moment.observed(self._rule), self._needs.image
            plan = self._plan_of(seen, None if layout is None else moment.draw(layout))
            what = "plans"
        except Unseen as error:
            moment = Moment(rollout.session, now)
            plan, what = straight_on(moment.state), "fallbacks"
            log.warning("session %s at %d us: straight on at the ego's speed: %s", uuid, now, error)
        with self._lock:
            rollout.counts[what] += 1
            self.counts[what] += 1
        return plan, moment.state, moment.stamp_us

    def _plan_of(self, seen: AgentObservation, picture: Any) -> Array:
        """Raises Unseen for what is no plan."""
        try:
            plan = self._planner.plan(ObservationRow(seen, lambda layout, out: np.copyto(out, picture)))
            check_plan(plan, "the planner")
        except ValueError as error:
            raise Unseen(str(error)) from error
        return plan


def _told(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[what]} {what}" for what in ("plans", "fallbacks"))


def serve(driver: Driver, host: str, port: int) -> None:
    """Answer until SIGTERM, or until its terminal closes. Raises Refused where the port is not to be had."""
    try:
        wire.serve([driver.service], host, port)
    finally:
        driver.close()
