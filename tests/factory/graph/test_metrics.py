"""Metrics of a run: they say what the tables say, under labels that the table of metrics knows."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import pytest

from factory.graph import execute as execution
from factory.graph.local import LocalGraph
from factory.graph.progress import (
    BYTES,
    CLIPS_LEFT,
    IN_FLIGHT,
    LOOKUPS,
    METRICS,
    OUTCOMES,
    PSNR,
    QUEUE_WAIT,
    SAMPLES,
    STAGE_SECONDS,
    STAGE_SPENT,
    TASKS,
    Metric,
    RunMetrics,
    Type,
)
from factory.store.location import Location, Shard
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs

DOCS = Path(__file__).resolve().parents[3] / "docs" / "metrics.md"
EXPERTS = ["recovery", "pdm_closed", "human"]
TROUBLE = {"log0:2000:recovery:0": "bug", "log1:1000": "bad", "log1:0": "standing"}


class Recorded:
    """Keeps what is recorded, and refuses what the table of metrics does not have."""

    def __init__(self) -> None:
        self.values: dict[str, Counter[frozenset[tuple[str, str]]]] = {metric.name: Counter() for metric in METRICS}
        self.last: dict[str, float] = {}

    def record(self, metric: Metric, value: float, labels: Mapping[str, str]) -> None:
        assert metric in METRICS
        assert set(labels) == {"run", *metric.labels}
        assert all(isinstance(label, str) for label in labels.values())
        assert value > 0 or metric.type is not Type.COUNTER, "Ray refuses to add nothing"
        self.values[metric.name][frozenset(labels.items())] += value if metric.type is Type.COUNTER else 1
        self.last[metric.name] = value

    def total(self, metric: Metric, **labels: str) -> float:
        return sum(n for key, n in self.values[metric.name].items() if labels.items() <= dict(key).items())


def recorded_run(out: Path, monkeypatch: pytest.MonkeyPatch, rounds: int = 2, blocks: bool = False) -> Recorded:
    recorded = Recorded()

    class Watched(LocalGraph):
        def __init__(self, *args: object) -> None:
            super().__init__(*args)  # type: ignore[arg-type]
            self.record_metric = recorded.record

    monkeypatch.setattr(execution, "LocalGraph", Watched)
    work = ToyWork(trouble=TROUBLE, blocks=blocks)
    executed(work, refs(5), EXPERTS, rounds, Store(out))
    return recorded


def test_outcomes_and_samples_are_those_of_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = recorded_run(tmp_path / "out", monkeypatch)
    samples = Store(tmp_path / "out").samples.read(["expert", "round"]).to_pylist()
    outcomes = Store(tmp_path / "out").outcomes.read().to_pylist()
    assert recorded.total(OUTCOMES, kind="accepted") == recorded.total(SAMPLES) == len(samples) > 0
    for kind in ("rejected", "failed", "exhausted"):
        assert recorded.total(OUTCOMES, kind=kind) == sum(row["kind"] == kind for row in outcomes)
    per_round = Counter((row["expert"], str(row["round"])) for row in samples)
    for (expert, number), n in per_round.items():
        assert recorded.total(OUTCOMES, kind="accepted", expert=expert, round=number) == n
        assert recorded.total(SAMPLES, expert=expert, round=number) == n
    why = Counter((row["stage"], row["reason"] or row["error_kind"]) for row in outcomes if row["kind"] != "exhausted")
    for (stage, reason), n in why.items():
        assert recorded.total(OUTCOMES, stage=stage, reason=reason) == n
    assert recorded.total(OUTCOMES, kind="failed", reason="bug", expert="recovery", round="0") == 1
    assert recorded.total(OUTCOMES, kind="failed", reason="input", expert="") == 1
    shards = list((tmp_path / "out" / "samples").rglob("*.parquet"))
    assert recorded.total(BYTES) == sum(path.stat().st_size for path in shards)


def test_tasks_stages_caches_and_psnr_come_from_the_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = recorded_run(tmp_path / "out", monkeypatch, rounds=1, blocks=True)
    assert first.total(TASKS, task="reconstruct") == first.total(PSNR, of="block") == 2
    assert first.total(STAGE_SECONDS, stage="reconstruct") == 2
    assert first.total(STAGE_SPENT, stage="reconstruct") == pytest.approx(1.0)
    assert first.total(LOOKUPS, cache="block", hit="false") == 2
    attempts = {"task": "drive+render+label"}
    assert first.total(QUEUE_WAIT, **attempts) == first.total(TASKS, **attempts) > 0
    assert first.total(TASKS, result="failed") == 2
    assert first.last[CLIPS_LEFT.name] >= 0 and first.total(IN_FLIGHT, what="walks") > 0
    again = recorded_run(tmp_path / "out", monkeypatch, rounds=2)
    assert again.total(LOOKUPS, cache="prepared", hit="true") == again.total(TASKS, task="perturb") > 0


def test_gauges_are_set_once_a_second_however_often_they_are_offered(tmp_path: Path) -> None:
    recorded, now = Recorded(), [100.0]
    metrics = RunMetrics(recorded.record, Location.parse(tmp_path), clock=lambda: now[0])
    for _ in range(50):
        metrics.record_state(10, 4, lambda: {"walks": 3})
        now[0] += 0.1
    assert recorded.total(CLIPS_LEFT) == 5
    assert recorded.last[CLIPS_LEFT.name] == 4


def test_a_commit_of_outcomes_alone_adds_no_sample(tmp_path: Path) -> None:
    recorded = Recorded()
    metrics = RunMetrics(recorded.record, Location.parse("s3://bucket/out"))
    metrics.record_commit([], 0.02)
    assert recorded.total(SAMPLES) == 0
    metrics.record_commit([Shard("p", 70, {"round": "1", "expert": "recovery"}, ("a", "b"))], 0.02)
    assert recorded.total(SAMPLES, round="1", expert="recovery", run="s3://bucket/out") == 2


def test_names_labels_and_units_are_documented() -> None:
    rows = [
        f"| `{m.exported}` | {m.type} | {m.unit} | {', '.join(f'`{label}`' for label in m.labels)} | {m.about} |"
        for m in METRICS
    ]
    table = DOCS.read_text().split("| --- | --- | --- | --- | --- |\n", 1)[1].split("\n\n", 1)[0]
    assert table.splitlines() == rows
