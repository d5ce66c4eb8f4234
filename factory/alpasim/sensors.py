"""Fitted scenes behind AlpaSim's `nre.grpc.protos.sensorsim.SensorsimService`: the pictures of a run at any pose.

A request is drawn as a run draws a sample (`tasks.render.views`): at its `frame_end_us`, which AlpaSim stamps the
picture with, the ego standing on the scene's road at the x, y and heading that were sent, the objects that were sent at
their x, y and heading, as high as their log has them where it came nearest. Colours are those that the camera had then,
in front is its own car, and where the request's camera has a distortion the picture is as that lens takes it.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from factory import __version__
from factory.alpasim.scenes import Scenes, ServedScene
from factory.alpasim.wire import (
    Service,
    bounded,
    contract,
    heading_of,
    pose_of,
    stamp_of,
    write_pose,
)
from tasks.render.lens import Lens, lens_of, render_through_lens
from tasks.render.scene.engine import encode_jpeg
from tasks.render.settings import Backend
from tasks.render.views import render_views
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import STEP_S, AgentTracks, Camera
from tasks.world.frames import EGO_STATE_SIZE, pose_on_ground

SERVICE = "nre.grpc.protos.sensorsim.SensorsimService"
MOST_SIDE, MOST_PIXELS = 4096, 3840 * 2160  # of a picture
MOST_PICTURES = 64  # of a request
SAME_MOUNT = 1e-3  # m, and of a rotation's elements: a sent mount that near is the scene's own, rounded on the wire
HIDDEN_M = 100.0  # AlpaSim lowers a track by as much that is not to be seen (its unbound_rollout.py)
EGO_POSE = 1013  # RGBRenderRequest.ego_pose, a PosePair of newer contracts than the vendored one
LENSES = 16  # of which the maps are kept


class Sensors:
    """The service. `pinhole`: its cameras are told without the distortion of their lenses."""

    def __init__(self, scenes: Scenes, backend: Backend = Backend.CPU, pinhole: bool = False) -> None:
        """Raises ConfigError without the messages' package."""
        proto = contract("scene serve", "run,alpasim")
        sensorsim, common = proto.sensorsim_pb2, proto.common_pb2
        self._scenes, self._backend, self._pinhole = scenes, backend, pinhole
        self._api, self._sensorsim, self._common = proto.ALPASIM_API_VERSION, sensorsim, common
        self._lens = lru_cache(LENSES)(_lens_of)
        self._drawing = ThreadPoolExecutor(1 if backend.on_gpu else os.cpu_count(), "drawing")
        requests = {
            "get_version": (self._get_version, common.Empty),
            "get_available_scenes": (self._get_scenes, common.Empty),
            "get_available_cameras": (self._get_cameras, sensorsim.AvailableCamerasRequest),
            "get_available_ego_masks": (lambda _: sensorsim.AvailableEgoMasksReturn(), common.Empty),
            "render_rgb": (self._render_rgb, sensorsim.RGBRenderRequest),
            "render_aggregated": (self._render_aggregated, sensorsim.AggregatedRenderRequest),
            "batch_render_rgb": (self._batch_render_rgb, sensorsim.BatchRGBRenderRequest),
        }
        self.service = Service(SERVICE, requests)

    def _get_version(self, _: Any) -> Any:
        version = f"driving-data-factory {__version__} scenes"
        return self._common.VersionId(version_id=version, git_hash=self._scenes.digest, grpc_api_version=self._api)

    def _get_scenes(self, _: Any) -> Any:
        return self._common.AvailableScenesReturn(scene_ids=self._scenes.ids)

    def _get_cameras(self, message: Any) -> Any:
        answer = self._sensorsim.AvailableCamerasReturn()
        for camera in self._scenes.find("scene_id", message.scene_id).cameras:
            told = answer.available_cameras.add(logical_id=camera.name)
            spec, k = told.intrinsics, camera.intrinsics
            spec.logical_id, spec.shutter_type = camera.name, self._sensorsim.GLOBAL
            spec.resolution_w, spec.resolution_h = camera.width, camera.height
            lens = spec.opencv_pinhole_param
            lens.focal_length_x, lens.focal_length_y = k[0, 0], k[1, 1]
            lens.principal_point_x, lens.principal_point_y = k[0, 2], k[1, 2]
            if not self._pinhole:
                k1, k2, p1, p2, k3 = camera.distortion.tolist()
                lens.radial_coeffs[:], lens.tangential_coeffs[:] = [k1, k2, k3, 0.0, 0.0, 0.0], [p1, p2]
                lens.thin_prism_coeffs[:] = [0.0] * 4
            write_pose(told.rig_to_camera, camera.ego_from_camera)
        return answer

    def _render_rgb(self, message: Any) -> Any:
        return self._pictures("", [("", message)])[0]

    def _render_aggregated(self, message: Any) -> Any:
        if message.lidar_requests:
            raise ValueError("lidar_requests: no lidar is simulated; leave them out")
        asked = [(f"rgb_requests[{i}].", request) for i, request in enumerate(message.rgb_requests)]
        return self._sensorsim.AggregatedRenderReturn(rgb_returns=self._pictures("rgb_requests", asked))

    def _batch_render_rgb(self, message: Any) -> Any:
        found = self._pictures("items", [(f"items[{i}].request.", one.request) for i, one in enumerate(message.items)])
        answer = self._sensorsim.BatchRGBRenderReturn()
        for item, picture in zip(message.items, found):
            answer.items.add(camera_name=item.camera_name, result=picture, success=True)
        return answer

    def _pictures(self, name: str, asked: Sequence[tuple[str, Any]]) -> list[Any]:
        """RGBRenderReturns of requests, each with what stands before its fields' names."""
        bounded(name, asked, MOST_PICTURES)
        return list(self._drawing.map(lambda one: self._picture(*one), asked))

    def _picture(self, at: str, message: Any) -> Any:
        scene = self._scenes.find(f"{at}scene_id", message.scene_id)
        encode = self._encoding(at, message)
        if message.insert_ego_mask:
            raise ValueError(f"{at}insert_ego_mask: there are no masks; what a camera sees of its car is drawn anyway")
        stamp = stamp_of(f"{at}frame_end_us", message.frame_end_us)
        if message.frame_start_us > stamp:
            raise ValueError(f"{at}frame_start_us={message.frame_start_us}: after frame_end_us={stamp}")
        step = stamp / (1e6 * STEP_S)
        camera, ego = self._camera_and_ego(at, message, scene)
        agents = placed_agents(f"{at}dynamic_objects", message.dynamic_objects, scene)
        if np.any(camera.distortion):
            try:
                lens = self._lens(camera.width, camera.height, *camera.intrinsics.ravel(), *camera.distortion)
            except ValueError as error:
                raise ValueError(f"{at}camera_intrinsics.opencv_pinhole_param: {error}") from error
            rgb = render_through_lens(scene.asset, camera, lens, ego, agents, step, self._backend)
        else:
            size = camera.width, camera.height
            rgb = next(render_views(scene.asset, [camera], ego[None], agents, [step], *size, self._backend))[0]
        return self._sensorsim.RGBRenderReturn(image_bytes=encode(rgb))

    def _encoding(self, at: str, message: Any) -> Any:
        """Of the picture (H, W, 3), as asked."""
        quality = message.image_quality
        match message.image_format:
            case self._sensorsim.PNG:
                return _encode_png
            case self._sensorsim.JPEG:
                if not 1.0 <= quality <= 100.0:
                    raise ValueError(f"{at}image_quality={quality:g}: from 1 to 100")
                return lambda rgb: encode_jpeg(rgb, round(quality))
            case other:
                raise ValueError(f"{at}image_format={other}: PNG (1) or JPEG (2)")

    def _camera_and_ego(self, at: str, message: Any, scene: ServedScene) -> tuple[Camera, Array]:
        """The camera of the picture's size as it is mounted, and where the ego (4, 4) is in the world."""
        eye = pose_of(f"{at}sensor_pose.end_pose", message.sensor_pose.end_pose)
        name = message.camera_intrinsics.logical_id
        own = next((camera.ego_from_camera for camera in scene.cameras if camera.name == name), None)
        sent = self._ego_pose(at, message)
        if sent is not None:
            mount = np.linalg.inv(sent) @ eye
            if own is not None and np.abs(mount - own).max() < SAME_MOUNT:
                mount = own
        elif own is not None:
            mount = own
        else:
            known = ", ".join(camera.name for camera in scene.cameras)
            raise ValueError(f"{at}camera_intrinsics.logical_id={name[:64]!r}: one of {known}, or send ego_pose")
        rig = eye @ np.linalg.inv(mount)
        state = np.zeros((1, EGO_STATE_SIZE))
        state[0, :3] = *(rig[:2, 3] + scene.origin[:2]), heading_of(rig)
        return camera_of(at, message, mount), pose_on_ground(scene.on_road, state)[0]

    def _ego_pose(self, at: str, message: Any) -> Array | None:
        """`ego_pose` (4, 4) in local, which the vendored messages do not know; None where it was not sent."""
        from google.protobuf.message import DecodeError
        from google.protobuf.unknown_fields import UnknownFieldSet

        sent = [field.data for field in UnknownFieldSet(message) if field.field_number == EGO_POSE]
        if not sent:
            return None
        try:
            pair = self._sensorsim.PosePair.FromString(sent[-1])
        except (DecodeError, TypeError) as error:
            raise ValueError(f"{at}ego_pose: no PosePair: {error}") from error
        return pose_of(f"{at}ego_pose.end_pose", pair.end_pose)


