"""The command, and the run that takes what it found: order, lineage, resume, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory import run
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.readers.settings import TownSettings
from factory.readers.town.reader import SyntheticReader
from factory.store.explored.table import explored_clips, open_explored
from factory.store.location import Location
from factory.store.samples import Store
from factory.views.lineage import lineage
from planners.explore import explore as command
from planners.explore import work
from planners.explore.explore import main
from tasks.drifts import index_of
from tests.planners.faults import fail_once, interrupted_after_one

WITHOUT_SENSORS = ["clips.settings.cameras=[]", "clips.settings.lidar_beams=0"]


class Hasty:
    """Straight on at once and a half its speed, and at 6 m/s at least: late in no town and soon off its roads."""

    digest = "hasty-1"

    def plan(self, sample: dict[str, Any]) -> np.ndarray:
        speed = max(6.0, 1.5 * float(sample["ego_status"][0]))
        return np.column_stack([speed * np.arange(0.5, 4.1, 0.5), np.zeros((8, 2))])


HASTY = "tests.planners.explore.test_explore:Hasty"


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips of a town without sensors, written once."""
    folder = tmp_path_factory.mktemp("towns")
    SyntheticReader(folder, 2, settings=TownSettings(cameras=(), lidar_beams=0, steps_per_photo=1)).index()
    return folder


def clips(towns: Path) -> list[str]:
    return [f"clips.cache_dir={towns}", "clips.n_clips=2", *WITHOUT_SENSORS]


def words(towns: Path, out: Path, *more: str) -> list[str]:
    return [f"planner={HASTY}", "pictures=none", "handover_s=[0,2]", f"out={out}", *clips(towns), *more]


def rows(out: Path) -> list[str]:
    """Of the table, by clip."""
    found = explored_clips(open_explored(Location.parse(out)).read())
    return [str(row) for row in sorted(found, key=lambda row: row.clip_id)]


