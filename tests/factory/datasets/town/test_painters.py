"""Towns with sensors are written by processes side by side: the same bytes, whole or not at all."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import TownFolder, write_town_folder, write_towns

SMALL = TownSettings(cameras=("ring_front_center",), width=32, height=18, photo_steps=16, lidar_beams=0)
PATIENCE_S = 60.0


def towns_in(folder: Path) -> list[TownFolder]:
    return [TownFolder(seed, (2,), folder / f"town-{seed}") for seed in (5, 6)]


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)


@pytest.mark.slow
def test_towns_painted_side_by_side_have_the_bytes_of_one_painted_here(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    towns, here = towns_in(tmp_path / "beside"), towns_in(tmp_path / "here")[1]
    write_towns(towns, SMALL)
    assert "town 2 of 2" in capfd.readouterr().err
    write_town_folder(here, SMALL)
    capfd.readouterr()
    files = [path.relative_to(here.root) for path in sorted(here.root.rglob("*")) if path.is_file()]
    assert sum(path.suffix == ".jpg" for path in files) == 4
    for path in files:
        assert (here.root / path).read_bytes() == (towns[1].root / path).read_bytes()
    assert sorted(path.name for path in (tmp_path / "beside").iterdir()) == ["town-5", "town-6"]
    write_towns(towns, SMALL)
    assert not capfd.readouterr().err, "what is there is not written again"


@pytest.mark.slow
def test_a_town_that_cannot_be_written_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "town-5").write_text("no folder")
    with pytest.raises(NotADirectoryError, match=f"{tmp_path}/.*town-5"):
        write_towns(towns_in(tmp_path), SMALL)
    assert "Traceback" not in capfd.readouterr().err
    assert not list(tmp_path.glob(".town-*"))


@pytest.mark.slow
def test_a_painter_that_dies_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match=r"town [56]: its process ended with exit 1"):
        write_towns([replace(town, indices=("no log",)) for town in towns_in(tmp_path)], SMALL)
    assert "TypeError" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


INTERRUPTED = """
import os, signal, sys
from pathlib import Path
from factory.datasets.town.town import TownFolder, write_towns
from factory.datasets.town.settings import TownSettings
signal.signal(signal.SIGTERM, signal.default_int_handler)
signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the processes it starts, too
os.cpu_count = lambda: 2
write_towns([TownFolder(seed, (0, 1, 2, 3), Path(sys.argv[1]) / f"town-{seed}") for seed in (5, 6)], TownSettings())
"""


def begun_in(folder: Path) -> "subprocess.Popen[str]":
    """The command, with both towns begun."""
    command = subprocess.Popen([sys.executable, "-c", INTERRUPTED, str(folder)], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE_S
    while len(list(folder.glob(".town-*/*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(list(folder.glob(".town-*/*"))) == 2
    return command


@pytest.mark.slow
def test_an_interrupted_command_leaves_nothing_unfinished_whatever_its_processes_hear(tmp_path: Path) -> None:
    with begun_in(tmp_path) as command:
        command.send_signal(signal.SIGTERM)
        _out, said = command.communicate(timeout=PATIENCE_S)
    assert command.returncode != 0
    assert "KeyboardInterrupt" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_processes_end_with_a_command_that_is_killed(tmp_path: Path) -> None:
    with begun_in(tmp_path) as command:
        command.kill()
        command.communicate(timeout=PATIENCE_S)  # their stderr is its own: it ends with the last of them
    assert not list(tmp_path.glob("town-*"))
