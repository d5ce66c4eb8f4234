"""The cameras of a drive as a renderer shows them by AlpaSim's `SensorsimService`, such as `factory scene serve`, or
the same service in this process.

Its scene is the clip's, by its id; `local` and stamps are those of factory.alpasim.scenes. Pictures are asked for
without the lenses' distortion, one of each camera, of now.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from factory.alpasim.scenes import scenes_of_run
from factory.alpasim.sensors import SERVICE, Sensors, camera_of
from factory.alpasim.wire import Fault, pose_of, write_pose
from factory.stages.imaging import Imaging
from factory.stages.sensors import choose_cameras
from factory.views.status import open_store
from planners.alpasim.session import STEP_US
from planners.drive.cameras import Images, ego_state_at
from planners.drive.contract import Ask, ask_over_the_wire, messages
from tasks.render.scene.movers import agents_at_time, world_from_boxes
from tasks.render.settings import Backend, ImageSource, RenderSettings
from tasks.world.clip import CLIP_STEPS, STEP_S, Camera, Clip, Scene
from tasks.world.frames import pose_on_ground


@lru_cache(maxsize=8)
def cached_renderer(named: str, backend: Backend = Backend.CPU) -> Ask:
    """Questions to the renderer at host:port, or to that of a run's folder in this process: the same bytes either way.

    Raises ConfigError, and Refused for a folder that is no run's; an answer's fault is a ValueError.
    """
    if not Path(named).is_dir():
        return ask_over_the_wire(named, "renderer", SERVICE)
    service = Sensors(scenes_of_run(open_store(named)), backend).service

    def ask(method: str, request: bytes) -> bytes:
        try:
            return service.answer(method, request)
        except Fault as fault:
            raise ValueError(f"renderer={named}: {method}: {fault.status} {fault}") from fault

    return ask


@dataclass(frozen=True)
class ServedCameras:
    """planners.drive.cameras.DriveCameras of a clip that a renderer has a scene of; ask: its RPCs."""

    clip: Clip
    settings: RenderSettings
    ask: Ask = field(repr=False)
    source: ImageSource = ImageSource.RENDER
    offsets: tuple[int, ...] = (0,)

    @cached_property
    def _shots(self) -> tuple[tuple[Camera, Any], ...]:
        """Cameras, and what is asked of each at every instant. Raises ValueError for a scene that is not there."""
        proto, s = messages().sensorsim_pb2, self.settings
        request = proto.AvailableCamerasRequest(scene_id=self.clip.clip_id)
        told = proto.AvailableCamerasReturn.FromString(
            self.ask("get_available_cameras", request.SerializeToString())
        ).available_cameras
        found = {}
        for one in told:
            lens = one.intrinsics.opencv_pinhole_param
            for name in ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs"):
                lens.ClearField(name)
            shot = proto.RGBRenderRequest(
                scene_id=self.clip.clip_id,
                resolution_w=s.width,
                resolution_h=s.height,
                camera_intrinsics=one.intrinsics,
                image_format=proto.JPEG,
                image_quality=s.jpeg_quality,
            )
            at = f"available_cameras={one.logical_id}: "
            found[one.logical_id] = camera_of(at, shot, pose_of(f"{at}rig_to_camera", one.rig_to_camera)), shot
        chosen = choose_cameras([camera for camera, _ in found.values()], s.cameras)
        return tuple(found[camera.name] for camera in chosen)

    @property
    def rig(self) -> Sequence[Mapping[str, Any]]:
        """Raises ValueError for a scene that is not there, or without a camera that is asked for."""
        return Imaging(self.settings, "").rig([camera for camera, _ in self._shots])

    def images(self, scene: Scene, offset: int) -> Images:
        """With everybody that the clip's own window knows, the only ones that the renderer does."""
        proto, step, origin = messages().sensorsim_pb2, scene.step + offset, self.clip.world_from_ego[0, :3, 3]
        place = pose_on_ground(self.clip.world_from_ego, ego_state_at(scene, offset))[0]
        there = agents_at_time(scene.agents, step * STEP_S)
        ego, bodies = place.copy(), world_from_boxes(there.boxes)
        ego[:3, 3] -= origin
        bodies[:, :3, 3] -= origin
        log = self.clip.agents
        served = {log.track_ids[j] for j in np.flatnonzero(log.valid[:CLIP_STEPS].any(axis=0)).tolist()}
        request = proto.AggregatedRenderRequest()
        for camera, shot in self._shots:
            one = request.rgb_requests.add()
            one.CopyFrom(shot)
            one.frame_start_us = one.frame_end_us = STEP_US * step
            for pose in (one.sensor_pose.start_pose, one.sensor_pose.end_pose):
                write_pose(pose, ego @ camera.ego_from_camera)
            for track_id, body in zip(there.track_ids, bodies):
                if track_id in served:
                    pair = one.dynamic_objects.add(track_id=track_id).pose_pair
                    for pose in (pair.start_pose, pair.end_pose):
                        write_pose(pose, body)
        answer = proto.AggregatedRenderReturn.FromString(self.ask("render_aggregated", request.SerializeToString()))
        return [
            {"camera": camera.name, "time_s": offset * STEP_S, "ego_pose": place.ravel(), "jpeg": seen.image_bytes}
            for (camera, _), seen in zip(self._shots, answer.rgb_returns, strict=True)
        ]
