"""What a sample's row says of the cameras that took or draw its pictures, where the photos corrected the rig."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_street import CAMERAS, photographed

from factory.stages.assets import RIG_SUFFIX, CorrectedRig, photo_poses, read_or_correct_rig
from factory.stages.imaging import Imaging, height_columns
from factory.stages.sensors import load_photos
from factory.store.reader import decode_stored_image
from tasks.attempt import Judged, drive_under_log_replay
from tasks.caches import parse_json_with_checksum
from tasks.experts.protocol import Human
from tasks.perturb import Candidate
from tasks.render.rig.adjust import motions_of_twists, twists_of
from tasks.render.settings import Adjust, RenderSettings, RigSettings, SceneFrom
from tasks.world.clip import NOW, STEP_S, Camera, Clip, SensorFile, scene_of_clip
from tests.tasks.streets import street_clip

LATER_S = 0.5  # the clip begins so long after its block
SETTINGS = RenderSettings(width=200, height=112, scene=SceneFrom.DISCS, jpeg_quality=100)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A window of a printed street whose left camera is said to look 2 degrees elsewhere, with a lens it has not."""
    block = photographed(tmp_path_factory.mktemp("photos"))
    motion = motions_of_twists(np.array([[0.0, 0.0, 0.0, *np.radians([1.0, -1.5, 0.8])]]))[0]
    left = replace(CAMERAS[1], ego_from_camera=CAMERAS[1].ego_from_camera @ motion)
    street = street_clip()
    images = tuple(replace(file, time_s=file.time_s - LATER_S) for file in block.images if file.time_s >= LATER_S)
    block = replace(block, start_s=street.start_s - LATER_S)
    return replace(street, cameras=(CAMERAS[0], left), images=images, block=block)


