"""The tutorials' commands, run from the pages' own text on the real logs, print what the pages show.

Those of docs/tutorials/first_planner.md: tests/test_first_planner.py, of docs/tutorials/cluster.md:
tests/factory/test_job_submit.py.
"""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from examples.csv_logs import write_log
from factory.__main__ import main as door_main
from factory.run import main as run_main
from tests.pages import REPOSITORY, Command, commands

pytestmark = pytest.mark.slow

PROGRAMS: dict[str, Callable[[list[str]], int | None]] = {
    "factory": door_main,
    "factory.run": run_main,
    "examples.csv_logs": lambda words: write_log(Path(words[0]) / "street"),
}
LEFT_OUT = {"runs/demo", "preset=demo", "root=/data/nuscenes", "clips.cameras=/data/photos"}  # tests/test_readme.py
HERE = "executor=local"
TINY_TOWN = f"{HERE} clips.n_clips=1 clips.settings.cameras=[ring_front_center] clips.settings.width=64 "
TINY_TOWN += "clips.settings.height=36 clips.settings.lidar_azimuths=200 clips.settings.steps_per_photo=5"
TINY = f"{HERE} limit=1 rounds=1 render.width=64 render.height=36 render.fit.iterations=20 render.psnr_min=0 "
TINY += "render.gate.enabled=false render.cameras=[] vocabulary.k=64 render.fit.start_gaussians=2000 "
TINY += "render.fit.most_gaussians=2500 render.fit.start_every=2 render.fit.stereo_photos=2"
CHEAPER = {  # of a command with these words; the others are run as they are, and what they print is compared
    "rounds=3": f"{HERE} limit=2",
    "clips=synthetic": TINY_TOWN,
    "<town>": TINY,
    "/data/av2/sensor/train": TINY,
    "scene build": "width=96 render.fit.iterations=60 render.fit.start_every=4 render.fit.start_gaussians=4000",
}
# Lines of outputs but those with a rate.
COMPARED = re.compile(r"(human|pdm_closed|recovery) +\d|clips: |clips prepared|  filtered|vocabulary|experts|executed")
OF_A_SAMPLE = re.compile(r"(sample|clip|expert|perturbed by|label|world) {3}|scores|  +perturbed|  +driven")

OF_A_SCENE = re.compile(r"(block|sensors at|drawn) {2}|(CAM_FRONT|ego): moved")  # the rest hangs on the pictures' size

CONTINUED = re.compile(r" *│\n│( +│)+ +")  # a cell on a second line


def words_of(line: str) -> str:
    """Without the frames and spaces of a table."""
    return " ".join(re.sub("[│┃]", " ", line).split())


class Follower:
    """Somebody who follows a page in a folder of their own, with real logs where it has /data."""

    def __init__(self, page: str, capsys: pytest.CaptureFixture[str]) -> None:
        self.page, self._capsys = page, capsys
        left = [one for one in commands(page) if not any(out in word for word in one.words for out in LEFT_OUT)]
        self.commands = [one for one in left if one.words[0] == "python"]
        self.said = ""

    def runs(self, command: Command, folders: dict[str, Path]) -> None:
        _, _, program, *words = command.words
        more = next((given for named, given in CHEAPER.items() if named in str(command)), "").split()
        more += ["graph.isolated=never"] if program == "factory.run" else []  # a process more for each
        for named, there in folders.items():
            words = [word.replace(named, str(there)) for word in words]
        last = {word.partition("=")[0]: word for word in (*words, *more)}
        assert not PROGRAMS[program]([*last.values()]), (str(command), self._capsys.readouterr().err)
        self.said += "".join(self._capsys.readouterr())

    def was_told(self, compared: "re.Pattern[str]") -> list[str]:
        """What the page shows and nobody printed, of how many lines."""
        shown = "".join(re.findall(r"^```text\n(.*?)^```$", (REPOSITORY / self.page).read_text(), re.M | re.S))
        lines = [words_of(line) for line in shown.splitlines() if compared.match(line)]
        said = [words_of(line) for line in CONTINUED.sub(" ", self.said).splitlines()]
        assert len(lines) > 3
        return [line for line in lines if not any(line in one for one in said)]


def test_nuscenes_from_download_to_first_sample(
    shared_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    follower = Follower("docs/tutorials/nuscenes.md", capsys)
    for command in follower.commands:
        follower.runs(command, {"/data/scenarionet/nuscenes": shared_root / "data" / "scenarionet" / "nuscenes"})
    assert follower.was_told(COMPARED) == []
    assert "64 of 180 windows" in follower.said
    (shown,) = re.findall(r"^sample +(\w{16})$", (REPOSITORY / follower.page).read_text(), re.M)
    # By its id: which sample is the first differs from machine to machine.
    assert door_main(["show", "out=runs/nuscenes", f"sample={shown}", "to=."]) == 0
    follower.said += capsys.readouterr().out
    assert follower.was_told(OF_A_SAMPLE) == []


def test_argoverse_2_with_cameras(
    shared_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    follower = Follower("docs/tutorials/av2_cameras.md", capsys)
    folders = {"/data/av2/sensor/val": shared_root / "data" / "av2" / "sensor" / "val"}
    for command in follower.commands:
        for town in tmp_path.glob("runs/towns/*"):
            folders |= {"runs/towns/<town>": town, "/data/av2/sensor/train": town}
        follower.runs(command, folders)
    assert follower.was_told(COMPARED) == []


def test_your_own_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    follower = Follower("docs/tutorials/your_own_logs.md", capsys)
    for command in follower.commands:
        follower.runs(command, {})
    assert follower.was_told(COMPARED) == []


def test_a_scene_from_photos_alone(
    shared_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    follower = Follower("docs/tutorials/photos.md", capsys)
    for command in follower.commands:
        follower.runs(command, {"/data/nuscenes_front": shared_root / "data" / "nuscenes_front"})
    assert follower.was_told(OF_A_SCENE) == []
    assert {path.name for path in Path("runs").iterdir()} == {"street", "street.mp4", "street.scene"}
