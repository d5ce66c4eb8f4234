"""One nuScenes keyframe: a scene from six photos of one instant and one sweep, drawn by its six cameras."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from factory.readers.pickles import load_plain
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.build import AssetSettings, build_asset
from tasks.render.scene.engine import NOBODY, render, vehicles_at
from tasks.render.scene.sensed import Photo, Sweep
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.camera import Pinhole

SIZE = (400, 225)  # a quarter of the photos' sides
LEAST_DB = 20.0
KINDS = {7: AgentKind.PEDESTRIAN, 5: AgentKind.BICYCLE, 6: AgentKind.BICYCLE}  # the others up to 4 are vehicles
Array = NDArray[np.float64]


def pose(rows: Any) -> Array:
    return np.array(rows, np.float64).reshape(4, 4)


def read_frame(folder: Path) -> tuple[list[Photo], Sweep, AgentTracks]:
    """The photos at SIZE, the sweep, and the annotated boxes of what can move, as they stand.

    `lidar2cam` already holds how far the ego drove between the sweep and the photo, `cam2ego` does not.
    """
    path = next(folder.glob("*.pkl"))
    frame = load_plain(path.read_bytes(), str(path))["data_list"][0]
    world_from_ego, ego_from_lidar = pose(frame["ego2global"]), pose(frame["lidar_points"]["lidar2ego"])
    world_from_lidar = world_from_ego @ ego_from_lidar
    photos = []
    for name, view in frame["images"].items():
        image = cv2.imread(str(folder / view["img_path"]))
        scale = np.diag([SIZE[0] / image.shape[1], SIZE[1] / image.shape[0], 1.0])
        intrinsics = scale @ np.array(view["cam2img"], np.float64)
        rgb = np.ascontiguousarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)[..., ::-1])
        world_from_camera = world_from_lidar @ np.linalg.inv(pose(view["lidar2cam"]))
        photos.append(Photo(name, 0.0, rgb, intrinsics, world_from_camera))
    points = np.fromfile(folder / frame["lidar_points"]["lidar_path"], np.float32).reshape(-1, 5)[:, :3]
    in_ego = points @ ego_from_lidar[:3, :3].T + ego_from_lidar[:3, 3]
    return photos, Sweep(0.0, in_ego.astype(np.float32), world_from_ego), boxes(frame["instances"], world_from_lidar)


def boxes(instances: list[dict[str, Any]], world_from_lidar: Array) -> AgentTracks:
    movable = [one for one in instances if one["bbox_label_3d"] <= 7]
    stated = np.array([one["bbox_3d"] for one in movable])  # x, y, z of the centre, length, width, height, yaw
    centres = stated[:, :3] @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]
    along = np.stack([np.cos(stated[:, 6]), np.sin(stated[:, 6]), 0 * stated[:, 6]], 1) @ world_from_lidar[:3, :3].T
    heading = np.arctan2(along[:, 1], along[:, 0])
    n = len(movable)
    return AgentTracks(
        tuple(f"box {i}" for i in range(n)),
        tuple(KINDS.get(one["bbox_label_3d"], AgentKind.VEHICLE) for one in movable),
        np.column_stack([centres[:, :2], heading, stated[:, 3:5]])[None],
        np.zeros((1, n, 2)),
        np.ones((1, n), bool),
        centres[None, :, 2],
        stated[:, 5],
    )


def quality(asset: RenderAsset, photos: list[Photo], agents: AgentTracks) -> dict[str, float]:
    """PSNR [dB] of every input photo, with the vehicles where they stood."""
    cameras = [Pinhole(photo.intrinsics, photo.world_from_camera, *SIZE) for photo in photos]
    views = render(asset, cameras, vehicles_at(agents, 0.0))
    return {photo.camera: psnr(photo.rgb / 255.0, view.rgb) for photo, view in zip(photos, views)}


@pytest.fixture(scope="module")
def frame(shared_root: Path) -> tuple[list[Photo], Sweep, AgentTracks]:
    return read_frame(shared_root / "data" / "nuscenes_frame")


@pytest.fixture(scope="module")
def asset(frame: tuple[list[Photo], Sweep, AgentTracks]) -> RenderAsset:
    photos, sweep, agents = frame
    return build_asset(photos, [sweep], agents, AssetSettings(hold_out_every=0))


def test_the_six_photos_come_out_of_the_scene_made_of_them(
    frame: tuple[list[Photo], Sweep, AgentTracks], asset: RenderAsset
) -> None:
    found = quality(asset, frame[0], frame[2])
    assert len(found) == 6
    assert min(found.values()) > LEAST_DB, found  # 23.3 (front) to 30.4 (back)


def test_the_cars_are_nodes_of_their_own_and_gone_without_their_boxes(
    frame: tuple[list[Photo], Sweep, AgentTracks], asset: RenderAsset
) -> None:
    photos, _, agents = frame
    assert len(asset.nodes) > 10
    front = next(photo for photo in photos if photo.camera == "CAM_FRONT")
    camera = Pinhole(front.intrinsics, front.world_from_camera, *SIZE)
    with_all, with_none = (render(asset, [camera], who)[0] for who in (vehicles_at(agents, 0.0), NOBODY))
    changed = np.abs(with_all.rgb - with_none.rgb).max(axis=-1) > 0.1
    assert 0.01 < changed.mean() < 0.2  # a lorry ahead to the left, a few cars; the rest of the street stays
