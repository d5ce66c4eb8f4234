"""The same graph as Ray tasks: identical rows, dead workers survived, poison contained."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.driver import EpisodeSettings
from factory.graph.execute import Execution
from factory.graph.local import Claims, Limits
from factory.graph.on_ray import graph
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.store.samples import Store
from factory.store.verify import verify
from factory.views.sample_text import prepared_episode
from tests.factory.filmed import FilmedWork
from tests.factory.graph.wild import WildWork
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
        "import factory.graph.on_ray.graph as m; m.connect(1, None)",
        "import planners.training.on_ray as m; held = m._connected(); held.__enter__()",
    ],
)
def test_a_cluster_of_our_own_starts_without_a_warning_and_asks_for_a_token(begun: str, tmp_path: Path) -> None:
    code = f"import os; {begun}; print(os.environ['RAY_AUTH_MODE']); m.ray.shutdown()"
    env = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {"HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "token\n", "")


def test_a_cluster_that_does_not_answer_is_named_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray's own client tries for minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        graph.must_answer(address)
        graph.must_answer(f"ray://{address}")
    graph.must_answer("auto")
    monkeypatch.setenv("RAY_ADDRESS", address)
    ended = run(tmp_path / "out", "ray", ToyWork(), 1, 1)
    assert ended.exit_code == BAD_CONFIG and f"RAY_ADDRESS={address}" in ended.message and "unset" in ended.message
    assert not ray.is_initialized()


def test_local_and_ray_with_one_and_two_workers_make_identical_rows(tmp_path: Path, two_cpus: None) -> None:
    run(tmp_path / "local", "local", ToyWork(), 5, 1)
    assert run(tmp_path / "one", "ray", ToyWork(), 2, 1).exit_code == COMPLETE
    assert run(tmp_path / "one", "local", ToyWork(), 5, 1).executed.prepared == 0
    assert run(tmp_path / "two", "ray", ToyWork(), 5, 2).exit_code == COMPLETE
    assert ray.is_initialized(), "a cluster that the run found must stay"
    assert_same_tables(tmp_path / "local", tmp_path / "one")
    assert_same_tables(tmp_path / "local", tmp_path / "two")


def test_workers_write_the_same_episodes_as_one_process(tmp_path: Path, two_cpus: None) -> None:
    for executor in ("local", "ray"):
        store = Store(tmp_path / executor)
        executed(
            FilmedWork(),
            refs(3),
            EXPERTS,
            2,
            store,
            Execution(executor, 2, episodes=EpisodeSettings(1, prepared_episode)),
        )  # type: ignore[arg-type]
    local, ray_s = (
        {path.name: path.read_bytes() for path in (tmp_path / executor / "episodes").iterdir()}
        for executor in ("local", "ray")
    )
    assert local == ray_s and len(local) == len(Store(tmp_path / "ray").samples)


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
    assert (
        executed(ToyWork(), refs(5), EXPERTS, 2, Store(tmp_path / "out"), Execution("local", retry=True)).exit_code
        == COMPLETE
    )
    run(tmp_path / "never", "local", ToyWork(), 2, 1)
    assert_same_tables(tmp_path / "out", tmp_path / "never")
    assert verify(Store(tmp_path / "out")).damage == ()


def test_a_loop_is_ended_on_a_worker_too_and_tried_once_a_run(tmp_path: Path, two_cpus: None) -> None:
    journal = str(tmp_path / "journal")
    work = WildWork(wild=(("log0:0:recovery:0", "loop"),), journal=journal)
    limits = Limits(seconds={"drive": 1.0, "render": 0.0, "label": 0.0})
    summary = executed(work, refs(3), EXPERTS, 1, Store(tmp_path / "out"), Execution("ray", 2, limits=limits))
    assert summary.exit_code == COMPLETE_WITH_FAILURES
    (failed,) = [o for o in tables_of(tmp_path / "out")[1] if o["kind"] == "failed"]  # type: ignore[index]
    assert failed["error_kind"] == "limit" and "wild.py" in failed["error"]
    assert ran(journal, "loop") == 1
    assert run(tmp_path / "out", "local", ToyWork(), 1, 1, 3).exit_code == COMPLETE
    run(tmp_path / "never", "local", ToyWork(), 1, 1, 3)
    assert_same_rows(tables_of(tmp_path / "out")[0], tables_of(tmp_path / "never")[0])
