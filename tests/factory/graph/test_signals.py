"""The first SIGTERM or SIGHUP ends a run within 30 s, whatever hangs in it, and the same command goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factory.exits import COMPLETE, INTERRUPTED
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_rows, tables_of
from tests.pages import REPOSITORY

CODE = """
import sys
from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from tests.factory.graph.wild import WildWork
from tests.factory.toy import refs

if __name__ == "__main__":
    out, journal, how, executor = sys.argv[1:]
    work = WildWork(wild=(("log0:0:recovery:0", how),), journal=journal)
    asked = Execution(executor, 2, shard_seconds=0.1)
    ended = execute(work, refs(2), ["recovery", "human"], 1, Store(out), asked)
    sys.exit(ended.exit_code)
"""


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    ("executor", "how", "number", "code"),
    [
        ("local", "compiled loop", signal.SIGTERM, -signal.SIGKILL),
        pytest.param("ray", "compiled loop", signal.SIGHUP, INTERRUPTED, marks=[pytest.mark.ray, pytest.mark.chaos]),
    ],
)
def test_a_first_signal_ends_a_run_that_hangs(
    tmp_path: Path, executor: str, how: str, number: signal.Signals, code: int
) -> None:
    """SIGHUP goes to all of its processes, as from a terminal that closes."""
    script, journal, out = tmp_path / "script.py", tmp_path / "journal", tmp_path / "out"
    script.write_text(CODE)
    words = [sys.executable, str(script), str(out), str(journal), how, executor]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    running = subprocess.Popen(words, env=environment, start_new_session=True)
    while not (journal.exists() and "loop begins" in journal.read_text()):
        assert running.poll() is None
        time.sleep(0.1)
    time.sleep(1.0)  # until it is in the loop
    (os.killpg if number == signal.SIGHUP else os.kill)(running.pid, number)
    began = time.monotonic()
    assert running.wait(60.0) == code
    assert time.monotonic() - began < 30.0
    assert run(out, n=2, rounds=1, experts=["recovery", "human"]).exit_code == COMPLETE
    run(tmp_path / "never", n=2, rounds=1, experts=["recovery", "human"])
    assert_same_rows(tables_of(out)[0], tables_of(tmp_path / "never")[0])
