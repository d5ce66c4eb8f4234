"""A log belongs to the split that its data set put it into; the hash of its id decides where there is none."""

from pathlib import Path

import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import NUSCENES_VAL, nuscenes_split, split_of, waymo_split
from tests.factory.datasets.av2.test_av2 import write_log
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town


@pytest.mark.parametrize("named", ["train", "val", "test"])
def test_argoverse_s_folders_are_its_splits(tmp_path: Path, named: str) -> None:
    write_log(tmp_path / "sensor" / named / "log-a")
    assert splits(AV2Reader(tmp_path / "sensor")) == {named}
    assert splits(AV2Reader(tmp_path / "sensor" / named / "log-a")) == {named}
    assert splits(AV2Reader(tmp_path / "sensor", split="test")) == {"test"}


def test_a_log_in_a_folder_of_another_name_has_the_split_of_its_id(tmp_path: Path) -> None:
    write_log(tmp_path / "mine" / "log-a")
    assert splits(AV2Reader(tmp_path / "mine")) == {split_of("log-a")}


def test_nuscenes_lists_decide_by_version_and_scene(tmp_path: Path) -> None:
    """nuscenes-devkit, splits.py: scene-0103 is val in both versions, scene-0553 val of the whole and train of mini."""
    assert nuscenes_split("sd_nuscenes_v1.0-trainval_scene-0103") == "val"
    assert nuscenes_split("sd_nuscenes_v1.0-mini_scene-0103") == "val"
    assert nuscenes_split("sd_nuscenes_v1.0-trainval_scene-0553") == "val"
    assert nuscenes_split("sd_nuscenes_v1.0-mini_scene-0553") == "train"
    assert nuscenes_split("sd_nuscenes_v1.0-trainval_scene-0061") == "train"
    assert nuscenes_split("sd_nuscenes_v1.0-test_scene-0077") == "test"
    assert nuscenes_split("sd_nuscenes_v1.0-other_scene-0077") is None
    assert nuscenes_split("sd_waymo_v1.2_abc") is None
    assert {version: len(scenes) for version, scenes in NUSCENES_VAL.items()} == {"v1.0-trainval": 150, "v1.0-mini": 2}
    town.save(town.nuscenes(), tmp_path, "sd_nuscenes_v1.0-trainval_scene-0003.pkl")
    assert splits(ScenarioNetReader(tmp_path)) == {"val"}


@pytest.mark.parametrize(
    ("record", "split"),
    [
        ("/waymo/training_20s/training_20s.tfrecord-00003-of-01000", "train"),
        ("validation_interactive.tfrecord-00001-of-00150", "val"),
        ("testing.tfrecord-00001-of-00150", "test"),
        ("mine.tfrecord", None),
    ],
)
def test_a_waymo_scenario_belongs_where_its_record_does(tmp_path: Path, record: str, split: str | None) -> None:
    assert waymo_split(record) == split
    scenario = town.waymo()
    scenario["metadata"]["source_file"] = record
    path = town.save(scenario, tmp_path, "sd_waymo_v1.2_abc.pkl")
    assert splits(ScenarioNetReader(path)) == {split or split_of("sd_waymo_v1.2_abc")}


def test_a_folder_sorted_by_hand_wins_over_the_lists(tmp_path: Path) -> None:
    town.save(town.nuscenes(), tmp_path / "test", "sd_nuscenes_v1.0-trainval_scene-0003.pkl")
    assert splits(ScenarioNetReader(tmp_path)) == {"test"}


def splits(reader: AV2Reader | ScenarioNetReader) -> set[str]:
    return {reader.read(ref).split for ref in reader.index().refs}
