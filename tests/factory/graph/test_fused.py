"""However the stages of an attempt are cut into tasks, the rows are the same, to the byte."""

import json
import pickle
import re
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from factory.graph.execute import COMPLETE, COMPLETE_WITH_FAILURES, Execution, execute
from factory.graph.local import Claims, LocalGraph
from factory.graph.on_ray.graph import _attempt_batch, ray  # with the environment that keeps it on loopback
from factory.graph.plan import AttemptBatch
from factory.graph.steps import (
    AcceptedDrive,
    AttemptReport,
    BatchReport,
    Failure,
    PreparedClip,
    RejectedAttempt,
    SampleColumns,
    attempt,
)
from factory.pipeline import FactoryWork
from factory.store.samples import Store
from factory.store.schema import Stamp
from tasks.render.scene import on_device
from tasks.render.scene.on_device import Device
from tasks.render.settings import Backend
from tasks.stages import ATTEMPT, TASKS
from tests.bench.by_kernels import rasterization
from tests.factory.noted import NotedWork
from tests.factory.stages.test_pipeline import prepared_by, work_on
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


WATCH = {"seconds": None, "gb": None, "run": "a run"}
STAMP = Stamp("", "recovery", "recovery-1", 1, 0, "vocabulary-1", "settings", "{}")


def by_tasks(work: ToyWork, prepared: PreparedClip, batch: AttemptBatch, notes: Path) -> tuple[Any, list[Any]]:
    """A batch's reports and rows, a task for each stage."""
    so_far: Any = prepared
    for stage in ATTEMPT:
        report, *results = _attempt_batch((notes, WATCH), work, (stage,), so_far, STAMP, batch)
        assert len(results) == batch.samples, "as many as the task has results"
        if isinstance(report, BatchReport):
            return report.reports, [row for row in results if row is not None]
        so_far = results[0]
    raise AssertionError("the last stage ends it")


def said(report: AttemptReport | Failure) -> object:
    """All but how long it took."""
    if isinstance(report, Failure):
        return report.kind, report.error.splitlines()[-1], report.task
    return replace(report, seconds=dict.fromkeys(report.seconds))  # type: ignore[arg-type]


def test_a_batch_cut_into_tasks_and_drawn_together_is_attempts_one_after_the_other(tmp_path: Path) -> None:
    """Whatever goes wrong, in any stage of any of them; what it does not come to is left to the next batch."""
    rng, (ref, *_) = np.random.default_rng(0), refs(1)
    together, kinds, shorter = 0, set(), 0
    for case in range(80):
        names = [f"log0:{ref.start_ms}:recovery:{i}" for i in range(12)]
        trouble = {f"{n}:render": "unfit" for n in names if rng.random() < 0.3}
        if case % 2:
            stage = rng.choice(["", ":render", ":label"])
            trouble[rng.choice(names[:5]) + stage] = "bug"
        journal = tmp_path / f"journal{case}"
        work = ToyWork(n_candidates=12, trouble=trouble, journal=str(journal), threshold=0.4)
        prepared = work.prepare(ref)
        assert isinstance(prepared, PreparedClip)
        batch = AttemptBatch(int(rng.integers(2, 12)), int(rng.integers(1, 5)))
        reports, rows = by_tasks(work, prepared, batch, tmp_path)
        slow: list[AttemptReport | Failure] = []
        made: list[pa.Table] = []
        for i in range(batch.n):
            report, row = attempt(work, ATTEMPT, prepared, STAMP.of_attempt(ref.clip_id, i, 1 + len(made)))
            assert isinstance(report, AttemptReport | Failure)
            slow.append(report)
            made += [row] if isinstance(row, pa.Table) else []
            if isinstance(report, Failure) or len(made) == batch.samples:
                break
        assert [said(one) for one in reports] == [said(one) for one in slow][: len(reports)]
        assert len(reports) >= 1 and all(repr(a.to_pylist()) == repr(b.to_pylist()) for a, b in zip(rows, made))
        assert len(rows) == sum(isinstance(one, AttemptReport) and one.rejected is None for one in reports)
        kinds |= {one.task for one in reports if isinstance(one, Failure)}
        shorter += len(reports) < len(slow)
        together += len(rows) > 1
    assert kinds == set(ATTEMPT) and shorter and together


@pytest.mark.slow
def test_samples_of_a_walk_are_drawn_in_few_calls_and_as_each_alone(
    town: FactoryWork, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def counted(**given: Any) -> Any:
        calls.append(given["viewmats"].shape[0] * given["viewmats"].shape[1])
        return rasterization(**given)

    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", counted, packed))
    gate = replace(town.render.gate, enabled=False)
    work = replace(town, render=replace(town.render, backend=Backend.GSPLAT, gate=gate))
    prepared = prepared_by(work)
    tried = (work.drive(prepared, row.index, "pdm_closed") for row in prepared.candidates)
    driven = [one for one in tried if isinstance(one, AcceptedDrive)][:4]
    assert len(driven) == 4
    together, n_together = work.draw(driven), len(calls)
    alone = [work.draw([one])[0] for one in driven]
    assert n_together < len(calls) - n_together and sum(calls[:n_together]) == sum(calls[n_together:])
    for a, b in zip(together, alone, strict=True):
        assert isinstance(a, SampleColumns) and isinstance(b, SampleColumns)
        assert pickle.dumps(a.row) == pickle.dumps(b.row)
    assert len({pickle.dumps(one.row["images"]) for one in alone if isinstance(one, SampleColumns)}) == 4


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
