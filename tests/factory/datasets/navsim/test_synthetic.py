"""Second-stage scenes: nuPlan's objects read by the names of their classes alone, and what is refused."""

import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.datasets.navsim.log import read_scene_pickle
from factory.readers.base import BadClip
from factory.readers.pickles import Record, load_plain, load_records
from tasks.world.clip import AgentKind
from tasks.world.frames import to_local, to_world
from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.logs import frame

TOKEN, NOW = "0000000000005a00c", 11


def ego_pose(k: int) -> np.ndarray:
    """Of frame k, 8 m/s northwards and turning."""
    return np.array([331_000.0, 4_690_000.0 + 4.0 * k, 1.5 + 0.01 * k])


def world_boxes(k: int) -> np.ndarray:
    """x, y, heading of a vehicle, a pedestrian and a cone at frame k."""
    return np.array([[331_002.0 + 3.0 * i, 4_690_060.0 + (2.0 - i) * k, 1.4 + 0.1 * i] for i in range(3)])


def log_frame(k: int) -> dict[str, Any]:
    pose, names = ego_pose(k), ["vehicle", "pedestrian", "traffic_cone"]
    x, y, heading = to_local(pose, world_boxes(k)).T
    velocities = to_local(np.array([0.0, 0.0, pose[2]]), np.array([[0.0, 3.0, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 0.0]]))
    motion = {
        "ego2global_translation": np.array([*pose[:2], 12.0]),
        "ego2global_rotation": np.array([np.cos(pose[2] / 2), 0.0, 0.0, np.sin(pose[2] / 2)]),
        "ego_dynamic_state": [8.0, 0.1, 0.2, -0.1],
    }
    anns = {
        "gt_boxes": np.column_stack([x, y, np.full(3, 0.8), np.tile([4.0, 2.0, 1.5], (3, 1)), heading]),
        "gt_names": np.array(names),
        "gt_velocity_3d": velocities * [1.0, 1.0, 0.0],
        "instance_tokens": names,
        "track_tokens": names,
    }
    return frame(k, **motion, anns=anns, traffic_lights=[(21, False), (22, False), (23, True)])


def made() -> dict[str, Any]:
    """The dictionary that is pickled; its second light is yellow."""
    scene = scene_pickles.scene_of_log([log_frame(k) for k in range(20)], NOW, TOKEN, cameras=True)
    for lights in scene["extended_traffic_light_data"]:
        lights.traffic_lights[1].status = scene_pickles.TrafficLightStatusType.YELLOW
    return scene


def test_a_scene_is_its_history_and_what_others_do_after_it(tmp_path: Path) -> None:
    found = read_scene_pickle(scene_pickles.write_scene(tmp_path, made()))
    assert not [name for name in sys.modules if name.split(".")[0] == "nuplan"]
    now, original = found.frames[3], log_frame(NOW)
    assert (found.token, found.original_scene, len(found.frames)) == (TOKEN, original["token"], 12)
    np.testing.assert_allclose(now.pose, ego_pose(NOW), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(now.dynamic_state, np.float32([8.0, 0.1, 0.2, -0.1]))
    assert now.command == "straight" and now.lights[::2] == (("21", False), ("23", True))
    assert now.roadblock_ids == ("10", "20", "30") and len(now.cameras) == 8
    assert now.cameras[0].path == original["cams"][now.cameras[0].name]["data_path"]


def test_later_objects_stand_where_the_world_has_them(tmp_path: Path) -> None:
    found = read_scene_pickle(scene_pickles.write_scene(tmp_path, made()))
    for k, later in enumerate(found.frames[4:], NOW + 1):
        assert later.boxes is not None
        assert later.boxes.kinds == (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE)
        world = to_world(later.pose, later.boxes.boxes[:, [0, 1, 6]])
        np.testing.assert_allclose(world, world_boxes(k), atol=1e-8)
        c, s = np.cos(later.pose[2]), np.sin(later.pose[2])
        velocity = later.boxes.velocities[:, :2] @ np.array([[c, s], [-s, c]])
        np.testing.assert_allclose(velocity, [[0.0, 3.0], [0.5, 3.0], [0.0, 0.0]], atol=1e-12)
        assert later.lights == (("21", False), ("22", False), ("23", True))  # yellow is not red


def _no_future(scene: dict[str, Any]) -> None:
    scene["extended_detections_tracks"] = scene["extended_detections_tracks"][:7]


def _other_class(scene: dict[str, Any]) -> None:
    scene["extended_detections_tracks"][2] = scene["extended_traffic_light_data"][2]


def _local(scene: dict[str, Any]) -> None:
    scene["frames"][1]["ego_status"]["in_global_frame"] = False


def _another_token(scene: dict[str, Any]) -> None:
    scene["scene_metadata"]["initial_token"] = "5"


def _the_ego(scene: dict[str, Any]) -> None:
    things = scene["extended_detections_tracks"][1].tracked_objects.tracked_objects
    things[0]._tracked_object_type = scene_pickles.TrackedObjectType.EGO


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (_no_future, "extended_detections_tracks: 7 and 8"),
        (_other_class, "extended_detections_tracks[2]: is a TrafficLightStatuses, expected DetectionsTracks"),
        (_local, "frames[1].ego_status.in_global_frame"),
        (_another_token, "scene_metadata.initial_token"),
        (_the_ego, "extended_detections_tracks[1].tracked_objects[0]._tracked_object_type: is 7"),
    ],
)
def test_what_is_no_scene_is_named(harm: Callable[[dict[str, Any]], None], said: str, tmp_path: Path) -> None:
    scene = made()
    harm(scene)
    with pytest.raises(BadClip) as error:
        read_scene_pickle(scene_pickles.write_scene(tmp_path, scene))
    assert said in str(error.value)


def test_only_the_named_classes_are_records_and_nothing_of_them_runs(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return len, ("run",)  # and not print, which Ray replaces by its own

    path = scene_pickles.write_scene(tmp_path, made())
    with pytest.raises(BadClip, match="refused"):
        load_plain(path.read_bytes(), "file")
    with pytest.raises(BadClip, match="refused global"):
        load_records(path.read_bytes(), "file", ["nuplan.common.actor_state.agent Agent"])
    with pytest.raises(BadClip, match=r"refused global builtins\.len"):
        load_records(pickle.dumps(Harm()), "file", ["nuplan.common.actor_state.agent Agent"])
    named = load_records(pickle.dumps(Harm()), "file", ["builtins len"])  # listed: even then it is but a record
    assert isinstance(named, Record) and named.arguments == ("run",)


def test_records_are_paid_for(tmp_path: Path) -> None:
    """A few bytes each would make objects without end."""
    one = b"cm\nC\n" + pickle.MARK + b"t" + pickle.NEWOBJ + pickle.POP
    head = pickle.PROTO + b"\x02"
    few, many = (head + one * n + pickle.NONE + pickle.STOP for n in (1_000, 100_000))
    assert load_records(few, "file", ["m C"]) is None
    with pytest.raises(BadClip, match="outgrow"):
        load_records(many, "file", ["m C"])
