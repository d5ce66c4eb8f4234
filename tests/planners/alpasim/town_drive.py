"""A planner of the town's closed loop that asks a driver over the wire, and holds every answer to its own."""

import os
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import grpc
import numpy as np
from carla_driver_interface import protocol
from numpy.typing import NDArray

from factory.alpasim.wire import start_server
from planners.alpasim.driver import Driver
from planners.evaluation.planner_names import find_planner
from planners.evaluation.planning import plan_samples
from tasks.world.commands import route_points
from tests.planners.alpasim import rollout as sent

NOW_US = 1_500_000
APART_M = 1e-3  # float32 of positions and JPEGs that are the same


class OverTheWire:
    """`local` is the frame of the ego at now: one session a plan."""

    digest = "1"

    @cached_property
    def _asked(self) -> tuple[Any, Any, Any]:
        folder = os.environ["ALPASIM_TOWN_PLANNER"]
        server, port = start_server([Driver(folder).service], "127.0.0.1", 0)
        load = find_planner(folder).load
        assert load is not None
        return load(), protocol.EgodriverServiceStub(grpc.insecure_channel(f"127.0.0.1:{port}")), server

    def plan(self, sample: Mapping[str, Any]) -> NDArray[np.float64]:
        """(40, 3)."""
        planner, stub, _ = self._asked
        uuid = str(sample["attempt_id"])
        request = protocol.DriveSessionRequest(session_uuid=uuid)
        for camera in sample["cameras"]:
            axis = np.reshape(camera["ego_from_camera"], (4, 4))[:2, 2]
            pose = sent.optical(float(np.arctan2(axis[1], axis[0])))
            declared = protocol.AvailableCamera(rig_to_camera=pose, logical_id=camera["name"])
            request.rollout_spec.vehicle.available_cameras.append(declared)
        stub.start_session(request)
        for image in sample["images"]:
            stamp = NOW_US + round(image["time_s"] * 1e6)
            shown = protocol.RolloutCameraImage.CameraImage(
                frame_end_us=stamp, image_bytes=image["jpeg"], logical_id=image["camera"]
            )
            stub.submit_image_observation(protocol.RolloutCameraImage(session_uuid=uuid, camera_image=shown))
        history = np.asarray(sample["ego_history_10hz"], np.float64)
        begin = NOW_US - 100_000 * (len(history) - 1)
        vx, vy, ax, ay = np.asarray(sample["ego_status"], np.float64)
        poses = [sent.pose_at(begin + 100_000 * i, *pose) for i, pose in enumerate(history.tolist())]
        motion = sent.egomotion(uuid, poses, vx)
        for state in motion.dynamic_states:
            state.linear_velocity.y, state.linear_acceleration.x, state.linear_acceleration.y = vy, ax, ay
        stub.submit_egomotion_observation(motion)
        waypoints = [
            protocol.Vec3(x=x, y=y) for x, y in route_points(np.asarray(sample["route_centerline"], np.float64))
        ]
        route = protocol.Route(waypoints=waypoints, timestamp_us=NOW_US)
        stub.submit_route(protocol.RouteRequest(session_uuid=uuid, route=route))
        asked = protocol.DriveRequest(session_uuid=uuid, time_now_us=NOW_US, time_query_us=NOW_US)
        answer = stub.drive(asked).trajectory
        stub.close_session(protocol.DriveSessionCloseRequest(session_uuid=uuid))
        found = np.array(
            [(p.pose.vec.x, p.pose.vec.y, 2 * np.arctan2(p.pose.quat.z, p.pose.quat.w)) for p in answer.poses]
        )
        expected = plan_samples(planner, [sample])[0]
        apart = np.abs(found[5:] - expected[4:])[:, :2].max()
        if apart > APART_M:
            raise AssertionError(f"{uuid}: {apart:g} m from the planner's own plan")
        return found[1:]