def camera_of(at: str, message: Any, mount: Array) -> Camera:
    """The camera of a request for its picture's size. Raises ValueError."""
    spec, width, height = message.camera_intrinsics, message.resolution_w, message.resolution_h
    for name, w, h in (("resolution", width, height), ("camera_intrinsics.resolution", *_size_of(spec))):
        if not (0 < w <= MOST_SIDE and 0 < h <= MOST_SIDE and w * h <= MOST_PIXELS):
            raise ValueError(f"{at}{name}_w, _h={w}, {h}: 1 to {MOST_SIDE:,} pixels, {MOST_PIXELS:,} in all")
    if spec.WhichOneof("camera_param") != "opencv_pinhole_param":
        raise ValueError(f"{at}camera_intrinsics: opencv_pinhole_param is drawn, no other lens")
    lens, at_lens = spec.opencv_pinhole_param, f"{at}camera_intrinsics.opencv_pinhole_param"
    radial, tangential = [*lens.radial_coeffs, 0.0, 0.0, 0.0], [*lens.tangential_coeffs, 0.0, 0.0]
    if any(radial[3:]) or any(tangential[2:]) or any(lens.thin_prism_coeffs):
        raise ValueError(f"{at_lens}: distortion by k1, k2, k3, p1 and p2 is drawn; other coefficients must be 0")
    intrinsics = np.diag([lens.focal_length_x, lens.focal_length_y, 1.0])
    intrinsics[:2, 2] = lens.principal_point_x, lens.principal_point_y
    distortion = np.array([radial[0], radial[1], tangential[0], tangential[1], radial[2]])
    try:
        return Camera(spec.logical_id, *_size_of(spec), intrinsics, distortion, mount).resized(width, height)
    except ZeroDivisionError as error:
        raise ValueError(
            f"{at}resolution_w, _h={width}, {height}: less than a pixel of the camera's picture"
        ) from error
    except ValueError as error:
        raise ValueError(f"{at}camera_intrinsics: {error}") from error


