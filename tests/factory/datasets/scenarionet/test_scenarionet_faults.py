"""What a ScenarioNet reader repairs and refuses, and how it says so; which files it finds, and what it keeps."""

import copy
import os
import pickle

import numpy as np
import pytest

from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip, ClipRef
from tasks.world.repair.records import LEFT_OUT
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town


def without(*path):
    def change(scenario):
        part = scenario
        for key in path[:-1]:
            part = part[key]
        del part[path[-1]]

    return change


def with_value(value, *path):
    def change(scenario):
        part = scenario
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value

    return change


def at(track_id, name, frames, value):
    """Values of one track's state, changed at some frames."""

    def change(scenario):
        scenario["tracks"][track_id]["state"][name][frames] = value

    return change


def backwards(scenario):
    scenario["metadata"]["ts"] = scenario["metadata"]["ts"][::-1]


def stamped(value, frame=50):
    def change(scenario):
        scenario["metadata"]["ts"][frame] = value

    return change


BREAKS = {
    "tracks: missing": without("tracks"),
    "map_features: missing": without("map_features"),
    "dynamic_map_states: missing": without("dynamic_map_states"),
    "length: missing": without("length"),
    "metadata.ts: missing": without("metadata", "ts"),
    "metadata.sdc_id: missing": without("metadata", "sdc_id"),
    "metadata.dataset: 'pg' is not supported": with_value("pg", "metadata", "dataset"),
    "metadata.ts: time is not finite and increasing in most of the frames": backwards,
    "metadata.ts: no frame for 9,988 s": stamped(1e4, 120),
    "metadata.ts: frames further apart": with_value(np.arange(121.0), "metadata", "ts"),
    r"tracks\[ego\].state.position: missing": without("tracks", "ego", "state", "position"),
    r"tracks\[sdc\].state: most of 121 poses of the ego are NaN": at("ego", "position", slice(0, 70), np.nan),
    r"tracks\[lead\].type: unknown class 'TRAM'": lambda s: [
        track.update(type="TRAM") for name, track in s["tracks"].items() if name != "ego"
    ],
}
MAP_BREAKS = {
    "map_features: the map is empty": with_value({}, "map_features"),
    r"map_features\[E1\].type: unknown lane class": with_value("LANE_HOVER", "map_features", "E1", "type"),
    r"map_features\[E1\].polyline: missing": without("map_features", "E1", "polyline"),
    r"map_features\[E1\].polyline: shape \(3,\)": with_value([1.0, 2.0, 3.0], "map_features", "E1", "polyline"),
    "map_features: the map is empty: no lane for cars; left out: .*no point": lambda s: [
        feature.update(polyline=np.full((5, 2), np.nan)) for feature in s["map_features"].values()
    ],
    "unknown light states": with_value(
        {"C2": {"lane": "C2", "state": {"object_state": ["PURPLE"] * 121}}}, "dynamic_map_states"
    ),
    "120 steps, the log has 121": with_value(
        {"C2": {"lane": "C2", "state": {"object_state": [None] * 120}}}, "dynamic_map_states"
    ),
    "no lane or no state": with_value({"C2": {"lane": "C2"}}, "dynamic_map_states"),
    "map_features: the ego is never within": lambda s: [
        s["map_features"].pop(k) for k in list(s["map_features"]) if k not in ("N", "S")
    ],
}


@pytest.mark.parametrize("message", list(BREAKS))
def test_a_broken_file_is_named_with_its_field_and_hurts_no_other(tmp_path, message):
    scenario = town.nuscenes()
    BREAKS[message](scenario)
    path = town.save(scenario, tmp_path, "sd_broken.pkl")
    town.save(town.nuscenes(), tmp_path, "sd_good.pkl")
    reader = ScenarioNetReader(tmp_path)
    index = reader.index()
    assert {ref.log_id for ref in index.refs} == {"sd_good"} and list(index.broken) == [
        ClipRef("scenarionet", "sd_broken", 0)
    ]
    with pytest.raises(BadClip, match=message) as error:
        reader.read(next(iter(index.broken)))
    assert error.value.file == str(path)


