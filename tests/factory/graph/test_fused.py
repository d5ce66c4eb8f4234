"""However the stages of an attempt are cut into tasks, the rows are the same, to the byte."""

import json
import re
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from factory.graph.execute import COMPLETE, COMPLETE_WITH_FAILURES, Execution, execute
from factory.graph.local import Claims, LocalGraph
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.graph.steps import AcceptedDrive, PreparedClip, RejectedAttempt
from factory.pipeline import FactoryWork
from factory.store.samples import Store
from tasks.stages import ATTEMPT, TASKS
from tests.factory.noted import NotedWork
from tests.factory.stages.test_pipeline import work_on
from tests.factory.tables import assert_same_tables, tables_of
from tests.factory.toy import ToyWork, executed, ran, refs

EXPERTS = ["recovery", "pdm_closed", "human"]
UNFIT = {f"log0:{start}:pdm_closed:{i}:render": "unfit" for start in (0, 2000) for i in range(3)}


def run(out: Path, work: ToyWork, **options: object):  # type: ignore[no-untyped-def]
    return executed(work, refs(4), EXPERTS, 2, Store(out), Execution(**options))  # type: ignore[arg-type]


def test_the_tasks_of_an_attempt() -> None:
    assert ATTEMPT == ("drive", "render", "label")
    assert [task.name for task in TASKS if task.may_draw] == ["reconstruct", "render"]


def test_the_page_of_concepts_names_every_task() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs/concepts.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", page, re.M) == [task.name for task in TASKS]


@pytest.mark.slow
def test_stages_as_tasks_of_their_own_make_the_same_rows_in_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = str(tmp_path / "journal")
    work = ToyWork(trouble={**UNFIT, "log1:1000:recovery:1": "bug"}, journal=journal)
    fused = run(tmp_path / "fused", ToyWork(trouble=work.trouble), executor="local")
    monkeypatch.setattr(LocalGraph, "attempt_tasks", [(stage,) for stage in ATTEMPT])
    apart = run(tmp_path / "apart", work, executor="local")
    assert apart.exit_code == fused.exit_code == COMPLETE_WITH_FAILURES
    assert apart.counts == fused.counts and apart.executed == fused.executed
    assert_same_tables(tmp_path / "apart", tmp_path / "fused")
    rejected = [row for row in tables_of(tmp_path / "apart")[1] if row["stage"] == "render"]  # type: ignore[index]
    assert rejected and {row["reason"] for row in rejected} == {"blank"}  # type: ignore[index]
    assert ran(journal, "label") == apart.counts["accepted"] == ran(journal, "render") - len(rejected)


@pytest.fixture(scope="module")
def town(small_town: Path, tmp_path_factory: pytest.TempPathFactory) -> FactoryWork:
    """A run that draws from a small town's block."""
    return work_on(small_town, tmp_path_factory.mktemp("drawn") / "out")


@pytest.fixture
def memory_of_two() -> Iterator[None]:
    """A cluster of four cores, with memory for two tasks of 1 GB."""
    ray.init(address="local", num_cpus=4, _memory=2_500_000_000, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


def test_fused_stages_claim_what_the_hungriest_of_them_wants() -> None:
    claims = Claims(memory_gb={"label": 1.5, "reconstruct": 8.0})
    assert claims.memory_bytes("drive+render+label") == 1_500_000_000
    assert claims.memory_bytes("drive") == 1_000_000_000
    assert claims.memory_bytes("reconstruct") == 8_000_000_000
    assert claims.memory_bytes("episodes") == 0


@pytest.mark.ray
@pytest.mark.slow
def test_memory_bounds_what_a_node_does_at_once(tmp_path: Path, memory_of_two: None) -> None:
    """Of four cores, memory fills two; a task that claims more than any node has is alone on one."""

    class Timed(ToyWork):
        def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
            began, result = time.time(), super().drive(prepared, candidate, expert)
            with open(self.journal, "a") as file:
                file.write(f"at {began} {time.time()}\n")
            return result

    for claimed_gb, at_once in ((1.0, 2), (9.0, 1)):
        journal = tmp_path / f"journal{at_once}"
        work, store = Timed(journal=str(journal), seconds=0.4), Store(tmp_path / f"out{at_once}")
        how = Execution(workers=4, claims=Claims(memory_gb={task.name: claimed_gb for task in TASKS}))
        assert executed(work, refs(5), ["human"], 1, store, how).exit_code == COMPLETE
        spans = [[float(t) for t in line.split()[1:]] for line in journal.read_text().splitlines() if line[:3] == "at "]
        assert max(sum(began <= start < ended for began, ended in spans) for start, _ in spans) == at_once


@pytest.fixture(scope="module")
def two_nodes() -> Iterator[dict[str, str]]:
    """The kinds by id of a node with CPUs and one with a GPU, in name.

    The first has more cores than two tasks take: Ray holds a core for a moment after its task of one kind has ended,
    and lends the GPU node's to the next of another kind if no other is free.
    """
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    cluster.add_node(num_cpus=8, num_gpus=0, include_dashboard=False)
    cluster.add_node(num_cpus=1, num_gpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    cluster.wait_for_nodes()
    yield {node["NodeID"]: "gpu" if node["Resources"].get("GPU") else "cpu" for node in ray.nodes()}
    ray.shutdown()
    cluster.shutdown()


@pytest.mark.ray
@pytest.mark.slow
def test_the_town_s_pictures_are_drawn_on_the_gpu_node_and_its_drives_made_on_the_cpu_node(
    town: FactoryWork, tmp_path: Path, two_nodes: dict[str, str]
) -> None:
    """Drives go on between the first picture and the last, and the rows are those of one process."""
    root, journal = town.reader.root, tmp_path / "journal"  # type: ignore[attr-defined]
    work = work_on(
        root, tmp_path / "blocks", "render.gate.enabled=false", "traffic.yields=false"
    )  # rejects; builds the block
    noted = NotedWork(**{f.name: getattr(work, f.name) for f in fields(work)}, journal=str(journal))
    what = (work.reader.index().refs, ["pdm_closed", "human"], 3)
    on_two = Store(tmp_path / "ray")
    made = execute(noted, *what, on_two, Execution(workers=2, claims=Claims(gpu_share=0.5)), say=lambda line: None)
    assert made.exit_code == COMPLETE and made.counts["rejected"] > 0
    tasks = [json.loads(line) for line in journal.read_text().splitlines()]
    places = {name: {two_nodes[node] for task, node, *_ in tasks if task == name} for name, *_ in tasks}
    driving = ("perturb", "drive", "label")  # the last though its pictures lie where they were drawn
    assert places == {**{task: {"cpu"} for task in driving}, "reconstruct": {"gpu"}, "render": {"gpu"}}
    drives, pictures = ([span for task, _, *span in tasks if task == name] for name in ("drive", "render"))
    assert len(pictures) == made.counts["accepted"], "only what the reward accepts is drawn"
    assert any(min(pictures)[0] < began < max(pictures)[0] for began, _ in drives)
    execute(work, *what, Store(tmp_path / "local"), Execution("local"), say=lambda line: None)
    assert_same_tables(tmp_path / "ray", tmp_path / "local")