def placed_agents(name: str, objects: Sequence[Any], scene: ServedScene) -> AgentTracks:
    """Tracks of the scene where a request has them, over one step. Raises ValueError."""
    tracks, places = {track_id: j for j, track_id in enumerate(scene.agents.track_ids)}, dict[int, Array]()
    for i, one in enumerate(bounded(name, objects)):
        if (j := tracks.get(one.track_id)) is None:
            raise ValueError(f"{name}[{i}].track_id={one.track_id[:64]!r}: no track of this scene")
        if j in places:
            raise ValueError(f"{name}[{i}].track_id={one.track_id!r}: stands there twice")
        pose = pose_of(f"{name}[{i}].pose_pair.end_pose", one.pose_pair.end_pose)
        places[j] = np.array([*(pose[:3, 3] + scene.origin), heading_of(pose)])
    columns, log = list(places), scene.agents
    sent = np.stack([*places.values(), np.zeros(4)])[:-1]
    off = np.linalg.norm(log.boxes[:, columns, :2] - sent[:, :2], axis=-1)
    there = log.valid[:, columns]
    if not there.any(axis=0).all():
        raise ValueError(f"{name}[{int(np.argmin(there.any(axis=0)))}].track_id: it is at no place in this scene's log")
    nearest = np.argmin(np.where(there, off, np.inf), axis=0)
    boxes, center_z = log.boxes[nearest, columns].copy(), log.center_z[nearest, columns]
    boxes[:, :3] = sent[:, [0, 1, 3]]
    shown = np.abs(sent[:, 2] - center_z + HIDDEN_M) > HIDDEN_M / 2.0
    return AgentTracks(
        tuple(log.track_ids[j] for j in columns),
        tuple(log.kinds[j] for j in columns),
        boxes[None],
        np.zeros((1, len(columns), 2)),
        shown[None],
        center_z[None],
        log.heights[columns],
    )


def _size_of(spec: Any) -> tuple[int, int]:
    return spec.resolution_w, spec.resolution_h


def _lens_of(width: int, height: int, *values: float) -> Lens:
    return lens_of(width, height, np.reshape(values[:9], (3, 3)), np.array(values[9:]))


def _encode_png(rgb: Bytes) -> bytes:
    done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    assert done, "an 8-bit picture"
    return data.tobytes()