def again(name, of, forward_m=0.0):
    def change(scenario):
        scenario["tracks"][name] = copy.deepcopy(scenario["tracks"][of])
        scenario["tracks"][name]["state"]["position"][:, 0] += forward_m

    return change


WITHOUT_FRAME_50 = [("clock", "frame 50", True), ("gap", "", False)]
# what is wrong -> the things that it costs, and (pass, thing, whether it is left out) of what is told
REPAIRS = {
    "NaN pose": (at("ego", "position", 40, np.nan), (), [("gap", "ego", False), ("impossible", "ego", True)]),
    "ego elsewhere": (at("ego", "position", 40, 9000.0), (), [("gap", "ego", False), ("jump", "ego", True)]),
    "NaN heading of a box": (
        at("lead", "heading", 40, np.nan),
        (),
        [("gap", "lead", False), ("impossible", "lead", True)],
    ),
    "a box of no length": (at("lead", "length", 40, 0.0), (), [("gap", "lead", False), ("impossible", "lead", True)]),
    "a length below zero": (at("lead", "length", slice(None), -1.2959), ("lead",), [("impossible", "lead", True)]),
    "misshapen": (
        with_value(np.zeros(7), "tracks", "lead", "state", "heading"),
        ("lead",),
        [("impossible", "lead", True)],
    ),
    "unknown class": (with_value("TRAM", "tracks", "lead", "type"), ("lead",), [("class", "lead", True)]),
    "no lengths": (without("tracks", "lead", "state", "length"), ("lead",), [("impossible", "lead", True)]),
    "no states": (without("tracks", "lead", "state"), ("lead",), [("impossible", "lead", True)]),
    "no dict": (with_value(None, "tracks", "lead"), ("lead",), [("class", "lead", True)]),
    "a track without an id": (again(None, "lead"), (), [("token", "None", True)]),
    "ego listed as agent": (again("me", "ego"), (), [("ego", "me", True)]),
    "car listed twice": (again("zwei", "lead", 0.2), (), [("twice", "zwei", True)]),
    "one id as text and number": (lambda s: [again("5", "rider")(s), again(5, "lead")(s)], (), None),
    "heading turned round": (at("lead", "heading", 40, np.pi), (), [("heading", "lead", False)]),
    "a stamp of long ago": (stamped(0.0), (), WITHOUT_FRAME_50),
    "a stamp of later": (stamped(1e6), (), WITHOUT_FRAME_50),
    "no stamp": (stamped(np.nan), (), WITHOUT_FRAME_50),
    "a stamp twice": (
        lambda s: stamped(s["metadata"]["ts"][49])(s),
        (),
        [("clock", "frame 49", True), *WITHOUT_FRAME_50],
    ),
}


@pytest.mark.parametrize("fault", REPAIRS)
def test_a_fault_of_one_thing_is_put_right_or_left_out_and_told_and_nothing_else_changes(tmp_path, fault):
    """All drive straight at one speed here: between two frames they are where they were."""
    spoil, costs, told = REPAIRS[fault]
    scenario = town.nuscenes()
    spoil(scenario)
    found, sound = (
        ScenarioNetReader(town.save(s, tmp_path / name))
        for s, name in ((scenario, "spoiled"), (town.nuscenes(), "sound"))
    )
    index = found.index()
    assert index.refs == sound.index().refs and not index.dropped and not index.broken
    clip, whole = found.read(index.refs[0]), sound.read(index.refs[0])
    if told is not None:
        assert sorted({(r.what, r.thing, r.now == LEFT_OUT) for r in clip.repairs}) == told
    kept = [name for name in sorted(whole.agents.track_ids) if name not in costs]
    assert [name for name in clip.agents.track_ids if name != "5"] == kept
    of = [[agents.track_ids.index(name) for name in kept] for agents in (clip.agents, whole.agents)]
    for name in ("boxes", "velocities", "valid", "center_z"):
        here, there = (getattr(c.agents, name)[:, columns] for c, columns in zip((clip, whole), of))
        np.testing.assert_allclose(here, there, atol=1e-9)
    np.testing.assert_allclose(clip.ego_states, whole.ego_states, atol=1e-6)


