"""A client of the renderer and the traffic: their contracts' messages, and a served street of 680 Gaussians."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from carla_driver_interface.protocol import common_pb2, sensorsim_pb2
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factory.alpasim.scenes import Scenes, ServedScene, scene_of_clip
from factory.alpasim.wire import Service
from tasks.render.scene.asset import BlockRange, Exposure, OwnBody, RenderAsset
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.clip import Camera
from tests.tasks.streets import street_clip

Array = NDArray[np.float64]
STREET = "5ce0e00000000001"
OPTICAL = np.array([[0.0, 0.0, 1.0, 1.5], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
K = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
BENT = np.array([-0.3, 0.1, 0.002, -0.001, -0.01])


def gaussians(n: int, low: Any, high: Any, seed: int) -> Gaussians:
    """Balls of 0.3 m in a box."""
    rng = np.random.default_rng(seed)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    arrays = (rng.uniform(low, high, (n, 3)), quats, np.full((n, 3), np.log(0.3)), np.full(n, 0.8))
    return Gaussians(*(a.astype(np.float32) for a in (*arrays, rng.uniform(0, 1, (n, 3)), np.zeros((n, 0, 3)))))


@cache
def street() -> ServedScene:
    """Two cameras, one of them with a lens; the car ahead has Gaussians, the others are boxes; light fades."""
    bent = Camera("bent", 96, 64, K, BENT, OPTICAL)
    clip = replace(street_clip(), start_s=3.0, cameras=(Camera("front", 96, 64, K, np.zeros(5), OPTICAL), bent))
    rng = np.random.default_rng(0)
    rgba = np.zeros((64, 96, 4), np.uint8)
    rgba[54:] = (40, 200, 40, 255)
    asset = RenderAsset(
        np.array([10.0, -4.0, 0.5]),
        gaussians(600, [-20.0, -9.0, -0.5], [90.0, 9.0, 4.0], 1),
        {"ahead": gaussians(80, [-2.0, -0.9, -0.7], [2.0, 0.9, 0.7], 2)},
        SkyMap(rng.uniform(0, 1, (ROWS, COLUMNS, 3)).astype(np.float32)),
        27.0,
        block=BlockRange(clip.dataset, clip.log_id, 1.0, 14.0, np.zeros(2), np.ones(2)),
        exposures=tuple(
            Exposure(name, 2.0 + 9.0 * dark, np.eye(3, 4, dtype=np.float32) * (1.0 - np.float32(0.6 * dark)))
            for name in ("front", "bent")
            for dark in (0.0, 1.0)
        ),
        bodies=(OwnBody("front", rgba), OwnBody("bent", rgba)),
    )
    return scene_of_clip(clip, asset)


def scenes(*more: str) -> Scenes:
    """The street, by its own name and others."""
    return Scenes(dict.fromkeys((STREET, *more), street))


def pose_message(pose: Array) -> Any:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    vec = dict(zip("xyz", pose[:3, 3].tolist()))
    return common_pb2.Pose(vec=common_pb2.Vec3(**vec), quat=common_pb2.Quat(w=w, x=x, y=y, z=z))


def pair(pose: Array) -> Any:
    told = pose_message(pose)
    return sensorsim_pb2.PosePair(start_pose=told, end_pose=told)


def asked(service: Service, method: str, message: Any) -> bytes:
    return service.answer(method, message.SerializeToString())


def cameras(service: Service, scene_id: str) -> dict[str, Any]:
    request = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
    answer = sensorsim_pb2.AvailableCamerasReturn.FromString(asked(service, "get_available_cameras", request))
    return {camera.logical_id: camera for camera in answer.available_cameras}


def shot(of: str, camera: Any, local_from_ego: Array, stamp_us: int, objects: Mapping[str, Array], **how: Any) -> Any:
    """As AlpaSim asks for one picture; `camera` as get_available_cameras told it, poses (4, 4) in `local`."""
    to_camera, size = camera.rig_to_camera, camera.intrinsics
    q = to_camera.quat
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    mount[:3, 3] = to_camera.vec.x, to_camera.vec.y, to_camera.vec.z
    request = sensorsim_pb2.RGBRenderRequest(
        scene_id=of,
        resolution_h=size.resolution_h,
        resolution_w=size.resolution_w,
        camera_intrinsics=camera.intrinsics,
        frame_start_us=max(stamp_us - 17_000, 0),
        frame_end_us=stamp_us,
        sensor_pose=pair(local_from_ego @ mount),
        image_format=sensorsim_pb2.PNG,
        image_quality=95,
    )
    for track_id, pose in objects.items():
        request.dynamic_objects.add(track_id=track_id, pose_pair=pair(pose))
    for name, value in how.items():
        setattr(request, name, value)
    return request


def with_ego_pose(request: Any, local_from_ego: Array) -> bytes:
    """The request's bytes with `ego_pose` = 1013, which the vendored messages do not have: tag, length, PosePair."""
    data = pair(local_from_ego).SerializeToString()
    tag, length = (EGO_FIELD << 3) | 2, len(data)
    assert length < 1 << 14
    varints = [byte for n in (tag, length) for byte in ((n & 127) | 128, n >> 7)]
    return bytes(request.SerializeToString()) + bytes(varints) + data


EGO_FIELD = 1013
