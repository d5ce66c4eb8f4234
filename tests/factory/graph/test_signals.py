"""The first SIGTERM ends a run within 30 s, whatever hangs in it, and the same command goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factory.exits import COMPLETE
from factory.graph.guard import KILLED_S
from tests.factory.graph.quick_guard import quick_guard
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_rows, tables_of
from tests.pages import REPOSITORY

CODE = """
import sys
from factory.graph import guard
from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from tests.factory.graph.wild import WildWork
from tests.factory.toy import refs

if __name__ == "__main__":
    out, journal, guard.__file__ = sys.argv[1:]
    work = WildWork(wild=(("log0:0:recovery:0", "compiled loop"),), journal=journal)
    asked = Execution("local", shard_seconds=0.1)
    ended = execute(work, refs(2), ["recovery", "human"], 1, Store(out), asked)
    sys.exit(ended.exit_code)
"""


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_a_first_signal_ends_a_run_that_hangs(tmp_path: Path) -> None:
    script, journal, out = tmp_path / "script.py", tmp_path / "journal", tmp_path / "out"
    script.write_text(CODE)
    words = [sys.executable, str(script), str(out), str(journal), str(quick_guard(tmp_path))]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    running = subprocess.Popen(words, env=environment)
    while not (journal.exists() and "loop begins" in journal.read_text()):
        assert running.poll() is None
        time.sleep(0.1)
    time.sleep(1.0)  # until it is in the loop
    running.send_signal(signal.SIGTERM)
    began = time.monotonic()
    assert running.wait(60.0) == -signal.SIGKILL
    assert time.monotonic() - began < KILLED_S < 30.0
    assert run(out, n=2, rounds=1, experts=["recovery", "human"]).exit_code == COMPLETE
    run(tmp_path / "never", n=2, rounds=1, experts=["recovery", "human"])
    assert_same_rows(tables_of(out)[0], tables_of(tmp_path / "never")[0])