@pytest.fixture(scope="module")
def explored(towns: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the hasty one drives itself in both clips."""
    out = tmp_path_factory.mktemp("explored")
    assert main(words(towns, out)) == COMPLETE
    return out


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("handover=[0]", "handover"),
        ("handover_s=[0.3]", "handover_s=0.3"),
        ("handover_s=[4.0]", "handover_s=4.0"),
        ("handover_s=[1,1]", "each time once"),
        ("clips.n_clip=1", "clips.n_clip"),
        ("perturb.max_lateral=1", "perturb.max_lateral"),
        ("pictures=photo", "pictures"),
        ("planner=nobody", "planner=nobody"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_nothing_is_written(
    wrong: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"out={tmp_path / 'out'}", "planner=constant_velocity", wrong]) == BAD_CONFIG
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_row_holds_the_drives_and_names_the_planner(explored: Path) -> None:
    found = explored_clips(open_explored(Location.parse(explored)).read())
    assert len(found) == 2
    for row in found:
        assert (row.planner, row.planner_digest) == (HASTY.replace(":", "."), "hasty-1")
        assert len(row.drifts) + sum(row.dropped.values()) == 3
        for one in row.drifts:
            assert np.array(one.ego_states).shape == (41, 11)
            assert 0.0 <= one.score <= 1.0 and bool(one.fails) == (one.fails in one.subscores)
    assert any(row.drifts for row in found)


def test_what_is_explored_is_not_explored_again_and_the_parts_make_the_same_rows(
    towns: Path, explored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[str] = []
    drift = work.drift

    def counted(clip, *arguments):  # type: ignore[no-untyped-def]
        called.append(clip.clip_id)
        return drift(clip, *arguments)

    monkeypatch.setattr(work, "drift", counted)
    assert main(words(towns, tmp_path, "limit=1")) == COMPLETE
    assert len(called) == 3
    assert main(words(towns, tmp_path)) == COMPLETE
    assert len(called) == 6 and len(set(called)) == 2
    assert main(words(towns, tmp_path)) == COMPLETE
    assert len(called) == 6
    assert rows(tmp_path) == rows(explored)


def test_an_interrupted_command_keeps_what_it_has_and_goes_on(
    towns: Path, explored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with interrupted_after_one(command):
        assert main(words(towns, tmp_path)) == INTERRUPTED
    assert "the same command goes on" in capsys.readouterr().err
    assert main(words(towns, tmp_path)) == COMPLETE
    assert rows(tmp_path) == rows(explored)


def test_a_clip_that_cannot_be_explored_is_told_and_the_other_is_kept(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_once(monkeypatch, work, "from_the_log")
    assert main(words(towns, tmp_path)) == COMPLETE_WITH_FAILURES
    assert "1 clips could not be explored" in capsys.readouterr().err
    assert len(rows(tmp_path)) == 1


def test_a_folder_is_of_one_planner_and_one_set_of_settings(
    towns: Path, explored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = rows(explored)
    assert main(words(towns, explored, "planner=constant_velocity")) == BAD_CONFIG
    assert main(words(towns, explored, "perturb.max_lateral_m=1")) == BAD_CONFIG
    assert capsys.readouterr().err.count("choose another out") == 2
    assert rows(explored) == before


@pytest.mark.slow
def test_a_planner_that_looks_is_shown_the_painter_s_pictures(towns: Path, tmp_path: Path) -> None:
    """It drives as fast as they are bright; without pictures it cannot drive, and that is told."""
    small = ["render.width=64", "render.height=36", "handover_s=[2]", "open_loop=false", "limit=1"]
    bright = "planner=tests.planners.drive.looking:Bright"
    assert main(words(towns, tmp_path, *small, bright, "pictures=truth", "perturb.max_longitudinal_m=60")) == COMPLETE
    (row,) = explored_clips(open_explored(Location.parse(tmp_path)).read())
    speeds = [one.end_speed for one in row.drifts]
    assert len(speeds) == 1 and 1.0 < speeds[0] < 10.0
    assert '"pictures":"truth"' in row.settings


def factory_words(towns: Path, out: Path, *more: str) -> list[str]:
    quick = ["experts=[pdm_closed]", "render=none", "reward.labels=none", "vocabulary.k=256", "executor=local"]
    takes_all = ["reward.full=[]", "reward.progress_above=-1", "reward.off_route=false", "reward.after=false"]
    return [*clips(towns), *quick, *takes_all, f"out={out}", *more]


def lists(store: Store) -> dict[str, list[dict[str, Any]]]:
    """clip_id -> its candidates in order."""
    return {row["clip_id"]: row["candidates"] for row in store.candidates.read().to_pylist()}


@pytest.mark.slow
def test_a_run_tries_what_the_planner_fails_at_first_and_its_tables_name_the_planner(
    towns: Path, explored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside a run of the vocabulary alone, whose candidates stay the same and in the same order."""
    assert run.main(factory_words(towns, tmp_path / "plain")) == COMPLETE
    capsys.readouterr()
    words = factory_words(towns, tmp_path / "out", f"explore={explored}", "rounds=99")
    assert run.main(words) == COMPLETE
    assert "explored: " in capsys.readouterr().out
    store, plain = Store(tmp_path / "out"), Store(tmp_path / "plain")
    fails_of = {
        (row.clip_id, index_of(one.number)): one.fails
        for row in explored_clips(open_explored(Location.parse(explored)).read())
        for one in row.drifts
    }
    n_drifts = 0
    for clip_id, candidates in lists(store).items():
        own = [one for one in candidates if one["vocabulary_index"] >= 0]
        assert [one | {"index": 0} for one in own] == [one | {"index": 0} for one in lists(plain)[clip_id]]
        drifted = [one for one in candidates if one["vocabulary_index"] < 0]
        n_drifts += len(drifted)
        failing = [bool(fails_of[clip_id, one["vocabulary_index"]]) for one in drifted]
        n_failing = sum(failing)
        assert failing == sorted(failing, reverse=True)
        assert all(one["vocabulary_index"] < 0 for one in candidates[:n_failing])
    assert n_drifts > 0
    samples = store.samples.read(["attempt_id", "clip_id", "vocabulary_index", "tags"]).to_pylist()
    for row in samples:
        fails = fails_of.get((row["clip_id"], row["vocabulary_index"]))
        expected = [] if fails is None else ["explored", f"explored_{fails}"] if fails else ["explored"]
        assert [tag for tag in row["tags"] if tag.startswith("explored")] == expected
    of_planner = next(row["attempt_id"] for row in samples if row["vocabulary_index"] < 0)
    told = {name: str(value) for _, facts in lineage(store, of_planner) for name, value in facts}
    assert HASTY.replace(":", ".") in told["drift"] and "hasty-1" in told["drift"]
    assert not set(store.samples.keys().tolist()) & set(plain.samples.keys().tolist())

    capsys.readouterr()
    files = sorted(path.name for path in (tmp_path / "out" / "samples").rglob("*.parquet"))
    assert run.main(words) == COMPLETE
    assert sorted(path.name for path in (tmp_path / "out" / "samples").rglob("*.parquet")) == files
    few = factory_words(towns, tmp_path / "few", f"explore={explored}", "sample=targeted", "limit=1")
    assert run.main(few) == COMPLETE
    assert len(lists(Store(tmp_path / "few"))) == 1
    assert "hasty-1" in Store(tmp_path / "few").runs()[0]["settings"]["sample.candidates"]
    assert run.main(factory_words(towns, tmp_path / "out", "rounds=99")) == BAD_CONFIG
    assert "explore.planner" in capsys.readouterr().err


def test_a_run_refuses_what_is_no_planner_s(towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main(factory_words(towns, tmp_path / "out", "explore=planner")) == BAD_CONFIG
    assert "python -m planners explore" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert run.main(factory_words(towns, tmp_path / "out", f"explore={tmp_path / 'empty'}")) == BAD_CONFIG
    assert "no drifts in" in capsys.readouterr().err
    assert not (tmp_path / "out" / "samples").exists()
