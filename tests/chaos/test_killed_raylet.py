"""A raylet that dies in the middle of a run: on a cluster of its own the run goes on by itself, three times at most."""

import subprocess
import sys
from pathlib import Path

import pytest

from factory.graph.execute import NEW_CLUSTERS, RunSummary, execute, on_new_clusters
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.killed_driver import EXPERTS
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, refs

ROOT = Path(__file__).parents[2]
RUN = """
import sys
from factory.graph import driver
from factory.graph.execute import execute, on_new_clusters
from factory.graph.on_ray.cluster import ray
from factory.graph.on_ray.graph import RayGraph
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

killing(*{"warming": (RayGraph, "_warm_every_node", 1), "working": (driver.Driver, "_take_attempt", 6)}[sys.argv[2]])
store = Store(sys.argv[1])
ended = on_new_clusters(lambda: execute(ToyWork(), refs(5), EXPERTS, 2, store, "ray", 1, shard_seconds=0.05))
sys.exit(ended.exit_code)
"""
START = """
import os
import threading
import time
from factory.graph.local import ClusterDied
from factory.graph.on_ray.cluster import connect
from tests.chaos.kills import PROGRAMS
from tests.chaos.processes import below, kill

def killing():
    while not (found := [pid for pid, line in below(os.getpid()).items() if PROGRAMS["raylet"] in line]):
        time.sleep(0.01)
    kill(found[0])

threading.Thread(target=killing, daemon=True).start()
try:
    connect(1, None)
except ClusterDied as error:
    print("our own" if error.is_ours else "another", error)
"""


@pytest.mark.ray
@pytest.mark.slow
def test_a_cluster_that_dies_while_it_is_started_is_one_that_died() -> None:
    """Ray itself waits half a minute and raises an Exception of no narrower class."""
    words = [sys.executable, "-c", START]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert "our own Ray did not begin" in done.stdout and done.returncode == 0, done.stderr


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.parametrize("while_", ["warming", "working"])
def test_a_run_goes_on_where_its_own_raylet_dies(tmp_path: Path, while_: str) -> None:
    words = [sys.executable, "-c", RUN, str(tmp_path / "out"), while_]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert done.stdout.count("a new cluster is started") == 1 and "Ray's raylet died" in done.stdout
    execute(ToyWork(), refs(5), EXPERTS, 2, Store(tmp_path / "plain"), "local", say=lambda line: None)
    assert_same_tables(tmp_path / "out", tmp_path / "plain")
    assert verify(Store(tmp_path / "out")).damage == ()


def test_no_more_than_three_clusters_are_started_anew() -> None:
    runs, told = [], list[str]()

    def once() -> RunSummary:
        runs.append(1)
        return RunSummary(4, "Ray's raylet died", lost_cluster=True)

    assert on_new_clusters(once, told.append).exit_code == 4
    assert len(runs) == 1 + NEW_CLUSTERS and [line[-6:] for line in told] == ["1 of 3", "2 of 3", "3 of 3"]
