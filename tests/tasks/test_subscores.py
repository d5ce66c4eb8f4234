"""A sub-score is its record and its rule: all else follows, shown on a copy of the tree that has one more."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tasks.reward import epdms
from tasks.reward.epdms import N_ROWS, score
from tasks.subscores import HALVES, LABELLED, MULTIPLIERS, RECORDS, SUBSCORES, WEIGHTS, WHOLES
from tests.tasks.reward.straight_street import drive, street

ROOT = Path(__file__).resolve().parents[2]
ADDED = {  # file -> where, and what is put before it: a record; its rule, a row for it, and the call
    "tasks/subscores.py": {
        '    SubScore("ec"': '    SubScore("sl", "speed_limit_compliance", "2m", "drove too fast", 3.0),\n',
    },
    "tasks/reward/epdms.py": {
        "_WHOLES = ": 'SL = LABELLED.index("sl")\n',
        "    for row in _WHOLES:": "    out.fails[SL, k] = _first_above(states, 15.0)\n",
        "@hidden_kernel\ndef _first_with(": """@kernel
def _first_above(states: Array, speed_mps: float) -> float:
    for t in range(len(states)):
        if math.hypot(states[t, 3], states[t, 4]) > speed_mps:
            return float(t)
    return math.inf


""",
    },
}


def docs_table() -> str:
    """The Markdown table of docs/reward.md 2."""
    lines = [
        "| name | in the public code | values | in the score | rule | when it is wrong |\n|---|---|---|---|---|---|\n"
    ]
    for record in sorted(RECORDS, key=lambda record: record.section):
        values = ", ".join(f"{level:g}" for level in record.levels) or "0 .. 1"
        part = "multiplies" if record.weight is None else f"weighs {record.weight:g}"
        what = f"| {record.name.upper()} | `{record.long_name}` | {values} | {part} "
        lines.append(f"{what}| {record.section} | {record.wrong} |\n")
    return "".join(lines)


def test_the_table_in_docs_is_that_of_the_records() -> None:
    page = (ROOT / "docs/reward.md").read_text()
    assert docs_table() in page, f"docs/reward.md is behind: put this there:\n{docs_table()}"
    headings = dict(re.findall(r"^### (2[a-z])\. (\w\w\w?), ", page, re.MULTILINE))
    assert headings == {record.section: record.name.upper() for record in RECORDS}


def test_orders_and_bits_are_those_that_were_written() -> None:
    assert (*MULTIPLIERS, *WEIGHTS) == ("nc", "dac", "tlc", "ddc", "ep", "ttc", "lk", "hc")  # of evaluations' columns
    assert SUBSCORES == ("nc", "dac", "ddc", "tlc", "ep", "ttc", "lk", "hc", "ec")  # of a sample's columns
    assert (*HALVES, *WHOLES) == ("nc", "ddc", "dac", "tlc", "ttc", "lk", "hc")  # of a label's planes
    assert LABELLED == ("nc", "dac", "ddc", "tlc", "ttc", "lk", "hc", "ep")  # of the heads, which are drawn in turn


def test_a_record_without_a_rule_is_no_score(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(epdms, "N_ROWS", N_ROWS + 1)
    monkeypatch.setattr(epdms, "Scores", lambda *columns: columns)
    *known, new, _ = score(street(), drive(8.0))  # type: ignore[misc]
    assert np.isnan(new).all() and not np.isnan(known).any()


@pytest.mark.slow
def test_a_sub_score_is_added_by_its_record_and_its_rule(tmp_path: Path) -> None:
    """Kernels are interpreted: two drives take less time than compiling all rules."""
    for name in ("tasks", "factory", "planners", "conf", "tests"):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name, places in ADDED.items():
        text = (tmp_path / name).read_text()
        for before, new in places.items():
            assert text.count(before) == 1, f"{name}: {before}"
            text = text.replace(before, new + before)
        (tmp_path / name).write_text(text)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "tests.tasks.with_one_more"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["sl", "is", "everywhere"]
