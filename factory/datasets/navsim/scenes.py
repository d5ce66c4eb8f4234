"""NAVSIM's frames as a scene and as columns of a sample: a drive that others made, looked at as a log of its own.

The fourth frame is T, and now. What lies beyond the last frame is unknown: the ego's states are NaN there, and nobody
else is there. Between two frames everything is as `factory.datasets.navsim.tracks` says, what the public code makes of
it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factory.datasets.navsim.log import Frame
from factory.datasets.navsim.road import RoadAhead, blobs_of, rig_of
from factory.datasets.navsim.tracks import (
    FRAMES_BEFORE,
    WINDOW_FRAMES,
    ego_states,
    lights,
    n_steps,
    window_agents,
    world_from_ego,
)
from factory.readers.base import BadClip
from factory.readers.pictures import BadPicture, jpeg_size, refuse_size, without_exif
from factory.stages.rows import scene_columns
from tasks.render.settings import ImageSource
from tasks.world.arrays import Array
from tasks.world.clip import (
    CLIP_STEPS,
    HORIZON_STEPS,
    NOW,
    PER_STEP,
    STEP_S,
    AgentTracks,
    Camera,
    Clip,
    Scene,
    scene_of_clip,
)
from tasks.world.frames import EGO_STATE_SIZE, HEADING, to_local
from tasks.world.road_map import LightState, RoadMap, Route, TrafficLights

HISTORY_FRAMES = FRAMES_BEFORE + 1  # now among them
SCENE_FRAMES = HISTORY_FRAMES + 8  # with the 4 s that are driven
COARSE_STEPS = 5  # between two frames


@dataclass(frozen=True)
class Origin:
    """What a scene is called, and what it was read from."""

    file: str  # named in errors
    clip_id: str
    dataset: str
    log_id: str
    split: str
    licence: str
    content_digest: str
    frame_tokens: tuple[str, str] | None


def no_road(frame: Frame) -> RoadAhead:
    """Where there are no maps: the route is known by its roadblocks alone."""
    route = Route((), frame.roadblock_ids, frozenset())
    return RoadAhead(RoadMap({}, (), location=frame.map_location), route, np.zeros((0, 3)))


def scene_of(frames: Sequence[Frame], road: RoadAhead, origin: Origin, driven: int | None = None) -> Scene:
    """The scene at T of 4 to 12 frames that are 0.5 s apart; the ego is known in the first `driven`, None: in all."""
    assert HISTORY_FRAMES <= len(frames) <= SCENE_FRAMES
    states, space = ego_states(frames[:driven]), world_from_ego(frames[:driven])
    known = len(states)
    after = ((0, CLIP_STEPS - known), (0, 0))
    clip = Clip(
        clip_id=origin.clip_id,
        dataset=origin.dataset,
        log_id=origin.log_id,
        split=origin.split,
        start_s=0.0,
        ego_states=np.pad(states, after, constant_values=np.nan).reshape(CLIP_STEPS, EGO_STATE_SIZE),
        world_from_ego=np.concatenate([space, np.repeat(space[-1:], CLIP_STEPS - known, axis=0)]),
        agents=_agents(frames),
        road_map=road.road_map,
        route=road.route,
        centerline=road.centerline,
        lights=_lights(frames, tuple(road.road_map.lanes)),
        licence=origin.licence,
        frame_tokens=origin.frame_tokens,
        content_digest=origin.content_digest,
    )
    return scene_of_clip(clip)


def _agents(frames: Sequence[Frame]) -> AgentTracks:
    """96 steps; those after the last frame are of a window that nobody annotated, and nobody is there."""
    unseen = replace(frames[-1], boxes=None)
    agents = window_agents([*frames, *[unseen] * (WINDOW_FRAMES - len(frames))])
    parts = {name: getattr(agents, name).copy() for name in PER_STEP}
    for name, part in parts.items():
        part[n_steps(len(frames)) :] = False if name == "valid" else np.nan
    return replace(agents, **parts)


def _lights(frames: Sequence[Frame], lane_ids: Sequence[str]) -> TrafficLights:
    """96 steps, unknown after the last frame."""
    found = lights(frames, lane_ids)
    after = ((0, CLIP_STEPS - len(found.states)), (0, 0))
    return replace(found, states=np.pad(found.states, after, constant_values=LightState.UNKNOWN))


def world_columns(scene: Scene, command: str) -> dict[str, object]:
    """A row's columns but label, scores, pictures, vocabulary labels and bookkeeping; command: as the log says it."""
    return scene_columns(scene, scene.agents, scene.clip.world_from_ego[NOW], command)


def logged_label(scene: Scene) -> dict[str, object]:
    """The columns that hold the drive from T on, of a scene whose 12 frames hold it."""
    states = scene.clip.ego_states[NOW : NOW + HORIZON_STEPS + 1]
    return {**label_columns_of(scene, states[1:, : HEADING + 1]), "parent_states": states[[0, HORIZON_STEPS]]}


def label_columns_of(scene: Scene, poses: Array) -> dict[str, object]:
    """The columns of a drive (40, 3) from T on, world frame."""
    label = to_local(scene.ego_state[: HEADING + 1], poses)
    return {"label_10hz": label, "label_2hz": label[COARSE_STEPS - 1 :: COARSE_STEPS]}


def pictures(frames: Sequence[Frame], folder: Path, source: ImageSource, file: str) -> dict[str, object]:
    """The columns of the pictures of frames that end now: the files' own bytes but for Exif, with the rig of now.

    Raises BadClip. file: whose frames they are, named where they have none.
    """
    images = blobs_of(frames, folder).images
    if not images:
        raise BadClip(file, "cams", f"none of its pictures is in {folder}; pictures=false imports it without")
    now_s = (len(frames) - 1) * COARSE_STEPS * STEP_S
    rig = {camera.name: camera for camera in rig_of(frames[-1], images, file)}
    return {
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": camera.intrinsics.ravel(),
                "distortion": camera.distortion,
                "ego_from_camera": camera.ego_from_camera.ravel(),
            }
            for camera in rig.values()
        ],
        "images": [
            {
                "camera": image.sensor,
                "time_s": image.time_s - now_s,
                "ego_pose": image.world_from_ego.ravel(),
                "jpeg": _jpeg(Path(image.uri), rig[image.sensor]),
            }
            for image in images
        ],
        "image_source": str(source),
    }


def _jpeg(path: Path, camera: Camera) -> bytes:
    """A whole file, without Exif. Raises BadClip where it is no JPEG of the camera's size or is cut off."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadClip(str(path), "image", f"cannot be read: {error.strerror}") from error
    try:
        refuse_size(jpeg_size(data), (camera.width, camera.height), camera.name)
    except BadPicture as error:
        raise BadClip(str(path), error.field, str(error)) from error
    if b"\xff\xd9" not in data[-64:]:
        raise BadClip(str(path), "image", f"{len(data)} bytes that are no whole JPEG")
    return without_exif(data)
