"""The whole export by processes and on Ray: the bytes of one process, killed, interrupted and gone on with."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from factory.commands.table import COMMANDS
from factory.datasets.navsim.export import RowGroup, write_row_group
from factory.datasets.navsim.frames import CannotExport, ExportSettings
from factory.store.samples import Store
from tests.factory.datasets.navsim.navsim_samples import exported, quiet, tree
from tests.planners.samples import write_table

ROOT = Path(__file__).resolve().parents[4]
main = COMMANDS["export"].load()


@pytest.fixture(scope="module")
def long_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of twelve rounds, a row group each, and its export without a disturbance."""
    run, to = (tmp_path_factory.mktemp("long") / name for name in ("run", "to"))
    write_table(run, [exported(i, "pdm_closed", i) for i in range(12)], group_rows=1)
    quiet(run, to)
    return run, to


@pytest.mark.ray
@pytest.mark.slow
def test_workers_on_ray_write_what_one_process_writes(long_run: tuple[Path, Path], tmp_path: Path) -> None:
    assert main(["navsim", f"out={long_run[0]}", f"to={tmp_path / 'to'}", "executor=ray", "workers=2"]) == 0
    assert tree(tmp_path / "to") == tree(long_run[1])


@pytest.mark.slow
def test_a_killed_export_goes_on_to_the_same_bytes(long_run: tuple[Path, Path], tmp_path: Path) -> None:
    """Killed between logs and amid them, with half a line in the journal and half a picture beside the others."""
    (run, undisturbed), to = long_run, tmp_path / "to"
    killed = begun(run, to)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    settled(to)
    journal = to / ".journal.jsonl"
    assert journal.exists() and not (to / "manifest.jsonl").exists(), "it was to be killed on its way"
    with journal.open("a") as file:
        file.write('{"log": {"folder": "half a')
    half = next(to.rglob("*.jpg")).with_name(".half.jpg.1234.tmp")
    half.write_bytes(b"half")
    quiet(run, to)
    assert tree(to) == tree(undisturbed)


@pytest.mark.slow
def test_an_interrupted_export_ends_what_is_in_hand_and_says_how_it_goes_on(
    long_run: tuple[Path, Path], tmp_path: Path
) -> None:
    """Ctrl-C goes to all of its processes."""
    (run, undisturbed), to = long_run, tmp_path / "to"
    stopped = begun(run, to)
    os.killpg(stopped.pid, signal.SIGINT)
    _, said = stopped.communicate(timeout=120)
    assert (stopped.returncode, said) == (4, "interrupted; run the same command again to go on\n")
    n_written = len((to / ".journal.jsonl").read_text().splitlines()) - 1
    assert n_written == len(list(to.glob("navsim_logs/*/*.pkl"))) < 12, "every log that was begun is whole and noted"
    assert quiet(run, to).written == 12 - n_written
    assert tree(to) == tree(undisturbed)


def begun(run: Path, to: Path) -> "subprocess.Popen[str]":
    """An export that has written its first log, in a session of its own."""
    command = [sys.executable, "-m", "factory", "export", "navsim", f"out={run}", f"to={to}", "workers=2"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    export = subprocess.Popen(
        command, cwd=ROOT, env=env, text=True, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    while not list(to.glob("navsim_logs/*/*.pkl")):
        assert export.poll() is None, export.communicate()
        time.sleep(0.001)
    return export


def settled(to: Path) -> None:
    """Workers of a killed driver may still finish what they have in hand; what they write appears, or is renamed."""
    before = None
    while before != (now := sorted(map(str, to.rglob("*")))):
        before = now
        time.sleep(2.0)


def test_a_worker_that_does_not_see_the_run_says_so(street_run: Path, tmp_path: Path) -> None:
    elsewhere = replace(Store(street_run).samples.location, uri=str(tmp_path / "not_mounted"))
    group = RowGroup("round=0/part.parquet", {}, 0, (0,))
    with pytest.raises(CannotExport, match=r"not_mounted/round=0/part.parquet: not there for .*: every worker"):
        write_row_group(elsewhere, tmp_path, ExportSettings(), group)
