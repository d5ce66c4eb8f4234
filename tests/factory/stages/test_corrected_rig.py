"""From pictures on disk to a corrected rig: a street with printed walls, two cameras, seven instants."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_street import CAMERAS, ROAD_M, WIDTH, photographed

from factory.readers.base import BadClip
from factory.stages.assets import RIG_SUFFIX, correct_block_rig, needs_rig_correction, read_or_correct_rig
from tasks.render.rig.adjust import motions_of_twists, twists_of
from tasks.render.rig.correct import estimate_ground_height
from tasks.render.scene.asset import PhotoPose, RenderAsset
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sky import SkyMap
from tasks.render.settings import Adjust, RigSettings
from tasks.render.splatting.gaussians import EMPTY
from tasks.world.clip import Block, Camera, SensorFile


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Block:
    return photographed(tmp_path_factory.mktemp("photos"))


def turned(one: Camera, turn_deg: tuple[float, float, float]) -> Camera:
    motion = motions_of_twists(np.array([[0.0, 0.0, 0.0, *np.radians(turn_deg)]]))[0]
    return replace(one, ego_from_camera=one.ego_from_camera @ motion)


@pytest.mark.slow
def test_a_turned_camera_is_put_right_told_and_drawn_with(
    block: Block, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = (CAMERAS[0], turned(CAMERAS[1], (1.0, -1.5, 0.8)))
    with caplog.at_level(logging.INFO):
        same, found, correction = correct_block_rig(tmp_path / "block-1.safetensors", block, said)
    assert correction is not None and len(same.images) == len(block.images)
    # What both cameras are turned by is the ego's frame as well, which photos do not know.
    true, now = (np.linalg.inv(rig[0].ego_from_camera) @ rig[1].ego_from_camera for rig in (CAMERAS, found))
    (twist,) = twists_of((np.linalg.inv(true) @ now)[None])
    assert np.degrees(np.linalg.norm(twist[3:])) < 0.35  # 0.30
    told = json.loads((tmp_path / f"block-1{RIG_SUFFIX}").read_text())
    by_name = {row["camera"]: row for row in told["cameras"]}
    assert by_name["left"]["after_px"] < 0.5 < by_name["left"]["before_px"]
    assert told["used"][1]["ego_from_camera"] == found[1].ego_from_camera.tolist()
    assert "left: moved" in caplog.text
    path = tmp_path / f"block-1{RIG_SUFFIX}"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"after_px", b"aftfr_px", 1))
    read_or_correct_rig(tmp_path / "block-1.safetensors", block, said)
    assert path.read_bytes() == whole and f"{path}: its checksum" in caplog.text and "written again" in caplog.text
    asset = RenderAsset(np.zeros(3), EMPTY, {}, SkyMap(np.zeros((2, 2, 3), np.float32)), 30.0, rig=found)
    assert asset.as_corrected([said[1]]) == (found[1],)
    assert replace(asset, rig=()).as_corrected([said[1]]) == (said[1],)


def test_photos_are_looked_at_from_where_the_scene_says_that_they_were_taken(block: Block) -> None:
    """Else a vehicle, fitted at corrected poses, is held against a photo that is decimetres off; and photos that the
    scene left out are not looked at."""
    moved = np.eye(4)
    moved[0, 3] = 0.4
    taken = [PhotoPose(file.sensor, file.time_s, moved @ file.world_from_ego) for file in block.images[2:]]
    asset = RenderAsset(np.zeros(3), EMPTY, {}, SkyMap(np.zeros((2, 2, 3), np.float32)), 30.0, taken=tuple(taken))
    found = asset.photos_of(block.images)
    assert [file.uri for file in found] == [file.uri for file in block.images[2:]]
    for file, given in zip(found, block.images[2:]):
        np.testing.assert_allclose(file.world_from_ego[:3, 3] - given.world_from_ego[:3, 3], [0.4, 0.0, 0.0])
    assert replace(asset, taken=()).photos_of(block.images) == block.images


@pytest.mark.slow
def test_swapped_files_are_left_out_and_named(block: Block, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    images = list(block.images)
    a, b = 6, 7  # both cameras at one instant
    images[a], images[b] = replace(images[a], uri=images[b].uri), replace(images[b], uri=images[a].uri)
    swapped = replace(block, images=tuple(images))
    kept, _, correction = correct_block_rig(tmp_path / "block-2.safetensors", swapped, CAMERAS)
    assert correction is not None and correction.strangers == (a, b)
    assert len(kept.images) == len(images) - 2 and images[a].uri in caplog.text


def test_a_photo_of_another_size_than_its_camera_s_is_named(block: Block, tmp_path: Path) -> None:
    said = (replace(CAMERAS[0], width=WIDTH + 8), CAMERAS[1])
    with pytest.raises(BadClip, match=r"front_0\.png"):
        correct_block_rig(tmp_path / "block-3.safetensors", block, said)


def test_by_default_blocks_without_lidar_are_corrected(block: Block) -> None:
    sweep = SensorFile("lidar", "0.feather", 0.0, np.eye(4))
    with_lidar = replace(block, sweeps=(sweep,))
    assert needs_rig_correction(block, RigSettings()) and not needs_rig_correction(with_lidar, RigSettings())
    assert needs_rig_correction(with_lidar, RigSettings(adjust=Adjust.ON)) and not needs_rig_correction(
        block, RigSettings(adjust=Adjust.OFF)
    )
    assert not needs_rig_correction(replace(block, images=()), RigSettings(adjust=Adjust.ON))


@pytest.mark.slow
def test_the_road_is_found_where_it_is(block: Block) -> None:
    rig = {one.name: one for one in CAMERAS}
    photos = [
        Photo(file.sensor, file.time_s, cv2.imread(file.uri), rig[file.sensor].intrinsics,
              file.world_from_ego @ rig[file.sensor].ego_from_camera)
        for file in block.images
    ]  # fmt: skip
    poses = np.stack([file.world_from_ego for file in block.images])
    assert estimate_ground_height(photos, poses) == pytest.approx(ROAD_M, abs=0.03)
    grey = [replace(photo, rgb=np.full_like(photo.rgb, 90)) for photo in photos]
    assert estimate_ground_height(grey, poses) is None
