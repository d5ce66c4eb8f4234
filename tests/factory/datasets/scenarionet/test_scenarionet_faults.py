"""What a ScenarioNet reader refuses, and how it says so; which files it finds, and what it keeps."""

import os
import pickle

import numpy as np
import pytest

from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip, ClipRef
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


def nan_pose(scenario):
    scenario["tracks"]["ego"]["state"]["position"][40, 0] = np.nan


def backwards(scenario):
    scenario["metadata"]["ts"][50] = 0.0


BREAKS = {
    "tracks: missing": without("tracks"),
    "map_features: missing": without("map_features"),
    "dynamic_map_states: missing": without("dynamic_map_states"),
    "length: missing": without("length"),
    "metadata.ts: missing": without("metadata", "ts"),
    "metadata.sdc_id: missing": without("metadata", "sdc_id"),
    "metadata.dataset: 'pg' is not supported": with_value("pg", "metadata", "dataset"),
    "metadata.ts: time is not finite and strictly increasing": backwards,
    "metadata.ts: frames further apart": with_value(np.arange(121.0), "metadata", "ts"),
    r"tracks\[ego\].state.position: missing": without("tracks", "ego", "state", "position"),
    r"tracks\[ego\].state.position: NaN pose": nan_pose,
    r"tracks\[lead\].state.heading: shape": with_value(np.zeros(7), "tracks", "lead", "state", "heading"),
    r"tracks\[lead\].type: unknown class 'TRAM'": with_value("TRAM", "tracks", "lead", "type"),
    r"tracks\[lead\].state: length, width, height": without("tracks", "lead", "state", "length"),
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
