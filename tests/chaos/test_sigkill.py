"""SIGKILL of the driver at five moments, then the same command again: the same tables, and only lost work is redone."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factory.exits import COMPLETE
from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.killed_driver import EXPERTS, MOMENTS
from tests.factory.graph.balanced import balance
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, ran, refs

ROOT = Path(__file__).parents[2]


def drive(out: Path, executor: str, moment: str, journal: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.chaos.killed_driver", str(out), executor, moment, str(journal)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    execute(ToyWork(), refs(5), EXPERTS, 2, Store(out), Execution("local"), say=lambda line: None)
    return out


def at_rest(out: Path) -> None:
    """Waits until workers of a killed Ray driver have written what they had in hand: counts read before and after that
    differ."""
    for _ in range(60):
        before = sorted(path for path in out.rglob("*") if path.is_file())
        time.sleep(2.0)
        if before == sorted(path for path in out.rglob("*") if path.is_file()):
            return
    raise TimeoutError(f"{out} is still written to two minutes after its driver was killed")


def check(tmp_path: Path, undisturbed: Path, executor: str, moment: str) -> None:
    # Two journals: workers of a killed Ray driver may still finish what they have in hand.
    out, before, after = tmp_path / "out", tmp_path / "before", tmp_path / "after"
    killed = drive(out, executor, moment, before)
    assert killed.returncode == -9, killed.stderr
    if executor == "ray":
        at_rest(out)
    store = Store(out)
    left = balance(out)
    assert left.samples["planned"] == 5 * (2 + 2 + 1)
    assert (left.samples["pending"] == 0) == (moment == "everything is committed, the driver has not said so")
    settled = len(store.samples) + sum(kind == "rejected" for kind in store.outcomes.read()["kind"].to_pylist())
    said, how = list[str](), Execution("local", shard_seconds=0.05)  # either executor resumes the other's run
    again = execute(ToyWork(journal=str(after)), refs(5), EXPERTS, 2, Store(out), how, say=said.append)
    assert again.exit_code == COMPLETE, again.message
    assert_same_tables(out, undisturbed)
    assert balance(out) == balance(undisturbed) and balance(out).samples["pending"] == 0
    assert verify(Store(out)).damage == ()
    total = len(Store(undisturbed).samples) + sum(
        kind == "rejected" for kind in Store(undisturbed).outcomes.read()["kind"].to_pylist()
    )
    redone = ran(str(after), "attempt")
    assert redone == total - settled, "a settled attempt was executed again, or a lost one was not"
    assert f"and {redone} attempts; found {settled} attempts done" in said[-1]
    if executor == "local" and moment != "a clip was just prepared":
        assert ran(str(before), "prepare") + ran(str(after), "prepare") == 5


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_run_ends_in_the_same_tables(tmp_path: Path, undisturbed: Path, moment: str) -> None:
    check(tmp_path, undisturbed, "local", moment)


@pytest.mark.ray
@pytest.mark.slow
def test_a_killed_ray_run_ends_in_the_same_tables(tmp_path: Path, undisturbed: Path) -> None:
    check(tmp_path, undisturbed, "ray", "samples are committed, outcomes are not")
