"""How signals end a program, and what becomes of it where nobody reads what it prints."""

import fcntl
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from factory.exits import COMPLETE, INTERRUPTED, calling_on_stop_signal
from tests.pages import REPOSITORY

PATIENCE_S = 120.0
BLIND = ("clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none")
QUICK = ("vocabulary.k=64", "reward.labels=none", "experts=[human,recovery]", "executor=local", "shard_seconds=0.001")
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
TRACES = re.compile(r"Traceback|Exception ignored|Error\b")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Setting of the folder that keeps the town of this module's runs."""
    return f"clips.cache_dir={tmp_path_factory.mktemp('towns')}"


@contextmanager
def started(*words: str, package: str = "factory", **how: Any) -> Iterator["subprocess.Popen[str]"]:
    how = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True} | how
    with subprocess.Popen([sys.executable, "-m", package, *words], cwd=REPOSITORY, **how) as command:
        try:
            yield command
        except BaseException:  # a failure is told now, not when the command ends
            command.kill()
            raise


def until(is_so: Callable[[], Any], command: "subprocess.Popen[str]") -> Any:
    """What it is once it is so."""
    end = time.monotonic() + PATIENCE_S
    while not (found := is_so()):
        assert command.poll() is None and time.monotonic() < end, "in vain"
        time.sleep(0.01)
    return found


def child_of(command: "subprocess.Popen[str]", words: str) -> int | None:
    """A process that it has started, with these words in its command line."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            if int(parent) == command.pid and words in (folder / "cmdline").read_text().replace("\0", " "):
                return int(folder.name)
        except OSError:  # it has just ended
            continue
    return None


def has_begun(pid: int | None) -> bool:
    """SIGINT no longer ends the process without a word, as it does before Python has begun."""
    with suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text() if pid else ""
        masks = re.findall(r"^Sig(?:Blk|Ign|Cgt):\s+(\w+)", status, re.M)
        return any(int(mask, 16) >> (signal.SIGINT - 1) & 1 for mask in masks)
    return False


def nobody() -> int:
    """What to write to, with nobody who reads it."""
    read, write = os.pipe()
    os.close(read)
    return write


def shards(out: Path) -> int:
    """Files of samples."""
    return len(list(out.glob("samples/**/*.parquet")))


def test_the_first_signal_is_noted_and_the_second_interrupts() -> None:
    before = signal.default_int_handler  # a shell starts what runs in the background with the signal ignored
    inherited = signal.signal(signal.SIGINT, before)
    asked = threading.Event()
    with calling_on_stop_signal(asked.set), pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        assert asked.wait(5.0)
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(5.0)
    assert signal.signal(signal.SIGINT, inherited) == before


@pytest.mark.parametrize(("before", "times"), [(lambda *_: None, 1), (signal.SIG_IGN, 0)], ids=["terminal", "nohup"])
def test_a_terminal_that_closes_asks_once_however_often_it_is_told_and_never_under_nohup(
    before: Any, times: int
) -> None:
    inherited = signal.signal(signal.SIGHUP, before)
    asked: list[bool] = []
    try:
        with calling_on_stop_signal(lambda: asked.append(True)):
            for _ in range(2):  # the terminal and its shell
                signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN, "also while a report is being written"
    finally:
        signal.signal(signal.SIGHUP, inherited)
    assert len(asked) == times


@pytest.mark.parametrize("then", ["", "\nexcept KeyboardInterrupt: raise AttributeError('half imported') from None"])
def test_an_interrupt_is_one_line_within_code_that_is_made_up_and_where_it_surfaces_as_another_error(then: str) -> None:
    """Python itself ends the one by the signal; the other is what an import of compiled modules makes of it."""
    code = "import signal\nfrom factory.exits import run_program\nrun_program(lambda _: exec({!r}))"
    made_up = f"try: signal.raise_signal(signal.SIGINT){then or chr(10) + 'finally: pass'}"
    done = subprocess.run(
        [sys.executable, "-c", code.format(made_up)], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (INTERRUPTED, "interrupted\n")


LATE = {  # what is left when the exit code is known: a callback, a library's own once Python is gone, a thread for ever
    "callback": "atexit.register(signal.raise_signal, 2)",
    "library": "libc.__cxa_atexit(libc['raise'], ctypes.c_void_p(2), None)",
    "hanging": "threading.Thread(target=press).start()",
}


@pytest.mark.parametrize("moment", LATE)
def test_ctrl_c_once_the_work_is_done_changes_nothing_and_ends_what_hangs(moment: str) -> None:
    code = f"""
