"""What the process beside a worker leaves behind."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from factory.graph.guard import OVER, SHOWN_S, read_note
from tests.pages import REPOSITORY

CODE = """
import sys, time
from pathlib import Path
from factory.graph.guard import WatchedProcess

task = {"key": "one", "what": "sleep", "seconds": float(sys.argv[2])}
with WatchedProcess(Path(sys.argv[1]), alone=False).watching(task):
    time.sleep(60.0)
"""


@pytest.mark.slow
def test_what_was_shown_at_work_and_then_ended_is_at_work_no_more(tmp_path: Path) -> None:
    command = [sys.executable, "-c", CODE, str(tmp_path), str(SHOWN_S + 1.5)]
    assert subprocess.run(command, cwd=REPOSITORY).returncode == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == [f"one{OVER}"]
    note = read_note(tmp_path / f"one{OVER}")
    assert note is not None and "at work for more than" in note["why"]
