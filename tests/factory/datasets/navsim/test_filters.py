"""Scene filters and splits of NAVSIM: fields and defaults as the public dataclass has them, YAML as plain data."""

from pathlib import Path

import pytest

from factory.datasets.navsim.reader import SceneFilter, read_selection

FILTER = """
_target_: navsim.common.dataclasses.SceneFilter
_convert_: 'all'
num_history_frames: 4
num_future_frames: 8
frame_interval: 1
has_route: false
max_scenes: null
log_names:
  - '2021.10.05.07.49.39_veh-52_00934_01406'
tokens:
  - '0123456701234567'
  - '8f303260e1ab51c2'
"""
SPLIT = "defaults:\n  - scene_filter: small\n\ndata_split: trainval\n"


def _folder(tmp_path: Path, scene_filter: str = FILTER, split: str = SPLIT) -> Path:
    (tmp_path / "scene_filter").mkdir(exist_ok=True)
    (tmp_path / "scene_filter" / "small.yaml").write_text(scene_filter)
    (tmp_path / "chosen.yaml").write_text(split)
    return tmp_path


def test_a_filter_is_read_by_name_by_path_and_through_the_split_that_names_it(tmp_path: Path) -> None:
    folder = _folder(tmp_path)
    wanted = SceneFilter(
        num_future_frames=8,
        frame_interval=1,
        has_route=False,
        log_names=("2021.10.05.07.49.39_veh-52_00934_01406",),
        tokens=("0123456701234567", "8f303260e1ab51c2"),
    )
    assert read_selection("small", folder).scene_filter == wanted
    by_path = read_selection(str(folder / "scene_filter" / "small.yaml"))
    assert (by_path.scene_filter, by_path.data_split) == (wanted, None)
    chosen = read_selection("chosen", folder)
    assert (chosen.name, chosen.data_split, chosen.scene_filter) == ("chosen", "trainval", wanted)


def test_what_a_filter_does_not_say_is_the_public_default(tmp_path: Path) -> None:
    read = read_selection("small", _folder(tmp_path, "log_names: null\n")).scene_filter
    assert (read.num_frames, read.stride_frames, read.has_route) == (14, 14, True)
    assert read.tokens is None and read.log_names is None and read.max_scenes is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("frame_intervall: 1", "unknown key frame_intervall"),
        ("num_history_frames: 0", "num_history_frames: expected a whole number from 1 to 1,000,000,000, not 0"),
        (
            "num_history_frames: 9" + "0" * 20,
            "expected a whole number from 1 to 1,000,000,000, not 9000",
        ),
        ("has_route: 1", "has_route: expected true or false, not 1"),
        ("has_route: null", "has_route: expected true or false, not None"),
        ("tokens: abc", "tokens: expected a list of text, not a str"),
        ("tokens: [abc, null]", "tokens: None is no text"),
        ("log_names: [~]", "log_names: None is no text"),
        ("max_scenes: 2020-99-99", "no YAML of plain values"),
        ("tokens: [1234567890123456]", "tokens: 1234567890123456 is no text: put it in quotes"),
        ("_target_: os.system", "_target_: 'os.system' is no scene filter"),
        ("tokens: !!python/object/apply:os.system [ls]", "no YAML of plain values"),
        ("[1, 2]", "expected keys and values, found a list"),
        ("tokens: [", "no YAML of plain values"),
    ],
)
def test_a_wrong_filter_is_refused_by_file_and_key(tmp_path: Path, text: str, says: str) -> None:
    folder = _folder(tmp_path, text)
    with pytest.raises(ValueError) as refused:
        read_selection("small", folder)
    assert "small.yaml" in str(refused.value) and says in str(refused.value)


@pytest.mark.parametrize(
    ("split", "says"),
    [
        ("defaults: []\ndata_split: mini", "expected one entry `- scene_filter: <name>`"),
        ("defaults: [{scene_filter: ../small}]\ndata_split: mini", "expected one entry"),
        ("defaults: [{scene_filter: other}]\ndata_split: mini", "other.yaml: cannot be read"),
        ("defaults: [{scene_filter: small}]", "data_split: expected the name of a folder"),
        (SPLIT + "mapping: 1", "unknown key mapping"),
        (SPLIT + "reactive_all_mapping: 1", "reactive_all_mapping: expected a list"),
    ],
)
def test_a_wrong_split_is_refused_by_file_and_key(tmp_path: Path, split: str, says: str) -> None:
    with pytest.raises(ValueError, match=r"\.yaml: ") as refused:
        read_selection("chosen", _folder(tmp_path, split=split))
    assert says in str(refused.value)


def test_a_name_that_is_nowhere_lists_those_that_are_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no navtrain\.yaml here or in scene_filter/; there are chosen, small"):
        read_selection("navtrain", _folder(tmp_path))
    with pytest.raises(ValueError, match="say in which folder"):
        read_selection("navtrain")
    with pytest.raises(ValueError, match="no such file"):
        read_selection(str(tmp_path / "navtrain.yaml"))
