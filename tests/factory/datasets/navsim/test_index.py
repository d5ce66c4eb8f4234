"""What `clips=navsim` plans from folders and filters, and what it says where they are not what they should be."""

import pickle
from pathlib import Path
from typing import Any

import pytest

from factory.config.run import load_config
from factory.config.words import ConfigError
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.navsim.settings import NavsimClips
from factory.readers.base import BadClip, ClipRef
from tests.factory.datasets.navsim.logs import NAME, frame
from tests.factory.datasets.navsim.openscene_writer import hex16, write_frames

OTHER = "2021.06.14.18.00.00_veh-51_00100_00200"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two logs of 24 frames, and a map that planning does not open."""
    for name in (NAME, OTHER):
        write_frames(tmp_path, "mini", name, [frame(k, name) for k in range(24)])
    write_no_map(tmp_path, "us-ma-boston")
    return tmp_path


def write_no_map(root: Path, city: str) -> None:
    """A file where the city's map should be."""
    (root / "maps" / city / "9").mkdir(parents=True)
    (root / "maps" / city / "9" / "map.gpkg").touch()


def reader(root: Path, folder: str = "mini", **other: Any) -> NavsimReader:
    settings = {"maps": root / "maps", "cache_dir": root / "kept", **other}
    return NavsimReader(root / "navsim_logs" / folder, **settings)


def write_filter(root: Path, name: str = "few", **fields: Any) -> str:
    lines = [f"{key}: {list(value) if isinstance(value, tuple) else value}" for key, value in fields.items()]
    (root / f"{name}.yaml").write_text("\n".join(["frame_interval: 1", *lines]))
    return str(root / f"{name}.yaml")


def test_windows_come_by_log_and_time(root: Path) -> None:
    index = reader(root).index()
    assert [(ref.log_id, ref.start_ms) for ref in index.refs] == [
        (name, start) for name in (NAME, OTHER) for start in (0, 1000, 2000)
    ]
    assert not index.dropped and not index.broken and not index.skipped_logs
    assert index == reader(root).index(), "the same from the tables that were kept"
    assert len(reader(root, stride_s=0.5, only=[OTHER]).index().refs) == 5
    assert reader(root, only=[OTHER], first_window=2).index().refs == (ClipRef("navsim", OTHER, 2000),)


def test_a_filter_s_tokens_are_the_clips_and_the_rest_is_counted(root: Path) -> None:
    tokens = (hex16(NAME, 4), hex16(NAME, 7), hex16(OTHER, 9), "0" * 16)
    index = reader(root, scene_filter=write_filter(root, tokens=tokens)).index()
    assert [(ref.log_id, ref.start_ms) for ref in index.refs] == [(NAME, 500), (NAME, 2000)]
    assert index.dropped == {"short_future": 1, "absent_token": 1}
    one = reader(root, scene_filter=write_filter(root, max_scenes=3, log_names=(OTHER,))).index()
    assert [ref.start_ms for ref in one.refs] == [0, 500, 1000]


def test_a_filter_s_scenes_may_stand_other_windows_may_not(root: Path) -> None:
    still = [frame(k, ego_dynamic_state=[0.0, 0.0, 0.0, 0.0]) for k in range(24)]
    write_frames(root, "still", NAME, still)
    assert reader(root, "still").index().dropped == {"ego_standing": 3}
    chosen = write_filter(root, tokens=(hex16(NAME, 3),))
    assert len(reader(root, "still", scene_filter=chosen).index().refs) == 1


