"""Eighty crafted files, and those that did harm; the long form: `make chaos`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.chaos.hostile_files.__main__ import crafted
from tests.pages import REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]  # 25 s of CPU time, which a busy machine spreads

SHORT = ("recovery table", "episode", "sidecar", "picture", "picture of a batch")  # 16 cases of each
KEPT = {  # door and number: the attack that it stands for; it did harm once, or would where a guard is gone
    ("scenarionet", 18): "program: a shared kind",
    ("recovery table", 9): "npz: bomb",
    ("episode", 0): "mcap: chunk bomb",
    ("picture", 5): "png: length",
    ("picture", 10): "png: 30000 a side",
    ("scene checkpoint", 4): "checkpoint: empty",
    ("scene checkpoint", 9): "checkpoint: sparse",
    ("scene file", 1): "safetensors: tensors",
}


SOME = [(door, n) for door in SHORT for n in range(16)]


@pytest.mark.parametrize("cases", [pytest.param(SOME, marks=pytest.mark.long), [*KEPT]], ids=["some", "kept"])
def test_crafted_files_hurt_nobody(cases: list[tuple[str, int]], tmp_path: Path) -> None:
    only = ",".join(f"{door}:{n}" for door, n in cases)
    command = [sys.executable, "-m", "tests.chaos.hostile_files", f"to={tmp_path}", f"only={only}"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    verdicts = [json.loads(line) for line in (tmp_path / "verdicts.jsonl").read_text().splitlines()]
    attacks = {(verdict["door"], verdict["number"]): verdict["attack"] for verdict in verdicts}
    assert attacks.keys() == set(cases)
    assert all(attacks[case] == KEPT.get(case, attacks[case]) for case in cases), "a grammar changed: find others"


def test_a_case_is_the_same_again(tmp_path: Path) -> None:
    for door in ("scenarionet", "picture", "scene spz", "vocabulary"):
        assert crafted(door, tmp_path, 3) == crafted(door, tmp_path, 3)
