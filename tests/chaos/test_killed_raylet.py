"""A raylet that dies in the middle of a run: on a cluster of its own the run goes on by itself, three times at most."""

import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from factory.exits import INTERRUPTED, calling_on_stop_signal
from factory.graph import own_process
from factory.graph.execute import Execution, execute
from factory.graph.own_process import run_in_own_process
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.killed_driver import EXPERTS
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, refs
from tests.pages import REPOSITORY

RUN = """
import sys
from factory.graph import driver
from factory.graph.execute import Execution, execute, rerun_on_new_clusters
from factory.graph.on_ray.graph import ray
from factory.store.samples import Store
from tests.chaos.killed_driver import EXPERTS
from tests.factory.toy import ToyWork, refs

seen = []

def killing(kind, name, at):
    honest = getattr(kind, name)

    def method(self, *given, **named):
        seen.append(given)
        if len(seen) == at:
            ray._private.worker._global_node.all_processes["raylet"][0].process.kill()
        return honest(self, *given, **named)

    setattr(kind, name, method)

killing(driver.RunDriver, "_take_attempt", 6)
store, how = Store(sys.argv[1]), Execution("ray", 1, shard_seconds=0.05)
ended = rerun_on_new_clusters(lambda: execute(ToyWork(), refs(5), EXPERTS, 2, store, how))
sys.exit(ended.exit_code)
"""
TOWN = (
    "clips.n_clips=1",
    "experts=[human]",
    "clips.settings.cameras=[]",
    "clips.settings.lidar_beams=0",
    "render=none",
)
TOWN += ("vocabulary.k=128", "workers=1")


def left_of(mark: str) -> list[str]:
    """Processes that were given this environment, once they had a minute to end; Python's own helper left out."""
    end = time.monotonic() + 60.0
    while True:
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # gone meanwhile
                if mark.encode() in (folder / "environ").read_bytes():
                    found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        found = [line for line in found if "resource_tracker" not in line]
        if not found or time.monotonic() > end:
            return found
        time.sleep(0.1)


def ended_by_ray(journal: Path, begun: int, tell: Callable[[str], None]) -> int:
    """A driver as Ray ends it, with a process of its cluster beside it and a new cluster begun in it at first."""
    with journal.open("a") as file:
        print(begun, file=file)
    subprocess.Popen(["sleep", "1000"])
    if begun == 0:
        tell("a new cluster")
    os._exit(1)


@pytest.mark.slow
@pytest.mark.parametrize("is_ours", [True, False])
def test_a_command_whose_clusters_all_die_ends_with_a_line(
    tmp_path: Path, is_ours: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MARK", mark := secrets.token_hex(16))
    said = list[str]()
    assert run_in_own_process(partial(ended_by_ray, tmp_path / "begun"), is_ours, said.append) == INTERRUPTED
    begun = (tmp_path / "begun").read_text().split()
    assert begun == (["0", "2", "3"] if is_ours else ["0"]), "one was begun in the process itself"
    assert [line[-6:] for line in said] == (["2 of 3", "3 of 3"] if is_ours else [])
    (line,) = capsys.readouterr().err.splitlines()
    assert "raylet" in line and "run the same command again" in line
    monkeypatch.delenv("MARK")
    assert left_of(mark) == []


def hangs(begun: int, tell: Callable[[str], None]) -> int:
    """As Ray does where it connects to a head node that has just died."""
    threading.Event().wait()
    return 0


@pytest.mark.slow
def test_a_run_on_a_head_node_that_is_silent_ends_with_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and nobody listens
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{taken.getsockname()[1]}")
        monkeypatch.setattr(own_process, "LOST_S", 0.5)
        monkeypatch.setattr(own_process, "LOOK_S", 0.1)
        assert run_in_own_process(hangs, False, print) == INTERRUPTED
    (line,) = capsys.readouterr().err.splitlines()
    assert "has not answered for" in line and "run the same command again" in line


def ends(how: str, begun: int, tell: Callable[[str], None]) -> int:
    match how:
        case "code":
            return 3
        case "bug":
            raise RuntimeError("a bug of ours")
        case "asked":
            sys.exit(signal.SIGTERM)  # as Ray's handler of that does
        case _:
            os.kill(os.getpid(), signal.SIGKILL)
            return 0


def waits(journal: str, begun: int, tell: Callable[[str], None]) -> int:
    """Until it is asked to stop, with a process of its cluster beside it."""
    asked = threading.Event()
    subprocess.Popen(["sleep", "1000"])
    with calling_on_stop_signal(asked.set):
        Path(journal).write_text(str(os.getpid()))
        assert asked.wait(100.0)
    return INTERRUPTED


APART = """
import sys
from functools import partial
from factory.graph.own_process import run_in_own_process
from tests.chaos.test_killed_raylet import ends, waits

if __name__ == "__main__":
    sys.exit(run_in_own_process(partial({"ends": ends, "waits": waits}[sys.argv[1]], sys.argv[2]), True, print))
"""


@pytest.mark.slow
def test_a_command_ends_as_its_run_did(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(APART)
    how: dict[str, Any] = {"env": os.environ | {"PYTHONPATH": str(REPOSITORY)}, "text": True}
    how |= dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    codes = {"code": 3, "bug": 1, "asked": INTERRUPTED, "killed": -signal.SIGKILL}
    running = {word: subprocess.Popen([sys.executable, str(script), "ends", word], **how) for word in codes}
    for word, process in running.items():
        told, said = process.communicate(timeout=100)
        assert process.returncode == codes[word] and "new cluster" not in told
        assert said.count("RuntimeError: a bug of ours") == (word == "bug"), said
        assert said.count("run the same command again") == (word == "asked"), said


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, INTERRUPTED), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_signal_to_the_command_reaches_its_run(tmp_path: Path, number: signal.Signals, code: int) -> None:
    script, journal, mark = tmp_path / "script.py", tmp_path / "journal", secrets.token_hex(16)
    script.write_text(APART)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "MARK": mark}
    running = subprocess.Popen([sys.executable, str(script), "waits", str(journal)], env=environment)
    while not (journal.exists() and journal.read_text()):
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(number)
    assert running.wait(100.0) == code
    assert left_of(mark) == []


@pytest.mark.ray
@pytest.mark.slow
def test_a_run_goes_on_where_its_own_raylet_dies(tmp_path: Path) -> None:
    words = [sys.executable, "-c", RUN, str(tmp_path / "out")]
    done = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert done.stdout.count("a new cluster is started") == 1 and "Ray's raylet died" in done.stdout
    execute(ToyWork(), refs(5), EXPERTS, 2, Store(tmp_path / "plain"), Execution("local"), say=lambda line: None)
    assert_same_tables(tmp_path / "out", tmp_path / "plain")
    assert verify(Store(tmp_path / "out")).damage == ()
