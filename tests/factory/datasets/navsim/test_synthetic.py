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
from tasks.world.frames import to_world
from tests.factory.datasets.navsim import scene_pickles


def test_a_scene_is_its_history_and_what_others_do_after_it(tmp_path: Path) -> None:
    found = read_scene_pickle(scene_pickles.write_scene(tmp_path, scene_pickles.scene()))
    assert not [name for name in sys.modules if name.split(".")[0] == "nuplan"]
    assert (found.token, found.original_scene) == (scene_pickles.TOKEN, scene_pickles.ORIGINAL)
    assert len(found.frames) == 12
    now = found.frames[3]
    np.testing.assert_array_equal(now.pose, scene_pickles.ego_pose(3))
    np.testing.assert_array_equal(now.dynamic_state, np.float32([8.0, 0.1, 0.2, -0.1]))
    assert now.command == "straight" and now.lights == (("21", False),) and now.roadblock_ids == ("10", "20")
    (camera,) = now.cameras  # the seven others were not saved
    assert (camera.name, camera.path) == ("CAM_F0", "veh-35/CAM_F0/0000000000000003.jpg")


def test_later_objects_stand_where_the_world_has_them(tmp_path: Path) -> None:
    found = read_scene_pickle(scene_pickles.write_scene(tmp_path, scene_pickles.scene()))
    for i, frame in enumerate(found.frames[4:], 4):
        assert frame.boxes is not None
        assert frame.boxes.kinds == (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE)
        world = to_world(frame.pose, frame.boxes.boxes[:, [0, 1, 6]])
        np.testing.assert_allclose(world, [scene_pickles.world_box(i, k) for k in range(3)], atol=1e-8)
        c, s = np.cos(frame.pose[2]), np.sin(frame.pose[2])
        velocity = frame.boxes.velocities[:, :2] @ np.array([[c, s], [-s, c]])
        np.testing.assert_allclose(velocity, [[0.0, 3.0], [0.5, 3.0], [0.0, 0.0]], atol=1e-12)
        assert frame.lights == (("21", False), ("22", False), ("23", True))  # yellow is not red


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
    scene = scene_pickles.scene()
    harm(scene)
    with pytest.raises(BadClip) as error:
        read_scene_pickle(scene_pickles.write_scene(tmp_path, scene))
    assert said in str(error.value)


def test_only_the_named_classes_are_records_and_nothing_of_them_runs(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return len, ("run",)  # and not print, which Ray replaces by its own

    path = scene_pickles.write_scene(tmp_path, scene_pickles.scene())
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
