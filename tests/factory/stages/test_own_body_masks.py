"""Masks of the own body as files: read, refused by name, part of what a scene is made of."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.stages.scene_file import read_scene, write_scene
from factory.stages.sensors import masks_digest, read_masks, refuse_unknown_masks, resized_mask
from tasks.render.rig.correct import movable_mask
from tasks.render.scene.asset import OwnBody, RenderAsset
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import EMPTY
from tasks.world.clip import Camera, SensorFile
from tests.factory.data_folders import add_companions

K = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
FRONT = np.array([[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera("back", 96, 64, K, np.zeros(5), FRONT)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    mask = np.zeros((64, 96), np.uint8)
    mask[48:] = 255
    cv2.imwrite(str(tmp_path / "back.png"), mask)
    return tmp_path


def test_white_is_the_body_and_a_camera_without_a_file_sees_none(folder: Path) -> None:
    digest = masks_digest(str(folder))
    add_companions(folder)
    assert masks_digest(str(folder)) == digest
    masks = read_masks(str(folder), [CAMERA, replace(CAMERA, name="front")])
    assert list(masks) == ["back"]
    assert masks["back"][48:].all() and not masks["back"][:48].any()
    small = resized_mask(masks["back"], CAMERA, 48, 32)
    assert small[24:].all() and not small[:24].any()


def test_a_mask_goes_through_the_lens_as_its_photos_do(folder: Path) -> None:
    """Barrel distortion shows more: straightened, what lies at the edge is cut off and the body is lower."""
    bent = replace(CAMERA, distortion=np.array([-0.2, 0.0, 0.0, 0.0, 0.0]))
    mask = read_masks(str(folder), [bent])["back"]
    assert resized_mask(mask, bent, 96, 64).sum(axis=0)[2] < mask.sum(axis=0)[2]


def test_what_is_wrong_is_told_by_file(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"back\.png is 96x64, but its camera takes 192x128"):
        read_masks(str(folder), [replace(CAMERA, width=192, height=128)])
    with pytest.raises(ValueError, match="no camera back; this rig has front"):
        refuse_unknown_masks(str(folder), [replace(CAMERA, name="front")])
    with pytest.raises(ValueError, match=r"holds no <camera>\.png"):
        masks_digest(str(folder / "nowhere"))
    (folder / "back.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"back\.png is not a JPEG or PNG picture"):
        read_masks(str(folder), [CAMERA])


def test_another_mask_is_another_scene(folder: Path) -> None:
    before = masks_digest(str(folder))
    cv2.imwrite(str(folder / "back.png"), np.zeros((64, 96), np.uint8))
    assert masks_digest(str(folder)) != before != "" == masks_digest("")


def test_no_corner_is_looked_for_on_it(folder: Path) -> None:
    mask = read_masks(str(folder), [CAMERA])["back"]
    hidden = movable_mask(None, CAMERA, SensorFile("back", "", 0.0, np.eye(4)), mask)
    assert hidden is not None and (hidden == mask).all()


def test_a_scene_file_keeps_it(tmp_path: Path) -> None:
    sky = SkyMap(np.zeros((ROWS, COLUMNS, 3), np.float32))
    rgba = np.arange(4 * 6 * 4, dtype=np.uint8).reshape(4, 6, 4)
    plain = RenderAsset(np.zeros(3), EMPTY, {}, sky, 30.0)
    whole = write_scene(tmp_path / "scene.safetensors", replace(plain, bodies=(OwnBody("back", rgba),)))
    back = read_scene(tmp_path / "scene.safetensors")
    assert back.own_body("front") is None and back.digest == whole.digest
    body = back.own_body("back")
    assert body is not None and (body.rgba == rgba).all()
    assert write_scene(tmp_path / "plain.safetensors", plain).digest != whole.digest