import atexit, ctypes, os, signal, threading, time
from factory.exits import run_program
libc = ctypes.CDLL(None)
def press():
    threading.main_thread().join()
    while True:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
{LATE[moment]}
run_program(lambda _: 3)"""
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (3, "")


@pytest.mark.parametrize(
    ("package", "words"),
    [
        ("factory.run", ["--help"]),
        pytest.param("planners", ["serve", "planner=constant_velocity"], marks=pytest.mark.slow),
    ],
)
def test_a_reader_that_leaves_early_changes_no_exit_code(package: str, words: list[str]) -> None:
    with started(*words, package=package, stdout=nobody(), stdin=subprocess.DEVNULL) as command:
        _, said = command.communicate(timeout=PATIENCE_S)
    assert (command.returncode, said) == (COMPLETE, "")


@pytest.mark.slow
@pytest.mark.parametrize("output", ["reader gone", "ASCII alone"])
def test_a_run_has_its_report_and_card_whatever_becomes_of_its_output(tmp_path: Path, town: str, output: str) -> None:
    out = tmp_path / "out"
    words = ("run", "clips.n_clips=1", *BLIND, *QUICK, town, f"out={out}")
    how: dict[str, Any] = {"env": os.environ | ASCII, "stdout": subprocess.PIPE}
    if output == "reader gone":
        how = dict.fromkeys(("stdout", "stderr"), nobody())
    with started(*words, **how) as command:
        told, said = command.communicate(timeout=PATIENCE_S)
    assert command.returncode == COMPLETE, said
    assert (out / "report.html").is_file() and (out / "README.md").is_file()
    if output == "ASCII alone":
        assert "???" in told and f"card: {out}" in told and "Traceback" not in said
        with started("status", f"out={out}", **how) as status:
            assert "???" in status.communicate(timeout=PATIENCE_S)[0] and status.returncode == COMPLETE


@pytest.mark.slow
def test_a_terminal_that_closes_ends_a_run_as_sigterm_does(tmp_path: Path, town: str) -> None:
    out = tmp_path / "out"
    ours, theirs = pty.openpty()
    os.set_blocking(ours, False)

    def begun() -> int:
        with suppress(BlockingIOError):
            os.read(ours, 65536)  # a terminal shows what it is given
        return shards(out)

    words = ("run", "clips.n_clips=24", *BLIND, *QUICK, town, f"out={out}")
    how: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    with started(*words, **how, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) as command:
        os.close(theirs)
        until(begun, command)
        os.close(ours)
        command.wait(PATIENCE_S)
    assert command.returncode == INTERRUPTED
    assert json.loads((out / "last_run.json").read_text())["message"].startswith("interrupted")
    assert (out / "report.html").is_file() and (out / "README.md").is_file()


@pytest.mark.slow
def test_a_run_outlives_its_guard_and_ends_by_a_signal_as_ever(tmp_path: Path, town: str) -> None:
    out = tmp_path / "out"
    with started("run", "clips.n_clips=24", *BLIND, *QUICK, town, f"out={out}") as command:
        os.kill(until(lambda: child_of(command, "guard.py"), command), signal.SIGKILL)
        before = shards(out)
        until(lambda: shards(out) > before + 2, command)
        command.send_signal(signal.SIGINT)
        _, said = command.communicate(timeout=PATIENCE_S)
    assert command.returncode == INTERRUPTED
    assert not TRACES.search(said), said
    assert (out / "report.html").is_file()


RUN = ("run", "render=none", *QUICK)
BEGUN = {  # the command, and a word of the process that it has begun
    "towns": (*RUN, "clips=synthetic_towns", "clips.n_towns=2", "clips.settings.width=64", "town.town"),
    "isolated": (*RUN, "clips.n_clips=1", *BLIND, "graph.isolated=always", "spawn_main"),
    "kernels": (*RUN, "clips.n_clips=1", *BLIND, "factory.stages.warm"),
}


@pytest.mark.slow
@pytest.mark.parametrize("begun", BEGUN)
def test_ctrl_c_in_the_first_seconds_is_one_line(tmp_path: Path, begun: str) -> None:
    """A terminal sends it to every process that runs in it, those that begin among them."""
    *words, process = BEGUN[begun]
    words += [f"clips.cache_dir={tmp_path / 'towns'}", f"out={tmp_path / 'out'}"]
    kernels = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")} if begun == "kernels" else {}
    with started(*words, env=os.environ | kernels) as command:
        until(lambda: has_begun(child_of(command, process)), command)
        os.killpg(command.pid, signal.SIGINT)
        _, said = command.communicate(timeout=PATIENCE_S)
    assert command.returncode == INTERRUPTED
    assert not TRACES.search(said), said
    assert re.match("interrupted|stopped before", said.splitlines()[-1])
