"""Attempts of a walk that one task of Ray's makes together: the same rows, each failure its own attempt's."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from factory.exits import COMPLETE_WITH_FAILURES
from factory.graph import local
from factory.graph.on_ray import graph
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.store.samples import Store
from tests.factory.graph.runs import EXPERTS, Execution, refs, run
from tests.factory.tables import assert_same_rows, assert_same_tables
from tests.factory.toy import ToyWork, executed, ran

pytestmark = [pytest.mark.ray, pytest.mark.slow]
ROUNDS, CLIPS = 4, 4


@pytest.fixture(scope="module")
def two_cpus() -> Iterator[None]:
    ray.init(address="local", num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


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


def on_ray(out: Path, work: ToyWork, rounds: int = ROUNDS):  # type: ignore[no-untyped-def]
    return executed(work, refs(CLIPS), EXPERTS, rounds, Store(out), Execution("ray", 2))


def test_stretches_make_the_rows_of_attempts_one_by_one(tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    """A longer walk goes on behind the shorter one."""
    run(tmp_path / "one", ToyWork(n_candidates=12), ROUNDS, CLIPS)
    on_ray(tmp_path / "many", ToyWork(n_candidates=12), 2)
    on_ray(tmp_path / "many", ToyWork(n_candidates=12))
    assert_same_tables(tmp_path / "one", tmp_path / "many")
    assert max(long) >= 4 and sum(long) > 3 * len(long)


@pytest.mark.parametrize("what", ["bug", "bad", "disk"])
def test_a_failure_ends_a_stretch_and_is_its_own(what: str, tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    trouble = {"log1:1000:recovery:3": what, "log0:2000:pdm_closed:2": what}
    work = ToyWork(n_candidates=12, trouble=trouble)
    run(tmp_path / "one", work, ROUNDS, CLIPS)
    assert on_ray(tmp_path / "many", work).exit_code == COMPLETE_WITH_FAILURES
    assert_same_tables(tmp_path / "one", tmp_path / "many")
    assert max(long) >= 4


def test_whose_worker_dies_is_found_one_by_one(tmp_path: Path, two_cpus: None, long: list[int]) -> None:
    """The stretch says nothing of those before it; they are made again, each by itself."""
    work = ToyWork(n_candidates=12, trouble={"log1:1000:recovery:3": "die"}, journal=str(tmp_path / "journal"))
    ended = on_ray(tmp_path / "many", work)
    assert (ended.exit_code, ended.counts["failed"]) == (COMPLETE_WITH_FAILURES, 1)
    (failed,) = (row for row in Store(tmp_path / "many").outcomes.read().to_pylist() if row["kind"] == "failed")
    assert (failed["expert"], failed["candidate_index"], failed["error_kind"]) == ("recovery", 3, "system")
    assert ran(work.journal, "attempt log1:1000:recovery:3") >= 3
    assert ran(work.journal, "attempt log1:1000:recovery:4") == 0
    mended = ToyWork(n_candidates=12)
    on_ray(tmp_path / "many", mended)
    run(tmp_path / "one", mended, ROUNDS, CLIPS)
    assert_same_rows(*(Store(tmp_path / name).samples.read().sort_by("attempt_id") for name in ("one", "many")))
