"""executor=local in a process of its own: the rows of any other run, whatever a plug-in does to its process."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from factory.config.run import load_config
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.guard import CRASHED
from factory.graph.local import MAX_RETRIES, Limits, TaskDurations, notes_folder
from factory.run import needs_own_process
from factory.store.samples import Store
from tests.factory.graph.runs import run
from tests.factory.graph.wild import WildWork
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of
from tests.factory.toy import ran
from tests.pages import REPOSITORY

ONE = "log0:0:recovery:0"


def arrived(journal: str, large: bytes) -> "DyingAtFirst":
    """In the process that is given the work: which is killed there the first time."""
    if not Path(journal).exists():
        Path(journal).write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return DyingAtFirst(journal=journal)


class DyingAtFirst(WildWork):
    """Larger than what a pipe holds."""

    def __reduce__(self) -> tuple[object, tuple[str, bytes]]:
        return arrived, (self.journal, bytes(2**20))


def failed_in(out: Path) -> list[tuple[str, str]]:
    """Kind and error of every failed row."""
    return [(o["error_kind"], o["error"]) for o in tables_of(out)[1] if o["kind"] == "failed"]  # type: ignore[index]


@pytest.mark.slow
def test_a_process_of_its_own_makes_the_same_rows(tmp_path: Path, plain: Callable[..., Path]) -> None:
    assert run(tmp_path / "out", isolated=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


@pytest.mark.slow
def test_a_process_that_dies_before_it_is_ready_is_begun_anew(tmp_path: Path, plain: Callable[..., Path]) -> None:
    assert run(tmp_path / "out", DyingAtFirst(journal=str(tmp_path / "journal")), isolated=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


@pytest.mark.slow
@pytest.mark.parametrize("how", ["segfault", "os._exit"])
def test_a_process_that_dies_costs_its_own_attempt_and_no_other(
    tmp_path: Path, plain: Callable[..., Path], how: str
) -> None:
    assert run(tmp_path / "out", WildWork(wild=((ONE, how),)), isolated=True).exit_code == COMPLETE_WITH_FAILURES
    ((kind, error),) = failed_in(tmp_path / "out")
    said = {"segfault": "by signal SIGSEGV", "os._exit": "with exit code 0"}[how]
    assert kind == "system" and f"{said} at drive+render+label, {1 + MAX_RETRIES} times" in error
    assert run(tmp_path / "out").exit_code == COMPLETE
    assert_same_rows(tables_of(tmp_path / "out")[0], tables_of(plain())[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "limits", "why"),
    [
        ("loop", Limits(seconds={"drive": 1.0, "render": 0.0, "label": 0.0}), "at work for more than 1 s"),
        ("memory", Limits(gb={"drive": 1.0, "render": 1.0, "label": 1.0}), "more than 1.0 GB"),
    ],
)
def test_what_is_over_its_limits_is_ended_and_says_where_it_stood(
    tmp_path: Path, plain: Callable[..., Path], how: str, limits: Limits, why: str
) -> None:
    journal = str(tmp_path / "journal")
    work = WildWork(wild=((ONE, how),), journal=journal)
    assert run(tmp_path / "out", work, isolated=True, limits=limits).exit_code == COMPLETE_WITH_FAILURES
    ((kind, error),) = failed_in(tmp_path / "out")
    assert kind == "limit" and why in error and "wild.py" in error and "in drive" in error
    assert ran(journal, "loop") == (how == "loop"), "once a run"
    assert not notes_folder(Store(tmp_path / "out").location).exists()
    assert run(tmp_path / "out").exit_code == COMPLETE, "the next run tries it again by itself"
    assert_same_rows(tables_of(tmp_path / "out")[0], tables_of(plain())[0])


@pytest.mark.slow
@pytest.mark.parametrize("isolated", [False, True])
def test_who_leaves_by_sys_exit_or_changes_what_others_are_given_has_a_bug_and_the_run_goes_on(
    tmp_path: Path, plain: Callable[..., Path], isolated: bool
) -> None:
    work = WildWork(wild=((ONE, "sys.exit"), ("log1:1000:recovery:0", "mutate")))
    assert run(tmp_path / "out", work, isolated=isolated).exit_code == COMPLETE_WITH_FAILURES
    (left, leaving), (changed, changing) = sorted(failed_in(tmp_path / "out"), key=lambda row: "read-only" in row[1])
    assert left == changed == "bug" and "SystemExit" in leaving and "read-only" in changing
    assert run(tmp_path / "out", retry=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def crashing(out: Path) -> subprocess.CompletedProcess[str]:
    code = (
        "import sys; from pathlib import Path; from tests.factory.graph.runs import run; "
        "from tests.factory.graph.wild import WildWork; "
        f"sys.exit(run(Path({str(out)!r}), WildWork(wild=(({ONE!r}, 'segfault'),))).exit_code)"
    )
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_a_run_that_dies_with_its_plug_in_learns_of_it(tmp_path: Path, plain: Callable[..., Path]) -> None:
    """In this process, as for a debugger: three runs die, the fourth leaves the attempt out."""
    marker = notes_folder(Store(tmp_path / "out").location) / CRASHED
    for counts in (0, 1, 2):
        assert crashing(tmp_path / "out").returncode == -signal.SIGSEGV
        end = time.monotonic() + 10.0
        while not marker.exists() and time.monotonic() < end:
            time.sleep(0.05)
        assert json.loads(marker.read_text())["candidate"] == 0
        if counts:
            assert failed_in(tmp_path / "out") == [("system", failed_in(tmp_path / "out")[0][1])]
    fourth = crashing(tmp_path / "out")
    assert fourth.returncode == COMPLETE_WITH_FAILURES, fourth.stderr
    ((kind, error),) = failed_in(tmp_path / "out")
    assert kind == "poison" and "the run died at it: drive+render+label of expert recovery, candidate 0" in error
    assert not marker.exists()
    assert run(tmp_path / "out", retry=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_what_tasks_took_so_far_says_what_the_next_may_take() -> None:
    costs, given = TaskDurations(Limits()), TaskDurations(Limits(seconds={"perturb": 2000.0}))
    assert costs.limits_for("drive+render+label") == {"seconds": 3000.0, "gb": 8.0}
    assert costs.limits_for("reconstruct") == {"seconds": 86_400.0, "gb": None}
    for _ in range(20):
        costs.add("perturb", 20.0)
        given.add("perturb", 20.0)
        costs.add("label", 1.0)
    assert costs.limits_for("perturb")["seconds"] == 600.0
    assert costs.limits_for("label")["seconds"] == 300.0
    assert given.limits_for("perturb")["seconds"] == 2000.0


@pytest.mark.parametrize(
    ("words", "apart"),
    [
        (["clips=synthetic"], False),
        (["clips=av2", "clips.root=."], False),
        (["clips=scenarionet", "clips.root=."], True),  # pickles
        (["clips=navsim", "clips.root=.", "clips.maps=."], True),
        (["clips=scenarionet", "clips.root=.", "graph.isolated=never"], False),
        (["clips=custom", "clips._target_=examples.csv_logs.CsvReader", "+clips.root=."], True),
        (["traffic=custom", "traffic.policy=examples.keep_gap:KeepGap"], True),
        (["clips=synthetic", "graph.isolated=always"], True),
    ],
)
def test_what_may_bring_a_process_down_works_in_one_of_its_own(words: list[str], apart: bool) -> None:
    assert needs_own_process(load_config([*words, "out=somewhere"])) is apart
