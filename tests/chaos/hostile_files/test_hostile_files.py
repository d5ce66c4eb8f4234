"""A hundred crafted files, and those that did harm; the long form: `make chaos`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.chaos.hostile_files.doors import LOGS, SINGLES
from tests.chaos.hostile_files.trials import REPOSITORY, rng_of

pytestmark = pytest.mark.slow

SHORT = ["cases=19", "doors=scenarionet,recovery table,episode,sidecar,picture"]
KEPT = [  # door, number, the attack that the number stands for: what did harm once, or would where a guard is gone
    ("scenarionet", 18, "program: a shared kind"),
    ("recovery table", 9, "npz: bomb"),
    ("episode", 0, "mcap: chunk bomb"),
    ("picture", 5, "png: length"),
    ("picture", 10, "png: 30000 a side"),
    ("scene checkpoint", 4, "checkpoint: empty"),
    ("scene checkpoint", 9, "checkpoint: sparse"),
    ("scene file", 1, "safetensors: tensors"),
]


def told(to: Path, *words: str) -> list[dict[str, object]]:
    command = [sys.executable, "-m", "tests.chaos.hostile_files", f"to={to}", *words]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (to / "verdicts.jsonl").read_text().splitlines()]


def test_a_hundred_crafted_files_and_what_did_harm_hurt_nobody(tmp_path: Path) -> None:
    told(tmp_path, *SHORT)
    more = [f"{door}:{number}" for door, number, _ in KEPT if door == "picture" or door.startswith("scene ")]
    verdicts = told(tmp_path, f"only={','.join(more)}")
    attacks = {(verdict["door"], verdict["number"]): verdict["attack"] for verdict in verdicts}
    assert len(attacks) == 5 * 19 + len(more) and len(set(attacks.values())) > 30
    assert all(attacks[door, number] == attack for door, number, attack in KEPT), "a grammar changed: find others"


def test_a_case_is_the_same_again(tmp_path: Path) -> None:
    for door in ("scenarionet", "picture", "scene spz", "vocabulary"):
        craft = (LOGS.get(door) or SINGLES[door]).craft
        assert craft(tmp_path, rng_of(door, 3)) == craft(tmp_path, rng_of(door, 3))
