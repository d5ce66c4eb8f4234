"""Left and right in `show`, words and picture, held to the log's own drive in the world on turns to either side.

x of the world is east and y north, so that a turn to the left is counter-clockwise.
"""

import io
import math
import re
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from factory.commands.table import COMMANDS
from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import write_logs
from factory.run import main as run_main
from factory.store.reader import SampleTable
from factory.views.pictures import EXPERT, LOGGED
from tasks.stages import HUMAN
from tasks.world.clip import NOW
from tasks.world.frames import HEADING, X, Y

show_main = COMMANDS["show"].load()

pytestmark = pytest.mark.slow

ROUNDABOUT, BRANCH = 9, 12  # logs of the town: entered with a turn to the right; a branch that bends to the left
H = 40  # steps
SIDE = {"left": 1.0, "right": -1.0}
EGO_PX, AHEAD_PX, BESIDE_PX = 360, 390, 20  # column of the ego, row of its nose, columns that are clearly beside it
LABEL = (
    r"label +ends \+[\d.]+ m ahead, (?P<aside>[\d.]+) m to the (?P<side>left|right), "
    r"turned (?P<turn>[\d.]+) deg to the (?P<turned>left|right) after 4 s"
)
PERTURBED = r"perturbed by +[+-][\d.]+ m along, (?P<aside>[\d.]+) m to the (?P<side>left|right), "


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    write_logs(folder, (ROUNDABOUT, BRANCH), 0, TownSettings(cameras=(), lidar_beams=0), threads=1)
    return folder


@pytest.fixture(scope="module")
def out(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "out"
    words = ["clips=av2", f"clips.root={logs}", "experts=[human,pdm_closed]", "render=none", "reward.labels=none"]
    assert run_main([*words, "traffic.yields=false", "vocabulary.k=128", "executor=local", f"out={folder}"]) == 0
    return folder


def to_the_left(pose: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """How far the point lies to the left of the pose [m], x, y and heading of both in the world."""
    away = point[[X, Y]] - pose[[X, Y]]
    return float(math.cos(pose[HEADING]) * away[1] - math.sin(pose[HEADING]) * away[0])


def read(pattern: str, text: str) -> tuple[float, Mapping[str, str]]:
    """The distance aside, left positive, and all that the pattern names."""
    (found,) = re.finditer(pattern, text)
    return SIDE[found["side"]] * float(found["aside"]), found.groupdict()


@dataclass(frozen=True)
class Shown:
    """A sample as `show` tells and draws it, and the log that it was made from."""

    row: Mapping[str, Any]
    log: NDArray[np.float64]  # (steps, 11) states of the ego in the world
    text: str
    picture: NDArray[np.int64]  # (720, 720, 3) RGB, the ego pointing up


@pytest.fixture(scope="module")
def samples(logs: Path, out: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Shown]:
    reader, table, folder = AV2Reader(logs), SampleTable(out), tmp_path_factory.mktemp("pictures")
    refs = {ref.clip_id: ref for ref in reader.index().refs}
    found = []
    for i in range(len(table)):
        with redirect_stdout(io.StringIO()) as printed:
            assert show_main([f"out={out}", f"sample={i}", f"to={folder / f'{i}.png'}"]) == 0
        picture = cv2.imread(str(folder / f"{i}.png"))[:720, :720, ::-1].astype(int)
        row = table[i]
        found.append(Shown(row, reader.read(refs[row["clip_id"]]).ego_states, printed.getvalue(), picture))
    return found


def test_the_words_of_a_human_label_are_the_log_s_own_turn(samples: list[Shown]) -> None:
    turns = []
    for sample in samples:
        if sample.row["expert"] != HUMAN:
            continue
        now, end = sample.log[NOW], sample.log[NOW + H]
        aside, words = read(LABEL, sample.text)
        turn = math.degrees(math.remainder(end[HEADING] - now[HEADING], math.tau))
        assert aside == pytest.approx(to_the_left(now, end), abs=0.02)
        assert SIDE[words["turned"]] * float(words["turn"]) == pytest.approx(turn, abs=0.2)
        (command,) = re.findall(r"command (\w+)", sample.text)
        turns.append(("roundabout" in sample.row["log_id"], turn > 15.0, command))
        assert abs(turn) > 15.0
    assert {bends_left for entered, bends_left, _ in turns if entered} == {False}
    assert {bends_left for entered, bends_left, _ in turns if not entered} == {True}
    assert {command for entered, _, command in turns if entered} == {"right"}
    assert {command for entered, _, command in turns if not entered} == {"left", "straight"}  # 20 m ahead and no more


def test_the_words_of_a_perturbation_say_on_which_side_of_the_log_it_ends(samples: list[Shown]) -> None:
    sides = []
    for sample in samples:
        if sample.row["expert"] != HUMAN:
            aside, words = read(PERTURBED, sample.text)
            assert aside == pytest.approx(to_the_left(sample.log[NOW + H], sample.row["now_pose"]), abs=0.01)
            sides.append(words["side"])
    assert sorted(sides) == ["left", "right"]


def test_the_picture_draws_the_label_on_the_side_that_the_words_name(samples: list[Shown]) -> None:
    clearly = {"left": 0, "right": 0}
    for sample in samples:
        _, words = read(LABEL, sample.text)
        colour = LOGGED if sample.row["expert"] == HUMAN else EXPERT
        rows, columns = np.nonzero(np.abs(sample.picture - colour).max(axis=-1) < 12)
        ahead = columns[rows < AHEAD_PX] - EGO_PX
        beside = ahead[abs(ahead) > BESIDE_PX]
        assert (np.sign(beside) == -SIDE[words["side"]]).all(), words
        clearly[words["side"]] += len(beside) > 20
    assert clearly["left"] >= 3 and clearly["right"] >= 3
