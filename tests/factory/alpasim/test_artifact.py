"""What AlpaSim's runtime lists a scene by says what the scene's services answer of."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[alpasim]"')

from scipy.spatial.transform import Rotation

from factory.alpasim.artifact import EGO_HEIGHT_M, usdz, write_artifacts
from factory.alpasim.opendrive import opendrive
from factory.alpasim.sensors import Sensors
from factory.alpasim.traffic import END_US, Traffic
from tasks.render.views import render_views
from tasks.settings import TrafficSettings
from tasks.world.frames import PACIFICA
from tests.factory.alpasim.asked import STREET, asked, cameras, pose_message, scenes, street
from tests.factory.alpasim.test_scene_service import picture, shot
from tests.factory.alpasim.test_traffic import proto


def content(data: bytes) -> tuple[dict, dict, dict]:  # type: ignore[type-arg]
    """Metadata, rig and tracks, by names that AlpaSim reads."""
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        read = {name: packed.read(name) for name in packed.namelist()}
    metadata = yaml.safe_load(read["metadata.yaml"])
    tracks = json.loads(read["sequence_tracks.json"])
    return metadata, json.loads(read["rig_trajectories.json"]), tracks[metadata["scene_id"]]


def test_its_poses_are_those_that_pictures_are_drawn_and_traffic_driven_at() -> None:
    """The picture at a pose of the file is that of the log, and a session begins with all its tracks."""
    metadata, rig, told = content(usdz(STREET, street()))
    (one,), tracks, scene = rig["rig_trajectories"], told["tracks_data"], street()
    assert metadata["scene_id"] == one["sequence_id"] == STREET
    assert one["T_rig_world_timestamps_us"] == list(range(0, END_US + 1, 100_000))
    poses = np.array(one["T_rig_worlds"])
    np.testing.assert_allclose(poses[0, :3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 3], scene.on_road[:, :3, 3] - scene.origin, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(rig["world_to_nre"]["matrix"])[:3, 3], scene.origin)
    assert np.array_equal(rig["T_world_base"], np.eye(4)), "the map stands in `local`"
    with zipfile.ZipFile(io.BytesIO(usdz(STREET, scene))) as packed:
        assert scene.clip is not None
        assert packed.read("map.xodr") == opendrive(scene.clip.road_map, scene.origin)
    assert [row["logical_sensor_name"] for row in rig["camera_calibrations"].values()] == ["front", "bent"]
    for frames in one["cameras_frame_timestamps_us"].values():
        assert frames[0] == [0, 17_000] and frames[-1][1] < END_US and len(frames) == 19

    service, objects = Sensors(scenes()).service, {}
    request = proto.TrafficSessionRequest(session_uuid="one", map_id=STREET)
    for name, stamps, rows in zip(tracks["tracks_id"], tracks["tracks_timestamps_us"], tracks["tracks_poses"]):
        trajectory = request.logged_object_trajectories.add(object_id=name).trajectory
        for stamp, row in zip(stamps, rows):
            pose = np.eye(4)
            pose[:3, 3], pose[:3, :3] = row[:3], Rotation.from_quat(row[3:]).as_matrix()
            trajectory.poses.add(timestamp_us=stamp).pose.ParseFromString(pose_message(pose).SerializeToString())
            if stamp == 4_000_000:
                objects[name] = pose
    found = picture(service, shot(STREET, cameras(service, STREET)["front"], poses[40], 4_000_000, objects))
    expected = next(render_views(scene.asset, scene.cameras[:1], scene.on_road[[40]], scene.agents, [40], 96, 64))[0]
    np.testing.assert_array_equal(found, expected)
    there = {name: scene.agents.boxes[40, scene.agents.track_ids.index(name)] for name in objects}
    assert set(objects) == set(scene.agents.track_ids)
    for name, box in there.items():
        np.testing.assert_allclose(objects[name][:2, 3], box[:2] - scene.origin[:2], atol=1e-9)
    box = one["rig_bbox"]
    assert box["centroid"][:2] == [PACIFICA.rear_axle_to_center, 0.0] and 2.0 * box["centroid"][2] == EGO_HEIGHT_M
    ego = request.logged_object_trajectories.add(object_id="EGO").trajectory
    for stamp, pose in zip(one["T_rig_world_timestamps_us"], poses):
        pose = pose.copy()
        pose[:3, 3] += pose[:3, :3] @ box["centroid"]
        ego.poses.add(timestamp_us=stamp).pose.ParseFromString(pose_message(pose).SerializeToString())
    asked(Traffic(scenes(), TrafficSettings()).service, "start_session", request)
    sizes = dict(zip(tracks["tracks_id"], told["cuboidtracks_data"]["cuboids_dims"]))
    assert sizes["ahead"] == [4.6, 1.9, 1.6]
    assert dict(zip(tracks["tracks_id"], tracks["tracks_flags"]))["cone"] == []


def test_the_same_scene_is_the_same_bytes_in_a_file_each(tmp_path: Path) -> None:
    write_artifacts(scenes("another"), tmp_path / "usdz")
    assert {path.name for path in (tmp_path / "usdz").iterdir()} == {f"{STREET}.usdz", "another.usdz"}
    assert (tmp_path / "usdz" / f"{STREET}.usdz").read_bytes() == usdz(STREET, street())
    with pytest.raises(ValueError, match="x: a scene of photos is no drive"):
        usdz("x", replace(street(), clip=None))