@pytest.fixture(scope="module")
def judged(clip: Clip) -> Judged:
    return drive_under_log_replay(scene_of_clip(clip), Human(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def human(clip: Clip, judged: Judged, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The human sample's columns, and the folder that the corrected rig is kept in."""
    folder = tmp_path_factory.mktemp("imaged")
    row = Imaging(SETTINGS, str(folder)).pictures([(clip, None, judged)])[0]
    assert not list(folder.glob("*.safetensors")), "the rig alone is enough for it"
    return folder, dict(row)


def stored(camera: Camera, row: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and mount that a row has of a camera."""
    (mine,) = (one for one in row["cameras"] if one["name"] == camera.name)
    return np.reshape(mine["intrinsics"], (3, 3)), np.reshape(mine["ego_from_camera"], (4, 4))


@pytest.mark.slow
def test_photos_and_pictures_of_a_corrected_block_have_one_calibration_the_one_the_photos_ask_for(
    clip: Clip, judged: Judged, human: tuple[Path, dict[str, Any]]
) -> None:
    folder, row = human
    candidate = Candidate(0, np.zeros(3), (0, 0), 1.0, 1.0, judged.scores, judged.rollout)
    simulated = Imaging(SETTINGS, str(folder)).pictures([(clip, candidate, judged)])[0]
    assert (row["image_source"], simulated["image_source"]) == ("photo", "render")
    for camera in clip.cameras:
        for a, b in zip(stored(camera, row), stored(camera, simulated)):
            np.testing.assert_array_equal(a, b)
    # And it is what the photos were taken with: the left camera as the front one has it.
    (front, left), true = (stored(camera, row)[1] for camera in clip.cameras), CAMERAS
    apart = np.linalg.inv(true[0].ego_from_camera) @ true[1].ego_from_camera
    (twist,) = twists_of((np.linalg.inv(apart) @ np.linalg.inv(front) @ left)[None])
    assert np.degrees(np.linalg.norm(twist[3:])) < 0.35 < 1.97


@pytest.mark.slow
def test_photos_are_cut_by_the_camera_and_stand_at_the_poses_that_the_rig_s_file_says(
    clip: Clip, judged: Judged, human: tuple[Path, dict[str, Any]]
) -> None:
    folder, row = human
    (said,) = folder.glob(f"block-*{RIG_SUFFIX}")
    told = parse_json_with_checksum(said.read_bytes())
    used = {one["name"]: {key: np.array(value) for key, value in one.items() if key != "name"} for one in told["used"]}
    cameras = [replace(camera, **used[camera.name]) for camera in clip.cameras]  # type: ignore[arg-type]
    taken = {(camera, round(time_s, 3)): pose for camera, time_s, _, pose in told["taken"]}
    assert len(taken) == len(clip.block.images)  # type: ignore[union-attr]
    now_s = NOW * STEP_S
    for image in row["images"]:
        at_s = now_s + image["time_s"]
        np.testing.assert_array_equal(image["ego_pose"], taken[image["camera"], round(at_s + LATER_S, 3)])
        (file,) = (f for f in clip.images if f.sensor == image["camera"] and abs(f.time_s - at_s) < 1e-6)
        (photo,) = load_photos([file], cameras, SETTINGS.width, SETTINGS.height)
        assert np.abs(decode_stored_image(image).astype(float) - photo.rgb).mean() < 1.0  # JPEG
        off = decode_stored_image(image).astype(float) - photo.rgb
        assert np.abs(off @ [0.299, 0.587, 0.114]).mean() < 1.0  # JPEG, which halves the size of colours
    again = Imaging(SETTINGS, str(folder)).pictures([(clip, None, judged)])[0]
    assert json.dumps(again["cameras"], default=list) == json.dumps(row["cameras"], default=list)


def test_with_the_rig_left_alone_photos_have_the_log_s_calibration(clip: Clip, judged: Judged, tmp_path: Path) -> None:
    settings = replace(SETTINGS, rig=RigSettings(adjust=Adjust.OFF))
    row = Imaging(settings, str(tmp_path)).pictures([(clip, None, judged)])[0]
    for camera in clip.cameras:
        np.testing.assert_array_equal(stored(camera, row)[1], camera.ego_from_camera)
    poses = {(file.sensor, round(file.time_s, 3)): file.world_from_ego for file in clip.images}
    for image in row["images"]:  # type: ignore[attr-defined]
        at = image["camera"], round(image["time_s"] + NOW * STEP_S, 3)
        np.testing.assert_array_equal(np.reshape(image["ego_pose"], (4, 4)), poses[at])
    assert "world_from_ego" not in row and not list(tmp_path.iterdir())


def test_ego_and_agents_rise_together_with_the_road_that_photos_show() -> None:
    """So that boxes lie in the pictures where the vehicles do; in the plane all is where it was."""
    scene = scene_of_clip(street_clip())
    given = [SensorFile("front", "", 0.5 * k, scene.clip.world_from_ego[5 * k]) for k in range(19)]
    used = []
    for k, file in enumerate(given):
        higher = file.world_from_ego.copy()
        higher[2, 3] += 0.3 + 0.02 * k
        used.append(replace(file, world_from_ego=higher))
    rig = CorrectedRig((), photo_poses(given, used))
    found = height_columns(scene, rig.on_road(), rig.lifted(scene.agents, 0.0))
    place, z = np.asarray(found["world_from_ego"]), np.asarray(found["agent_center_z"])
    now = scene.clip.world_from_ego[NOW]
    rise = place[2, 3] - now[2, 3]
    assert rise == pytest.approx(0.36, abs=0.011)  # that of the photo nearest to now
    np.testing.assert_allclose(place[:2, 3], now[:2, 3])
    window = scene.agents.window(NOW - 15, NOW + 41)
    seen = window.valid.any(axis=0)
    rises = np.where(window.valid[:, seen].T, z - window.center_z[:, seen].T, np.nan)
    assert np.isfinite(rises[:, [0, 15]]).any(axis=0).all()
    np.testing.assert_allclose(np.nanmin(rises[:, 15]), 0.36, atol=1e-6)
    np.testing.assert_allclose(np.nanmax(rises[:, 15]), 0.36, atol=1e-6)
    np.testing.assert_allclose(np.nanmax(rises[:, 0]), 0.3, atol=1e-6)


@pytest.mark.slow
def test_what_photos_say_of_a_rig_is_found_once_also_where_it_is_nothing(clip: Clip, tmp_path: Path) -> None:
    block = clip.block
    assert block is not None
    alone = replace(block, images=block.images[:1])  # nothing to compare it with
    path = tmp_path / "block-1.safetensors"
    assert read_or_correct_rig(path, alone, clip.cameras) is None
    gone = replace(block, images=(replace(block.images[0], uri=str(tmp_path / "gone.png")),))
    assert read_or_correct_rig(path, gone, clip.cameras) is None, "the photo is not opened again"
