"""A simulator's end of the contract, written with `carla-driver-interface` alone: nothing of this project is imported.

It drives as NVlabs/alpasim's nuPlan track does: a picture of each camera and the ego's pose every 0.5 s, at first two
poses 17 ms apart, a route of 20 points whose first ten are 42 m and more ahead and whose rest is NaN, all sent in any
order, and then `drive`. The car is where its plan said.
"""

import io
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from carla_driver_interface.geometry import Trajectory as Curve
from carla_driver_interface.protocol import (
    AvailableCamera,
    CameraSpec,
    DriveRequest,
    DriveSessionCloseRequest,
    DriveSessionRequest,
    DynamicState,
    EgodriverServiceStub,
    Pose,
    PoseAtTime,
    Quat,
    RolloutCameraImage,
    RolloutEgoTrajectory,
    Route,
    RouteRequest,
    Trajectory,
    Vec3,
)
from PIL import Image

YAWS = {"CAM_L0": math.radians(55.0), "CAM_F0": 0.0, "CAM_R0": math.radians(-55.0)}
STEP_US, FIRST_US = 500_000, 17_000
SIZE = (160, 90)
NAN = float("nan")


def optical(yaw: float) -> Pose:
    """A level camera 1.5 m before the rear axle: x right, y down, z ahead."""
    half = yaw / 2.0
    turn, lie = (math.cos(half), 0.0, 0.0, math.sin(half)), (0.5, -0.5, 0.5, -0.5)
    w = turn[0] * lie[0] - turn[3] * lie[3]
    x = turn[0] * lie[1] - turn[3] * lie[2]
    y = turn[0] * lie[2] + turn[3] * lie[1]
    z = turn[0] * lie[3] + turn[3] * lie[0]
    return Pose(vec=Vec3(x=1.5, z=1.6), quat=Quat(w=w, x=x, y=y, z=z))


def photo(seed: int, kind: str = "JPEG") -> bytes:
    """Soft patches, others for each seed."""
    patches = np.random.default_rng(seed).integers(0, 256, (9, 16, 3)).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(patches).resize(SIZE).save(out, kind, quality=95)
    return out.getvalue()


def pose_at(stamp_us: int, x: float, y: float, yaw: float) -> PoseAtTime:
    quat = Quat(w=math.cos(yaw / 2.0), z=math.sin(yaw / 2.0))
    return PoseAtTime(pose=Pose(vec=Vec3(x=x, y=y, z=0.7), quat=quat), timestamp_us=stamp_us)


def start(uuid: str, cameras: tuple[str, ...] = tuple(YAWS)) -> DriveSessionRequest:
    request = DriveSessionRequest(session_uuid=uuid, random_seed=3)
    for name in cameras:
        spec = CameraSpec(logical_id=name, resolution_w=SIZE[0], resolution_h=SIZE[1])
        camera = AvailableCamera(intrinsics=spec, rig_to_camera=optical(YAWS[name]), logical_id=name)
        request.rollout_spec.vehicle.available_cameras.append(camera)
    return request


def arc(curvature: float, along: np.ndarray) -> np.ndarray:
    """(N, 2) points of an arc from the ego on; curvature [1/m], to the left above 0."""
    turned = curvature * along
    chord = along * np.sinc(turned / (2.0 * np.pi))
    return np.stack([chord * np.cos(turned / 2.0), chord * np.sin(turned / 2.0)], axis=-1)


def route_request(uuid: str, stamp_us: int, curvature: float) -> RouteRequest:
    """As the track sends it: those before 40 m left out, and padded."""
    points = arc(curvature, np.linspace(0.0, 80.0, 20)[10:])
    waypoints = [Vec3(x=x, y=y, z=0.0) for x, y in points.tolist()] + [Vec3(x=NAN, y=NAN, z=NAN)] * 10
    return RouteRequest(session_uuid=uuid, route=Route(waypoints=waypoints, timestamp_us=stamp_us))


def egomotion(uuid: str, poses: list[PoseAtTime], speed: float, yaw_rate: float = 0.0) -> RolloutEgoTrajectory:
    state = DynamicState(linear_velocity=Vec3(x=speed), angular_velocity=Vec3(z=yaw_rate))
    return RolloutEgoTrajectory(
        session_uuid=uuid, trajectory=Trajectory(poses=poses), dynamic_states=[state] * len(poses)
    )


def picture(uuid: str, camera: str, stamp_us: int, kind: str = "JPEG") -> RolloutCameraImage:
    seed = list(YAWS).index(camera) + stamp_us
    shown = RolloutCameraImage.CameraImage(
        frame_start_us=stamp_us, frame_end_us=stamp_us, image_bytes=photo(seed, kind), logical_id=camera
    )
    return RolloutCameraImage(session_uuid=uuid, camera_image=shown)


@dataclass
class Rollout:
    """One session over a stub."""

    stub: EgodriverServiceStub
    uuid: str
    cameras: tuple[str, ...] = tuple(YAWS)
    curvature: float = 0.0  # of the route, 1/m
    speed: float = 6.0  # m/s at first
    order: random.Random | None = None  # in which messages come; None: as they are written here
    now_us: int = FIRST_US
    at: tuple[float, float, float] = (100.0, -40.0, 2.0)
    answers: list[Trajectory] = field(default_factory=list)

    def begin(self) -> None:
        self.stub.start_session(start(self.uuid, self.cameras))

    def observe(self) -> None:
        """All that comes before `drive`."""
        x, y, yaw = self.at
        poses = [pose_at(self.now_us, x, y, yaw)]
        if not self.answers:
            poses.insert(
                0, pose_at(0, x, y, yaw)
            )  # as logged: the car has moved 0.1 m, and the first pose does not say so
        motion = egomotion(self.uuid, poses, self.speed)
        messages: list[Callable[[], object]] = [
            lambda: self.stub.submit_egomotion_observation(motion),
            lambda: self.stub.submit_route(route_request(self.uuid, self.now_us, self.curvature)),
        ]
        for name in self.cameras:
            message = picture(self.uuid, name, self.now_us)
            messages.append(lambda message=message: self.stub.submit_image_observation(message))
        if self.order is not None:
            self.order.shuffle(messages)
        for send in messages:
            send()

    def drive(self) -> Trajectory:
        """Ask, and go where the answer leads in 0.5 s."""
        query_us = self.now_us + STEP_US
        request = DriveRequest(session_uuid=self.uuid, time_now_us=self.now_us, time_query_us=query_us)
        answer = self.stub.drive(request).trajectory
        self.answers.append(answer)
        pose = Curve.from_proto(answer).interpolate(query_us)
        before, self.now_us = self.at, query_us
        self.at = (float(pose.position[0]), float(pose.position[1]), float(pose.yaw))
        self.speed = math.dist(before[:2], self.at[:2]) / (STEP_US / 1e6)
        return answer

    def step(self) -> Trajectory:
        self.observe()
        return self.drive()

    def end(self) -> None:
        self.stub.close_session(DriveSessionCloseRequest(session_uuid=self.uuid))
