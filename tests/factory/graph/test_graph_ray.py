"""The same graph as Ray tasks: identical rows, dead workers survived, poison contained."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph import local
from factory.graph.driver import DRAIN_S
from factory.graph.execute import Execution
from factory.graph.local import Claims
from factory.graph.on_ray import graph
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.store.location import Location
from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of
from tests.factory.toy import ToyWork, executed, ran, refs

pytestmark = [pytest.mark.ray, pytest.mark.slow]
EXPERTS = ["recovery", "pdm_closed", "human"]


def run(out: Path, executor: str, work: ToyWork, rounds: int, workers: int, n: int = 5):  # type: ignore[no-untyped-def]
    return executed(work, refs(n), EXPERTS, rounds, Store(out), Execution(executor, workers))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def two_cpus() -> Iterator[None]:
    """A cluster, with a GPU in name, that outlives the runs of this module: starting one takes seven seconds."""
    ray.init(address="local", num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize(
    "begun",
    [
        "import factory.graph.on_ray.graph as m; m.join_or_start_cluster(1)",
        "import planners.training.on_ray as m; held = m._connected(); held.__enter__()",
    ],
)
def test_a_cluster_of_our_own_starts_without_a_warning_and_asks_for_a_token(begun: str, tmp_path: Path) -> None:
    threads = "os.environ.get('OMP_NUM_THREADS')"  # a worker's, whose core is one, and not this process's
    in_worker = f"m.ray.get(m.ray.remote(lambda: {threads}).remote())"
    code = f"import os; {begun}; print(os.environ['RAY_AUTH_MODE'], {in_worker}, {threads}); m.ray.shutdown()"
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "OMP_"))}
    env = kept | {"HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "token 1 None\n", "")


def test_a_cluster_that_does_not_answer_is_named_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray's own client tries for minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    graph.check_address_answers("auto")
    monkeypatch.setenv("RAY_ADDRESS", address)
    ended = run(tmp_path / "out", "ray", ToyWork(), 1, 1)
    assert ended.exit_code == BAD_CONFIG and f"RAY_ADDRESS={address}" in ended.message and "unset" in ended.message
    assert not ray.is_initialized()


def test_a_head_node_is_told_from_what_else_listens(two_cpus: None) -> None:
    graph.check_address_answers(ray.get_runtime_context().gcs_address)
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:  # as a dashboard does
        Thread(target=server.serve_forever, daemon=True).start()
        for address in (f"127.0.0.1:{server.server_port}", f"ray://127.0.0.1:{server.server_port}", "the head"):
            with pytest.raises(ConnectionError, match=f"at RAY_ADDRESS={address} .*; unset it"):
                graph.check_address_answers(address)
        server.shutdown()


def test_a_node_that_dies_before_it_is_asked_for_out_is_left_out(
    tmp_path: Path, two_cpus: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, nodes = Location.parse(str(tmp_path)), graph.nodes_of_cluster()
    for alive in (nodes, [*nodes, "ab" * 28]):
        seen = iter([[*nodes, "ab" * 28], alive])
        monkeypatch.setattr(graph, "nodes_of_cluster", lambda having="", seen=seen: next(seen))
        with nullcontext() if alive == nodes else pytest.raises(ConnectionError, match="does not answer"):
            graph.check_shared(out, "out", "a shared folder")
    assert not list(tmp_path.iterdir())


def test_local_and_ray_with_one_and_two_workers_make_identical_rows(tmp_path: Path, two_cpus: None) -> None:
    run(tmp_path / "local", "local", ToyWork(), 5, 1)
    assert run(tmp_path / "one", "ray", ToyWork(), 2, 1).exit_code == COMPLETE
    assert run(tmp_path / "one", "local", ToyWork(), 5, 1).executed.prepared == 0
    assert run(tmp_path / "two", "ray", ToyWork(), 5, 2).exit_code == COMPLETE
    assert ray.is_initialized(), "a cluster that the run found must stay"
    assert_same_tables(tmp_path / "local", tmp_path / "one")
    assert_same_tables(tmp_path / "local", tmp_path / "two")


def test_a_cluster_without_a_gpu_is_waited_for_and_then_named(
    tmp_path: Path, two_cpus: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = graph.nodes_of_cluster
    monkeypatch.setattr(graph, "nodes_of_cluster", lambda having="": [] if having == "GPU" else nodes(having))
    monkeypatch.setattr(graph, "GPU_WAIT_S", 0.1)
    store = Store(tmp_path / "out")
    summary = executed(ToyWork(), refs(1), ["human"], 1, store, Execution(claims=Claims(gpu_share=0.5)))
    assert summary.exit_code == BAD_CONFIG and "render.backend=cpu" in summary.message
    assert not (tmp_path / "out").exists()


def test_a_clip_that_kills_its_workers_hurts_nobody_else(tmp_path: Path, two_cpus: None) -> None:
    journal = str(tmp_path / "journal")
    poison = ToyWork(trouble={"log0:2000:recovery:0": "die", "log1:1000": "bad"}, journal=journal)
    summary = run(tmp_path / "out", "ray", poison, 2, 2)
    assert summary.exit_code == COMPLETE_WITH_FAILURES
    assert ran(journal, "attempt log0:2000:recovery:0") == 3  # once and two retries
    failed = {o["error_kind"] for o in tables_of(tmp_path / "out")[1] if o["kind"] == "failed"}  # type: ignore[index]
    assert failed == {"system", "input"}
    retried = executed(ToyWork(), refs(5), EXPERTS, 2, Store(tmp_path / "out"), Execution("local", retry=True))
    assert retried.exit_code == COMPLETE
    run(tmp_path / "never", "local", ToyWork(), 2, 1)
    assert_same_tables(tmp_path / "out", tmp_path / "never")
    assert verify(Store(tmp_path / "out")).damage == ()


# Attempts of a walk that one task makes together: the same rows, each failure its own attempt's.

ROUNDS, CLIPS = 4, 4


@pytest.fixture
def long(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Stretches as long as they can be, from the second attempt on; how many attempts each has had."""
    monkeypatch.setattr(local, "SEEN", 1)
    monkeypatch.setattr(graph, "AHEAD_S", 1e9)
    lengths: list[int] = []
    waited = graph.RayGraph.wait

    def wait(self: graph.RayGraph, timeout_s: float):  # type: ignore[no-untyped-def]
        finished = waited(self, timeout_s)
        if finished is not None and isinstance(finished[1], graph.BatchReport):
            lengths.append(len(finished[1].reports))
        return finished

    monkeypatch.setattr(graph.RayGraph, "wait", wait)
    return lengths


