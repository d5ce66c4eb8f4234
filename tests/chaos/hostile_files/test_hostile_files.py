"""A hundred crafted files, and those that did harm; the long form: `make chaos`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.chaos.hostile_files.doors import LOGS, SINGLES
from tests.chaos.hostile_files.trials import REPOSITORY, rng_of

pytestmark = pytest.mark.slow

SHORT = ["cases=17", "doors=scenarionet,recovery table,episode,sidecar,picture"]
KEPT = [  # door, number, the attack that the number stands for
    ("scenarionet", 0, ""),
]


def told(to: Path, *words: str) -> list[dict[str, object]]:
    command = [sys.executable, "-m", "tests.chaos.hostile_files", f"to={to}", *words]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (to / "verdicts.jsonl").read_text().splitlines()]


def test_a_hundred_crafted_files_hurt_nobody(tmp_path: Path) -> None:
    verdicts = told(tmp_path, *SHORT)
    assert len(verdicts) == 102 and len({verdict["attack"] for verdict in verdicts}) > 30


def test_what_did_harm_does_none(tmp_path: Path) -> None:
    only = ",".join(f"{door}:{number}" for door, number, _ in KEPT)
    attacks = {(verdict["door"], verdict["number"]): verdict["attack"] for verdict in told(tmp_path, f"only={only}")}
    assert attacks == {(door, number): attack for door, number, attack in KEPT}, "a grammar changed: find others"


def test_a_case_is_the_same_again(tmp_path: Path) -> None:
    for door in ("scenarionet", "picture", "scene spz", "vocabulary"):
        craft = (LOGS.get(door) or SINGLES[door]).craft
        assert craft(tmp_path, rng_of(door, 3)) == craft(tmp_path, rng_of(door, 3))
