"""Where photos say that the road lies higher than the log has it, drives and boxes stand on it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.stages.assets import photo_poses
from factory.stages.scene_file import read_scene, write_scene
from tasks.render.scene.asset import RenderAsset, photo_rises
from tasks.render.scene.movers import lift_tracks
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import EMPTY
from tasks.world.clip import AgentKind, AgentTracks, SensorFile
from tasks.world.frames import EGO_STATE_SIZE, X, pose_on_ground

STEPS = 21
PARKED = AgentTracks(
    ("parked",), (AgentKind.VEHICLE,), np.zeros((STEPS, 1, 5)), np.zeros((STEPS, 1, 2)), np.ones((STEPS, 1), bool),
    np.full((STEPS, 1), 0.8), np.array([1.6]),
)  # fmt: skip


def pose(x: float, z: float) -> np.ndarray:
    out = np.eye(4)
    out[0, 3], out[2, 3] = x, z
    return out


def climbing() -> RenderAsset:
    """Logged in the plane; photos at 0, 1 and 2 s, 5 m apart, say that it climbs by 0.4 m a photo."""
    given = [SensorFile("front", "", float(k), pose(5.0 * k, 0.0)) for k in range(3)]
    used = [replace(file, world_from_ego=pose(5.0 * k, 0.4 * k)) for k, file in enumerate(given)]
    sky = SkyMap(np.zeros((ROWS, COLUMNS, 3), np.float32))
    return RenderAsset(np.zeros(3), EMPTY, {}, sky, 30.0, taken=photo_poses(given, [used[2], used[0], used[1]]))


def test_a_drive_beside_the_log_s_is_as_high_as_the_photos_were() -> None:
    logged = np.stack([pose(x, 0.0) for x in np.linspace(0.0, 10.0, STEPS)])
    states = np.zeros((3, EGO_STATE_SIZE))
    states[:, X] = [0.2, 5.1, 9.0]
    assert pose_on_ground(climbing().on_road(logged), states)[:, 2, 3] == pytest.approx([0.0, 0.4, 0.8])
    assert (replace(climbing(), taken=()).on_road(logged) == logged).all()


def test_boxes_rise_with_the_road_and_stay_where_they_are() -> None:
    higher = climbing().lifted(PARKED, first_s=0.0)
    assert higher.center_z[:, 0] == pytest.approx(0.8 + 0.04 * np.arange(STEPS))
    assert (higher.boxes == PARKED.boxes).all()
    later = climbing().lifted(PARKED, first_s=1.0)
    assert later.center_z[:, 0] == pytest.approx(np.minimum(0.8 + 0.4 + 0.04 * np.arange(STEPS), 1.6))
    assert lift_tracks(PARKED, *photo_rises(())) is PARKED


def test_a_scene_file_keeps_how_much(tmp_path: Path) -> None:
    scene = climbing()
    write_scene(tmp_path / "scene.safetensors", scene)
    assert read_scene(tmp_path / "scene.safetensors").taken[0].rise_m == pytest.approx(0.8)
