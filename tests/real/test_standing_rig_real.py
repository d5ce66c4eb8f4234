"""A real nuPlan log at a red light (data/nuplan_rig_standing), laid out as OpenScene's: through the reader's frames.

Ten frames of eight cameras at 2 Hz with stamps of their own, some hundred boxes, roadblocks and a light. There is no
map and no window of 20 frames in it. The file names its sizes length, width, height; they are width, length, height, as
the pictures show.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.datasets.navsim.log import CAMERA_NAMES, LogFrames, read_frames
from factory.datasets.navsim.window import sensor_files, traffic_lights
from factory.exits import BAD_CONFIG
from factory.run import main
from tasks.world.clip import AgentKind
from tasks.world.road_map import LightState
from tests.factory.datasets.navsim.geopackage_writer import CITIES, stub_rows, write_geopackage
from tests.factory.datasets.navsim.openscene_writer import hex16, write_frames

LOG = "2021.05.12.22.28.35_veh-35"
CONNECTOR = 65622  # a number for the light, which the file gives without one


@pytest.fixture(scope="module")
def told(shared_root: Path) -> list[dict[str, Any]]:
    frames: list[dict[str, Any]] = json.loads(
        (shared_root / "data" / "nuplan_rig_standing" / "annotations.json").read_text()
    )["frames"]
    return frames


@pytest.fixture(scope="module")
def root(told: list[dict[str, Any]], shared_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """navsim_logs/mini, sensor_blobs/mini by links, and a map that does not reach there."""
    root = tmp_path_factory.mktemp("standing")
    folder = shared_root / "data" / "nuplan_rig_standing"
    write_frames(root, "mini", LOG, [_frame(k, row) for k, row in enumerate(told)])
    (root / "sensor_blobs").mkdir()
    (root / "sensor_blobs" / "mini").symlink_to(folder)
    version, zone = CITIES["us-nv-las-vegas-strip"]
    write_geopackage(root / "maps" / "us-nv-las-vegas-strip" / version / "map.gpkg", stub_rows(), zone)
    return root


def _frame(k: int, row: Mapping[str, Any]) -> dict[str, Any]:
    boxes = np.array(row["boxes_xyz_lwh_yaw"])[:, [0, 1, 2, 4, 3, 5, 6]]
    tokens = [hex16("box", k, i) for i in range(len(boxes))]
    cameras = {
        name: {
            "data_path": f"frame_{k}/{name}.jpg",
            **{key: camera[key] for key in ("sensor2lidar_rotation", "sensor2lidar_translation", "cam_intrinsic")},
            "distortion": np.zeros(5),
            "timestamp": camera["timestamp"],
        }
        for name, camera in row["cameras"].items()
    }
    return {
        "token": hex16("frame", k),
        "timestamp": row["t_us"],
        "log_name": LOG,
        "scene_token": hex16("scene"),
        "map_location": row["map_location"],
        "roadblock_ids": [str(block) for block in row["roadblock_ids"]],
        "ego2global_translation": np.array(row["ego2global_translation"]),
        "ego2global_rotation": np.array(row["ego2global_rotation_wxyz"]),
        "ego_dynamic_state": [0.0, 0.0, 0.0, 0.0],
        "traffic_lights": [(CONNECTOR, state == "red") for state in row["traffic_light"]],
        "driving_command": [0, 1, 0, 0],
        "cams": cameras,
        "lidar_path": None,
        "anns": {
            "gt_boxes": boxes,
            "gt_names": np.array(row["names"]),
            "gt_velocity_3d": np.column_stack([row["velocity"], np.zeros(len(boxes))]),
            "instance_tokens": tokens,
            "track_tokens": tokens,
        },
    }


@pytest.fixture(scope="module")
def log(root: Path) -> LogFrames:
    return read_frames(root / "navsim_logs" / "mini" / f"{LOG}.pkl")


def test_roadblocks_and_the_red_light_are_carried(log: LogFrames, told: list[dict[str, Any]]) -> None:
    assert [list(frame.roadblock_ids) for frame in log.frames] == [
        [str(b) for b in row["roadblock_ids"]] for row in told
    ]
    lights = traffic_lights(log.frames)
    assert lights.lane_ids == (str(CONNECTOR),) and (lights.states == LightState.RED).all()


def test_each_photo_has_its_camera_s_own_stamp(log: LogFrames, told: list[dict[str, Any]], root: Path) -> None:
    images, sweeps = sensor_files(log.frames, root / "sensor_blobs" / "mini")
    assert len(images) == 80 and not sweeps
    late_ms = {
        (row["t_us"], n): (c["timestamp"] - row["t_us"]) / 1e3 for row in told for n, c in row["cameras"].items()
    }
    assert min(late_ms.values()) < -7.0 and max(late_ms.values()) > 34.0
    for image, (k, name) in zip(images, [(k, name) for k in range(10) for name in CAMERA_NAMES]):
        late_s = late_ms[told[k]["t_us"], name] / 1e3
        assert (image.sensor, image.time_s) == (name, pytest.approx(0.5 * k + late_s, abs=1e-9))
        assert np.abs(image.world_from_ego - log.frames[k].world_from_ego).max() < 2e-3, "the ego stands"


@pytest.mark.parametrize(
    ("name", "plate", "left", "right"),
    [("CAM_F0", (891.0, 844.0), 680.0, 1121.0), ("CAM_B0", (1047.0, 918.0), 775.0, 1300.0)],
)
def test_boxes_lie_on_the_vehicles_that_the_pictures_show(
    log: LogFrames, name: str, plate: tuple[float, float], left: float, right: float
) -> None:
    """Read by eye in frame 5: number plate and sides of the car ahead and of the one behind. Drawn into all eight
    pictures every box lies on what it is of, some 15 cm wider."""
    frame = log.frames[5]
    (camera,) = (camera for camera in frame.cameras if camera.name == name)
    assert frame.boxes is not None
    found = []
    for box, kind in zip(frame.boxes.boxes, frame.boxes.kinds):
        local = (_corners(box) - camera.ego_from_camera[:3, 3]) @ camera.ego_from_camera[:3, :3]
        if kind == AgentKind.VEHICLE and local[:, 2].min() > 1.0:
            pixels = (local @ camera.intrinsics.T)[:, :2] / local[:, 2:]
            if (pixels.min(axis=0) < plate).all() and (pixels.max(axis=0) > plate).all():
                found.append((local[:, 2].min(), pixels[np.argsort(local[:, 2])[:4], 0]))
    away_m, face = min(found, key=lambda of: of[0])
    assert 3.0 < away_m < 10.0
    assert face.min() == pytest.approx(left, abs=75.0) and face.max() == pytest.approx(right, abs=75.0)


def test_a_run_says_that_no_clip_fits_into_ten_frames(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log_file, maps = root / "navsim_logs" / "mini" / f"{LOG}.pkl", root / "maps"
    words = [f"clips.root={log_file}", f"clips.maps={maps}", f"out={root / 'out'}"]
    assert main(["clips=navsim", *words, "clips.sensors=null", "executor=local"]) == BAD_CONFIG
    said = capsys.readouterr()
    assert "5.0 s long, a clip needs 10.0 s" in said.err


def _corners(box: np.ndarray) -> np.ndarray:
    """(8, 3) of a box (7,) x, y, z, length, width, height, heading."""
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    c, s = np.cos(box[6]), np.sin(box[6])
    return (signs * box[3:6]) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + box[:3]
