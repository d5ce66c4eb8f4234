"""Small runs with pictures, and what their tables hold, counted the slow and obvious way."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factory.graph.execute import Execution, RunSummary
from factory.graph.steps import AcceptedDrive, PreparedClip, RejectedAttempt, SampleColumns
from factory.readers.base import ClipRef
from factory.store.funnel import funnel_of
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed
from tests.planners.samples import FRONT_YAWS, jpeg, pictures, plain

EXPERTS = ["recovery", "pdm_closed", "human"]
EVIL = "<img src=x onerror=alert(1)>"
REFS = [ClipRef("toy", f"log{i % 2}{EVIL}", 1000 * i) for i in range(6)]
TROUBLE = {
    f"{REFS[1].log_id}:1000": "bad",
    f"{REFS[2].log_id}:2000": "standing",
    f"{REFS[3].log_id}:3000": "no_candidates",
    f"{REFS[4].log_id}:4000:recovery:1": "bug",
}
VIEW = jpeg(plain((90, 120, 60), 160, 90))


@dataclass(frozen=True)
class PicturedWork(ToyWork):
    """Rows with pictures that can be decoded; tells `watching` before every attempt."""

    watching: Callable[[], None] = lambda: None

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        self.watching()
        return super().drive(prepared, candidate, expert)

    def drawn(self, driven: AcceptedDrive) -> SampleColumns:
        return SampleColumns(pictures(dict.fromkeys(FRONT_YAWS, VIEW)))


def run(out: Path, rounds: int = 2, watching: Callable[[], None] = lambda: None, n: int = len(REFS)) -> RunSummary:
    """Of the first n clips."""
    work = PicturedWork(trouble=TROUBLE, watching=watching)
    return executed(work, REFS[:n], EXPERTS, rounds, Store(out), Execution("local", shard_seconds=0.0))


def counted(out: Path) -> dict[str, Any]:
    """What /api/overview has to say of the tables as they are now."""
    store = Store(out)
    samples, outcomes = store.samples.read(["expert", "round"]).to_pylist(), store.outcomes.read().to_pylist()
    rejected = [o for o in outcomes if o["kind"] == "rejected" and o["expert"]]
    failed = [o for o in outcomes if o["kind"] == "failed"]
    attempts = [*samples, *rejected, *(o for o in failed if o["expert"])]
    candidates = store.candidates.read(["n_candidates"])["n_candidates"].to_pylist()
    return {
        "samples": len(samples),
        "simulated": sum(s["expert"] != "human" for s in samples),
        "attempts": len(attempts),
        "simulated_attempts": sum(a["expert"] != "human" for a in attempts),
        "rejected": len(rejected),
        "failed": len(failed),
        "clips": len(candidates),
        "candidates": sum(candidates),
        "accepted": Counter((s["expert"], s["round"]) for s in samples),
        "reasons": Counter(f"{o['stage']}.{o['reason']}" for o in rejected)
        + Counter(f"failed.{o['error_kind']}" for o in failed if o["expert"]),
        "funnel": [(r.expert, r.round, r.accepted, r.rejected, r.failed, r.clips) for r in funnel_of(store).rows],
    }


def told(overview: dict[str, Any]) -> dict[str, Any]:
    """The same numbers of an answer."""
    counts = {k: v for k, v in overview["counts"].items() if k != "sample_bytes"}
    rows = overview["acceptance"]
    rounds = ("expert", "round", "accepted", "rejected", "failed", "clips")
    return counts | {
        "accepted": Counter(
            {(a["expert"], a["round"]): a["accepted"] for a in overview["acceptance"] if a["accepted"]}
        ),
        "reasons": Counter({r["reason"]: r["total"] for r in overview["reasons"]}),
        "funnel": [tuple(a[name] for name in rounds) for a in rows],
    }