def test_one_driver_bears_what_workers_hand_in_and_tasks_end_while_a_run_is_stopped() -> None:
    for workers in (1, 300, 1000, 2400, 100_000):
        seconds = graph.seconds_ahead(workers)
        assert 1.0 <= seconds < DRAIN_S and (workers / seconds <= graph.TASKS_A_SECOND or seconds == graph.MOST_AHEAD_S)


def test_stretches_make_the_rows_of_attempts_one_by_one(tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    """A longer walk goes on behind the shorter one."""
    run(tmp_path / "one", "local", ToyWork(n_candidates=12), ROUNDS, 1, CLIPS)
    run(tmp_path / "many", "ray", ToyWork(n_candidates=12), 2, 2, CLIPS)
    run(tmp_path / "many", "ray", ToyWork(n_candidates=12), ROUNDS, 2, CLIPS)
    assert_same_tables(tmp_path / "one", tmp_path / "many")
    assert max(long) >= 4 and sum(long) > 3 * len(long)


def test_a_failure_ends_a_stretch_and_is_its_own(tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    trouble = {"log1:1000:recovery:3": "bug", "log0:2000:pdm_closed:2": "bad", "log0:0:recovery:2": "disk"}
    work = ToyWork(n_candidates=12, trouble=trouble)
    run(tmp_path / "one", "local", work, ROUNDS, 1, CLIPS)
    assert run(tmp_path / "many", "ray", work, ROUNDS, 2, CLIPS).exit_code == COMPLETE_WITH_FAILURES
    assert_same_tables(tmp_path / "one", tmp_path / "many")
    assert max(long) >= 4


def test_whose_worker_dies_is_found_one_by_one(tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    """The stretch says nothing of those before it; they are made again, each by itself."""
    work = ToyWork(n_candidates=12, trouble={"log1:1000:recovery:3": "die"}, journal=str(tmp_path / "journal"))
    ended = run(tmp_path / "many", "ray", work, ROUNDS, 2, CLIPS)
    assert (ended.exit_code, ended.counts["failed"]) == (COMPLETE_WITH_FAILURES, 1)
    (failed,) = (row for row in Store(tmp_path / "many").outcomes.read().to_pylist() if row["kind"] == "failed")
    assert (failed["expert"], failed["candidate_index"], failed["error_kind"]) == ("recovery", 3, "system")
    assert ran(work.journal, "attempt log1:1000:recovery:3") >= 3
    assert ran(work.journal, "attempt log1:1000:recovery:4") == 0
    mended = ToyWork(n_candidates=12)
    run(tmp_path / "many", "ray", mended, ROUNDS, 2, CLIPS)
    run(tmp_path / "one", "local", mended, ROUNDS, 1, CLIPS)
    assert_same_rows(*(Store(tmp_path / name).samples.read().sort_by("attempt_id") for name in ("one", "many")))
