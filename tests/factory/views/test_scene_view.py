"""A scene in the browser: what the server offers, and where drives and boxes stand in it."""

import re
import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factory.stages.scene_file import write_scene
from factory.views.scene_view import ABOVE_ROAD_M, EDGES, drive_of
from tasks.world.frames import to_world
from tests.factory.stages.test_scene_file import scene
from tests.tasks.render.splatting.test_ply import some

ORIGIN = np.array([600_000.0, 4_000_000.0, 30.0])
NOW = np.array([600_010.0, 4_000_020.0, np.pi / 2])  # heads along y


def row(**values: Any) -> dict[str, Any]:
    """A simulated sample 10 m right and 20 m up of the scene's zero, its road 1 m above it; a car 5 m ahead."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (*NOW[:2], 31.0)
    driven = np.zeros((41, 11))
    driven[:, 0], driven[:, 1] = NOW[0], NOW[1] + np.linspace(-20.0, 0.0, 41)
    boxes = np.zeros((2, 56, 5), np.float32)
    boxes[:, :, 0], boxes[:, :, 3], boxes[:, :, 4] = 5.0, 4.5, 1.9
    valid = np.ones((2, 56), bool)
    valid[1, 15] = False
    jpeg = cv2.imencode(".jpg", np.zeros((90, 160, 3), np.uint8))[1].tobytes()
    return {
        "attempt_id": "0123",
        "expert": "recovery",
        "round": 2,
        "now_pose": NOW,
        "world_from_ego": pose.ravel(),
        "perturbed_states": driven,
        "label_10hz": np.column_stack([np.arange(1, 41) * 0.5, np.zeros((40, 2))]),
        "agent_ids": ["a", "gone"],
        "agent_boxes": boxes,
        "agent_center_z": np.full((2, 56), 31.8, np.float32),
        "agent_heights": np.array([1.6, 1.6], np.float32),
        "agent_valid": valid,
        "cameras": [
            {"name": "front", "intrinsics": [100.0, 0, 80, 0, 100.0, 45, 0, 0, 1], "ego_from_camera": np.eye(4)}
        ],
        "images": [
            {"camera": "front", "time_s": 0.0, "ego_pose": pose.ravel(), "jpeg": jpeg},
            {"camera": "front", "time_s": -0.5, "ego_pose": pose.ravel(), "jpeg": jpeg},
        ],
    } | values


def test_a_drive_stands_in_the_scene_s_frame_above_its_road() -> None:
    drive = drive_of(row(), ORIGIN)
    assert drive.perturbed is not None
    np.testing.assert_allclose(drive.perturbed[0], [10.0, 0.0, 1.0 + ABOVE_ROAD_M])
    np.testing.assert_allclose(drive.label[[0, -1]], [[10.0, 20.0, 1.1], [10.0, 40.0, 1.1]])
    assert list(drive.boxes) == ["a"]  # the other one is not there now
    np.testing.assert_allclose(drive.boxes["a"], [10.0, 25.0, 1.8, np.pi / 2, 4.5, 1.9, 1.6], rtol=1e-6)
    assert len(drive.cameras) == 1
    np.testing.assert_allclose(drive.cameras[0][1][:3, 3], [10.0, 20.0, 1.0])


def test_a_human_sample_and_one_without_pictures_have_less() -> None:
    drive = drive_of(row(perturbed_states=None, images=None, cameras=None), ORIGIN)
    assert drive.perturbed is None and drive.cameras == ()
    assert to_world(NOW, np.zeros((1, 3)))[0, 1] - ORIGIN[1] == drive.label[0, 1]


def test_a_box_has_twelve_edges_each_once() -> None:
    assert EDGES.shape == (12, 2, 3) and len({tuple(map(tuple, np.sort(edge, axis=0))) for edge in EDGES}) == 12
    np.testing.assert_allclose(np.linalg.norm(EDGES[:, 0] - EDGES[:, 1], axis=1), 1.0)


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "block.safetensors"
    write_scene(path, replace(scene(), background=some(30, 3), nodes={"a": some(5, 3, 1)}))
    return path


def test_the_command_serves_a_page_on_loopback_until_it_is_told_to_stop(stored: Path) -> None:
    pytest.importorskip("viser", reason="pip install 'driving-data-factory[view]'")
    words = [sys.executable, "-m", "factory", "scene", "view", str(stored), "port=0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        said = served.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/", said)
        assert found and "no run's drives" in said, said
        with urllib.request.urlopen(found[0], timeout=30) as page:
            assert page.status == 200 and b"<html" in page.read()
        served.send_signal(signal.SIGINT)
        assert served.wait(30) == 0


def test_without_viser_it_says_what_to_install(stored: Path) -> None:
    code = (
        "import sys; sys.modules['viser'] = None\n"
        "from factory.commands.table import COMMANDS\n"
        f"sys.exit(COMMANDS['scene'].load()(['view', {str(stored)!r}]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "pip install 'driving-data-factory[view]'" in done.stderr