@pytest.mark.parametrize("message", list(MAP_BREAKS))
def test_a_broken_map_or_light_is_named_when_the_clip_is_read(tmp_path, message):
    scenario = town.nuscenes()
    MAP_BREAKS[message](scenario)
    reader = ScenarioNetReader(town.save(scenario, tmp_path))
    with pytest.raises(BadClip, match=message):
        reader.read(reader.index().refs[0])


class Evil:
    def __reduce__(self):
        return os.system, ("touch ran",)


def test_truncated_hostile_and_foreign_pickles_are_broken_logs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = pickle.dumps(town.nuscenes())
    (tmp_path / "sd_cut.pkl").write_bytes(data[: len(data) // 2])
    (tmp_path / "sd_evil.pkl").write_bytes(pickle.dumps({**town.nuscenes(), "id": Evil()}))
    (tmp_path / "sd_list.pkl").write_bytes(pickle.dumps([1, 2]))
    (tmp_path / "sd_empty.pkl").write_bytes(b"")
    broken = {ref.log_id: message for ref, message in ScenarioNetReader(tmp_path).index().broken.items()}
    assert set(broken) == {"sd_cut", "sd_evil", "sd_list", "sd_empty"}
    assert "truncated" in broken["sd_cut"] and "system" in broken["sd_evil"] and "not a dict" in broken["sd_list"]
    assert not (tmp_path / "ran").exists()


def test_a_database_is_read_by_its_summary_and_mapping(tmp_path):
    town.save(town.nuscenes(), tmp_path / "db_0", "sd_one.pkl")
    town.save(town.waymo(), tmp_path / "db_1", "sd_two.pkl")
    summary = {"sd_one.pkl": {"id": "one"}, "sd_two.pkl": {"id": "two"}, "sd_gone.pkl": {}}
    mapping = {"sd_one.pkl": "db_0", "sd_two.pkl": "db_1", "sd_gone.pkl": ""}
    (tmp_path / "dataset_summary.pkl").write_bytes(pickle.dumps(summary))
    (tmp_path / "dataset_mapping.pkl").write_bytes(pickle.dumps(mapping))
    index = ScenarioNetReader(tmp_path).index()
    assert [ref.log_id for ref in index.refs] == ["sd_one"] * 3 + ["sd_two"] * 3
    assert [ref.log_id for ref in index.broken] == ["sd_gone"]


@pytest.mark.parametrize("name, folder", [("../sd_x.pkl", ""), ("sd_x.pkl", "/etc"), ("passwd", ""), ("sd_x.pkl", 3)])
def test_a_database_that_names_impossible_files_is_refused(tmp_path, name, folder):
    (tmp_path / "dataset_summary.pkl").write_bytes(pickle.dumps({name: {}}))
    (tmp_path / "dataset_mapping.pkl").write_bytes(pickle.dumps({name: folder}))
    with pytest.raises(ValueError, match="impossible file"):
        ScenarioNetReader(tmp_path).index()


def test_a_root_without_scenarios_or_with_one_twice_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        ScenarioNetReader(tmp_path / "nowhere").index()
    with pytest.raises(ValueError, match="no scenario here"):
        ScenarioNetReader(tmp_path).index()
    town.save(town.nuscenes(), tmp_path / "a")
    town.save(town.nuscenes(), tmp_path / "b")
    with pytest.raises(ValueError, match="stands twice"):
        ScenarioNetReader(tmp_path).index()
