"""A run of logs of which two are broken: the other's samples are there, and the failures are counted."""

from pathlib import Path

import pytest

from factory.exits import COMPLETE_WITH_FAILURES
from factory.run import main as run
from factory.store.reader import SampleTable
from tests.factory.datasets.navsim.logs import NAME
from tests.factory.datasets.navsim.openscene_writer import hex16
from tests.factory.datasets.navsim.small import CITY, road_frames, write_city, write_log

BROKEN = "2021.06.14.18.00.00_veh-51_00100_00200"
NAMELESS = "2021.06.14.18.00.00_veh-51_00200_00300"


@pytest.mark.slow
def test_a_log_that_is_cut_off_or_names_no_track_is_a_failed_clip_and_the_others_are_sampled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_city(tmp_path)
    write_log(tmp_path, road_frames())
    path = write_log(tmp_path, road_frames(BROKEN))
    path.write_bytes(path.read_bytes()[:-500])
    frames = road_frames(NAMELESS)
    for k, at in ((4, 0), (12, 1)):  # two objects, a car and a cone, that would be one
        frames[k]["anns"]["track_tokens"][at] = None
    nameless = write_log(tmp_path, frames)
    words = ["clips=navsim", f"clips.root={tmp_path / 'navsim_logs' / 'mini'}", f"clips.maps={tmp_path / 'maps'}"]
    words += [f"clips.cache_dir={tmp_path / 'kept'}", "render=none", "vocabulary.k=64", "experts=[human]"]
    out = tmp_path / "out"
    assert run([*words, "executor=local", f"out={out}"]) == COMPLETE_WITH_FAILURES
    said = capsys.readouterr().out
    assert "2 failed (input 2)" in said and f"{path}: pickle: truncated or not a pickle" in said
    assert f"{nameless}: frames[4].anns.track_tokens: holds None, expected text" in said
    (row,) = SampleTable(out).iterate()
    assert (row["log_id"], row["expert"], row["command"]) == (NAME, "human", "straight")
    assert row["frame_tokens"] == [hex16(NAME, 3), hex16(NAME, 11)] and row["map_location"] == CITY