def test_a_log_that_is_short_is_skipped_and_a_broken_one_hurts_no_other(root: Path) -> None:
    write_frames(root, "mini", "short", [frame(k, "short") for k in range(12)])
    broken = root / "navsim_logs" / "mini" / "broken.pkl"
    broken.write_bytes(pickle.dumps([frame(0, "broken")])[:-300])
    (root / "navsim_logs" / "mini" / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch evil'\ntR.")
    index = reader(root).index()
    assert len(index.refs) == 6
    assert index.skipped_logs == {"short": "6.0 s long, a clip needs 10.0 s"}
    problems = {ref.log_id: problem for ref, problem in index.broken.items()}
    assert problems.keys() == {"broken", "evil"}
    assert str(broken) in problems["broken"] and "os.system" in problems["evil"]
    assert not Path("evil").exists()


def test_the_split_is_the_filter_s_then_the_folder_s_then_the_log_s(root: Path) -> None:
    write_frames(root, "test", NAME, [frame(k) for k in range(24)])
    for name, split in (("navtrain", "train"), ("navtest", "test"), ("navhard_two_stage", "test")):
        chosen = write_filter(root, name, tokens=(hex16(NAME, 3),))
        assert reader(root, scene_filter=chosen).split_of(NAME) == split
    assert reader(root, "test").split_of(NAME) == "test"
    assert reader(root, "test", split="val").split_of(NAME) == "val"
    assert {reader(root).split_of(f"log {i}") for i in range(60)} == {"train", "val", "test"}


def test_folders_that_are_wrong_are_told(root: Path) -> None:
    with pytest.raises(ValueError, match=r"navsim_logs: no log here; expected .* its folders mini have some"):
        NavsimReader(root / "navsim_logs", root / "maps").index()
    with pytest.raises(ValueError, match=r"nowhere: no such folder or \.pkl file"):
        NavsimReader(root / "nowhere", root / "maps").index()
    with pytest.raises(ValueError, match=r"nowhere: no such folder; clips\.maps .* nuplan-maps-v1\.1\.zip"):
        reader(root, maps=root / "nowhere").index()
    with pytest.raises(ValueError, match=r"nowhere: no such folder; clips\.sensors=null"):
        reader(root, sensors=root / "nowhere").index()
    with pytest.raises(ValueError, match=r"clips\.only: no log gone"):
        reader(root, only=["gone"]).index()
    with pytest.raises(ValueError, match=r"none of the 1 tokens of the scene filter .*few\.yaml is in the logs"):
        reader(root, scene_filter=write_filter(root, tokens=("0" * 16,))).index()
    with pytest.raises(ValueError, match=r"none of the 1 logs that the scene filter .*few\.yaml names is here"):
        reader(root, scene_filter=write_filter(root, log_names=("gone",))).index()


def test_a_city_without_a_map_is_told_before_any_clip_is_read_and_hurts_no_other(root: Path) -> None:
    here = "sg-one-north"
    write_frames(root, "mini", OTHER, [frame(k, OTHER, map_location=here) for k in range(24)])
    index = reader(root).index()
    assert [ref.log_id for ref in index.refs] == [NAME] * 3
    ((ref, problem),) = index.broken.items()
    assert ref.log_id == OTHER and problem.startswith(str(root / "maps" / here)) and "nuplan-maps-v1.1.zip" in problem
    with pytest.raises(BadClip, match=rf"{here}: location: no such folder"):
        reader(root).read(ref)
    chosen = write_filter(root, tokens=(hex16(NAME, 4), hex16(OTHER, 4), hex16(OTHER, 5)))
    assert reader(root, scene_filter=chosen).index().dropped == {}, "its tokens are not absent"
    assert not reader(root, scene_filter=write_filter(root, tokens=(hex16(NAME, 4),))).index().broken
    with pytest.raises(ValueError, match=rf"{here}: location: no such folder; .* nuplan-maps-v1\.1\.zip"):
        reader(root, only=[OTHER]).index()
    (root / "maps" / here / "9").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"sg-one-north: version: .* it must hold one version, it holds \[\]"):
        reader(root, only=[OTHER]).index()


def test_settings_that_cannot_be_are_refused_before_anything_is_read() -> None:
    with pytest.raises(ValueError, match=r"multiple of 0\.5 s"):
        NavsimClips("logs", "maps", stride_s=0.3)
    with pytest.raises(ConfigError, match="stride_s"):
        load_config(["clips=navsim", "clips.root=/logs", "clips.maps=/maps", "clips.stride_s=0.2"])
    assert load_config(["clips=navsim", "clips.root=/logs", "clips.maps=/maps"]).clips["maps"] == "/maps"


def test_a_reader_travels_to_workers_without_its_logs(root: Path) -> None:
    whole = reader(root)
    whole.index()
    assert pickle.loads(pickle.dumps(whole)).index() == whole.index()
