"""What the process beside a worker leaves behind."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factory.graph.guard import OVER, WORK, read_note
from tests.factory.graph.quick_guard import SHOWN_S, quick_guard
from tests.pages import REPOSITORY

CODE = """
import sys, time
from pathlib import Path
from factory.graph import guard

task = {"key": "one", "what": "sleep", "seconds": float(sys.argv[2])}
guard.__file__ = sys.argv[3]
with guard.WatchedProcess(Path(sys.argv[1]), alone=False).watching(task):
    time.sleep(60.0)
"""


@pytest.mark.slow
def test_what_was_shown_at_work_and_then_ended_is_at_work_no_more(tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    command = [sys.executable, "-c", CODE, str(notes), str(SHOWN_S + 1.5), str(quick_guard(tmp_path))]
    running = subprocess.Popen(command, cwd=REPOSITORY)
    while not (notes / f"one{WORK}").exists():
        assert running.poll() is None, "it was to be shown first"
        time.sleep(0.02)
    assert running.wait(60.0) == -signal.SIGKILL
    assert [path.name for path in notes.iterdir()] == [f"one{OVER}"]
    note = read_note(notes / f"one{OVER}")
    assert note is not None and "at work for more than" in note["why"]
