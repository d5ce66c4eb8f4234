"""A served scene as the file by which AlpaSim's runtime lists scenes: a `.usdz`, a zip, without anything to draw.

Of what NVlabs/alpasim 9177bd0 reads of one (src/utils/alpasim_utils/artifact.py, scenario.py): the ego's and the
tracks' poses in `local`, when cameras took their pictures, the ego's box, the map, whose frame is `local` as well.
"""

import io
import json
import uuid
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factory import __version__
from factory.alpasim.opendrive import opendrive
from factory.alpasim.scenes import Scenes, ServedScene
from factory.alpasim.wire import Fault
from factory.files import atomic_file
from tasks.render.scene.movers import ever_moves, world_from_boxes
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S
from tasks.world.frames import PACIFICA, pose_on_ground

EGO_HEIGHT_M = 1.777  # of nuPlan's Pacifica (nuplan-devkit, vehicle_parameters.py)
FRAME_EVERY, SHUTTER_US = 5, 17_000  # steps between a camera's pictures, and how long one takes
WRITTEN = (2026, 1, 1, 0, 0, 0)  # in the zip, so that the same scene is the same bytes


def usdz(scene_id: str, scene: ServedScene) -> bytes:
    """The file's bytes. Raises ValueError for a scene of photos, whose ego is known at these alone."""
    if scene.clip is None:
        raise ValueError(f"{scene_id}: a scene of photos is no drive that AlpaSim's runtime can list")
    poses = pose_on_ground(scene.on_road, scene.clip.ego_states)
    poses[:, :3, 3] -= scene.origin
    stamps = _stamps(range(len(poses)))
    frames = [[stamp, stamp + SHUTTER_US] for stamp in stamps[:-1:FRAME_EVERY]]
    size = [PACIFICA.length, PACIFICA.width, EGO_HEIGHT_M]
    middle = [PACIFICA.rear_axle_to_center, 0.0, EGO_HEIGHT_M / 2.0]
    world_to_local = np.eye(4)
    world_to_local[:3, 3] = -scene.origin
    rig = {
        "world_to_nre": {"matrix": world_to_local.tolist()},
        "T_world_base": np.eye(4).tolist(),  # the map names no place on earth, so it is taken as it stands
        "camera_calibrations": {camera.name: {"logical_sensor_name": camera.name} for camera in scene.cameras},
        "rig_trajectories": [
            {
                "sequence_id": scene_id,
                "T_rig_world_timestamps_us": stamps,
                "T_rig_worlds": poses.tolist(),
                "cameras_frame_timestamps_us": {camera.name: frames for camera in scene.cameras},
                "rig_bbox": {"centroid": middle, "dim": size, "rot": [0.0, 0.0, 0.0]},
            }
        ],
    }
    names = [camera.name for camera in scene.cameras]
    metadata = {
        "scene_id": scene_id,
        "version_string": f"driving-data-factory {__version__}",
        "training_date": "",
        "dataset_hash": scene.asset.digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_OID, f"{scene_id} {scene.asset.digest}")),
        "is_resumable": False,
        "sensors": {"camera_ids": names, "lidar_ids": []},
        "logger": {},
        "time_range": {"start": 0.0, "end": 1e-6 * stamps[-1]},
    }
    files: dict[str, str | bytes] = {
        "metadata.yaml": json.dumps(metadata),  # JSON is YAML
        "rig_trajectories.json": json.dumps(rig),
        "sequence_tracks.json": json.dumps({scene_id: _tracks(scene)}),
        "map.xodr": opendrive(scene.clip.road_map, scene.origin),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as packed:
        for name, content in files.items():
            packed.writestr(zipfile.ZipInfo(name, WRITTEN), content)
    return buffer.getvalue()


def write_artifacts(scenes: Scenes, folder: Path) -> None:
    """A file for each scene. Raises ValueError as `usdz`, and for a scene that cannot be read, and OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for scene_id in scenes.ids:
        try:
            data = usdz(scene_id, scenes.find("scene", scene_id))
        except Fault as error:
            raise ValueError(str(error)) from error
        with atomic_file(folder / f"{scene_id}.usdz", len(data)) as draft:
            draft.write_bytes(data)


def _tracks(scene: ServedScene) -> dict[str, object]:
    """Of those that are there at two instants: AlpaSim smooths tracks, which takes as many."""
    agents, moving = scene.agents, ever_moves(scene.agents)
    rows = [j for j in range(len(agents)) if agents.valid[:, j].sum() > 1]
    stamps, poses, sizes = [], [], []
    for j in rows:
        there = np.flatnonzero(agents.valid[:, j])
        x, y, heading, length, width = agents.boxes[there, j].T
        height = np.full(len(there), agents.heights[j])
        boxes = np.column_stack([x, y, agents.center_z[there, j], heading, length, width, height])
        stamps.append(_stamps(there.tolist()))
        poses.append(_as_rows(world_from_boxes(boxes), scene.origin))
        sizes.append([float(length[0]), float(width[0]), float(height[0])])
    tracks = {
        "tracks_id": [agents.track_ids[j] for j in rows],
        "tracks_label_class": [agents.kinds[j].lower() for j in rows],
        "tracks_flags": [["CONTROLLABLE"] if moving[j] else [] for j in rows],
        "tracks_timestamps_us": stamps,
        "tracks_poses": poses,
    }
    return {"tracks_data": tracks, "cuboidtracks_data": {"cuboids_dims": sizes}}


def _as_rows(poses: Array, origin: Array) -> list[list[float]]:
    """x, y, z in `local`, then a quaternion x, y, z, w, of world poses (F, 4, 4)."""
    turned = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows: list[list[float]] = np.concatenate([poses[:, :3, 3] - origin, turned], axis=1).tolist()
    return rows


def _stamps(steps: Iterable[int]) -> list[int]:
    return [round(1e6 * STEP_S * step) for step in steps]
