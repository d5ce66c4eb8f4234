"""The command: what it refuses, what it writes, and that it drives nothing twice."""

from pathlib import Path

import pytest

from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.store.location import Location
from planners.drive import drive as command
from planners.drive import work
from planners.drive.drive import main
from planners.drive.settings import settings_of
from planners.drive.work import open_drives
from tests.planners.faults import fail_once, interrupted_after_one

WITHOUT_SENSORS = ["clips.settings.cameras=[]", "clips.settings.lidar_beams=0"]


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town of one log without sensors, written once."""
    folder = tmp_path_factory.mktemp("towns")
    for n_clips in (1, 2):
        SyntheticReader(folder, n_clips, settings=TownSettings(cameras=(), lidar_beams=0, steps_per_photo=1)).index()
    return folder


def words(towns: Path, out: Path, *more: str) -> list[str]:
    """A command of two clips of which each drive takes a second at most."""
    town = [f"clips.cache_dir={towns}", "clips.n_clips=2", *WITHOUT_SENSORS]
    return ["planner=constant_velocity", "bounds=false", "seconds=3", f"out={out}", *town, *more]


def rows(out: Path) -> list[dict[str, object]]:
    """Of the table, by their ids."""
    return sorted(open_drives(Location.parse(out)).read().to_pylist(), key=lambda row: row["drive_id"])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("secnds=3", "secnds"),
        ("seconds=0.1", "seconds=0.1"),
        ("clips.n_clip=1", "clips.n_clip"),
        ("pictures=[photo]", "pictures"),
        ("logged=false", "nothing to drive from"),
        ("films=0", "films=0"),
        ("traffic.mode=fast", "traffic"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_nothing_is_written(
    wrong: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"out={tmp_path / 'out'}", "planner=constant_velocity", wrong]) == BAD_CONFIG
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_unknown_planner_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"out={tmp_path / 'out'}", "planner=nobody"]) == BAD_CONFIG
    assert "planner=nobody" in capsys.readouterr().err


@pytest.mark.slow
def test_what_is_driven_is_not_driven_again(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One clip, then both, then none: the rows of before stay, and the summary is of all that was asked for."""
    driven: list[str] = []
    drive = work.drive

    def counted(start, *arguments):  # type: ignore[no-untyped-def]
        driven.append(start.scene.clip.clip_id)
        return drive(start, *arguments)

    monkeypatch.setattr(work, "drive", counted)
    assert main(words(towns, tmp_path, "limit=1")) == COMPLETE
    first = rows(tmp_path)
    assert len(first) == len(driven) == 1
    assert main(words(towns, tmp_path)) == COMPLETE
    both = rows(tmp_path)
    assert len(both) == len(driven) == 2
    assert str(first[0]) in map(str, both)
    told = capsys.readouterr().out
    assert main(words(towns, tmp_path)) == COMPLETE
    assert len(driven) == 2
    assert capsys.readouterr().out == told[told.rindex("planner ") :]


def test_one_planner_under_two_names_drives_once_and_stands_under_both(towns: Path, tmp_path: Path) -> None:
    asked = [word for word in words(towns, tmp_path, "limit=1") if not word.startswith("planner=")]
    asked.append("planners={a: constant_velocity, b: constant_velocity}")
    settings = settings_of(asked)
    made, failed = command.drive_all(settings)
    assert [row["planner"] for row in made] == ["a", "b"] and failed == []
    assert len(rows(tmp_path)) == 1


def test_other_settings_are_other_drives(towns: Path, tmp_path: Path) -> None:
    """They stand in one table, and what does not depend on a setting is not driven again."""
    assert main(words(towns, tmp_path, "limit=1")) == COMPLETE
    assert main(words(towns, tmp_path, "limit=1", "pdm.max_speed_fraction=1.0", "render.width=64")) in (
        COMPLETE,
        BAD_CONFIG,
    )
    n_before = len(rows(tmp_path))
    for other in ("seconds=2", "controller=nonlinear"):
        assert main(words(towns, tmp_path, "limit=1", other)) == COMPLETE
    assert len(rows(tmp_path)) == n_before + 2


def test_of_some_logs_alone(towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(towns, tmp_path, "only_logs=[town-1-0001-curve]")) == BAD_CONFIG
    assert "only_logs=town-1-0001-curve: none of the 2 clips is of it" in capsys.readouterr().err
    log = command._requested_drives(settings_of(words(towns, tmp_path))).items[0].ref.log_id
    assert len(command._requested_drives(settings_of(words(towns, tmp_path, f"only_logs=[{log}]"))).items) == 2


def test_a_row_holds_the_drive(towns: Path, tmp_path: Path) -> None:
    assert main(words(towns, tmp_path, "limit=1")) == COMPLETE
    (row,) = rows(tmp_path)
    assert (row["planner"], row["pictures"], row["start"]) == ("constant_velocity", "none", -1)
    assert row["duration_s"] == pytest.approx(2.5)
    assert len(row["ego_states"]) == 26 and len(row["ego_states"][0]) == 11  # type: ignore[arg-type, index]
    assert len(row["plans"]) == 5 and len(row["plans"][0]) == 120  # type: ignore[arg-type, index]


def test_a_drive_that_cannot_be_made_is_told_and_the_others_are_kept(
    towns: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_once(monkeypatch, work, "drive")
    assert main(words(towns, tmp_path)) == COMPLETE_WITH_FAILURES
    assert "1 drives or clips could not be driven" in capsys.readouterr().err
    assert len(rows(tmp_path)) == 1
    assert main(words(towns, tmp_path)) == COMPLETE
    assert len(rows(tmp_path)) == 2


def test_an_interrupted_command_keeps_what_it_has_and_goes_on(
    towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with interrupted_after_one(command):
        assert main(words(towns, tmp_path)) == INTERRUPTED
    assert "the same command goes on" in capsys.readouterr().err
    assert len(rows(tmp_path)) == 1
    assert main(words(towns, tmp_path)) == COMPLETE
    assert len(rows(tmp_path)) == 2


@pytest.mark.slow
def test_processes_make_the_rows_that_one_makes(towns: Path, tmp_path: Path) -> None:
    assert main(words(towns, tmp_path / "one", "perturbed=1")) == COMPLETE
    assert main(words(towns, tmp_path / "two", "perturbed=1", "workers=2")) == COMPLETE
    assert str(rows(tmp_path / "one")) == str(rows(tmp_path / "two"))
    assert {row["start"] for row in rows(tmp_path / "one")} == {-1, 0}
