"""Which clips share a log, and which a town."""

from factory.datasets.town.town import log_name
from planners.evaluation.bootstrap import cluster_labels_by_level, town_of


def test_a_synthetic_log_names_its_town() -> None:
    assert town_of(log_name(101, 0)) == town_of(log_name(101, 17)) == "town-101"
    assert town_of(log_name(7, 3)) == "town-7"


def test_logs_of_other_data_sets_name_none() -> None:
    for log_id in ("", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "sd_nuscenes_v1.0-mini_scene-0103", "town-hall"):
        assert town_of(log_id) == ""


def test_a_level_is_there_where_every_clip_has_it() -> None:
    logs = [log_name(1, 0), log_name(1, 1)]
    assert cluster_labels_by_level(["a", "b"], logs) == {
        "clip": ("a", "b"),
        "log": tuple(logs),
        "town": ("town-1", "town-1"),
    }
    assert list(cluster_labels_by_level(["a", "b"], ["scene-1", "scene-2"])) == ["clip", "log"]
    assert list(cluster_labels_by_level(["a", "b"], [logs[0], "scene-2"])) == ["clip", "log"]
    assert list(cluster_labels_by_level(["a", "b"], [logs[0], ""])) == ["clip"]
