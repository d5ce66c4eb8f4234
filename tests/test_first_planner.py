"""The tutorial of a first planner: its own commands end with a sentence that says what came out."""

import csv
import re
from pathlib import Path

import pytest

from factory.__main__ import main as factory
from factory.run import main as run
from factory.setup.vocabulary import load_recovery_table
from planners.__main__ import main as planners
from tasks.kernels.compiled import cache_dir
from tests.first_planner import page_commands

TENTH = [
    "clips.n_towns=2",
    "clips.logs_per_town=2",
    "rounds=1",
    "executor=local",
    "steps=10",
    "perturbed=0",
    "workers=1",
]
PROGRAMS = {"factory": factory, "factory.run": run, "planners": planners}  # in this process
NUMBER = r"([\d.]+)(?: %)?"
CLAIM = rf"{NUMBER} against {NUMBER}, ([+-][\d.]+) \(95 % over 2 towns: .*?\), (?:better|worse|no difference .*?)"


@pytest.mark.slow
def test_the_page_s_own_commands_end_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of a tenth of the page's samples, or less; its numbers are those of the tables."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache_dir().parent))  # a cache of its own, but no second compilation
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for _, _, program, *words in page_commands(TENTH):
        assert not PROGRAMS[program](words), capfd.readouterr().err
    last = capfd.readouterr().out.splitlines()[-1]
    said = re.fullmatch(rf"mixed against real: two-stage EPDMS {CLAIM}; scene scores driven {CLAIM}", last)
    assert said, last
    first = tmp_path / "runs" / "first"
    with (first / "scores" / "summary.csv").open() as file:
        lines = {(row["planner"], row["stage"], row["human_filter"]): row for row in csv.DictReader(file)}
    final = [100.0 * float(lines[name, "final", "unfiltered"]["score"]) for name in ("mixed", "real")]
    assert [f"{score:.1f}" for score in final] == [said[1], said[2]]
    assert len(load_recovery_table(first / "recovery.npz")) > 0


def test_what_no_command_has_is_refused_and_what_is_shown_for_a_user_s_logs_is_not_run() -> None:
    assert all("steps=7" in words for words in page_commands(["steps=7"]) if "train" in words)
    assert not any("/data/" in word for words in page_commands([]) for word in words)
    with pytest.raises(ValueError, match="stepps=7: no command"):
        page_commands(["stepps=7"])
