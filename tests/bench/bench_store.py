"""A table of millions of attempts: how long it takes to open it, to plan a run on it, and to look at it.

    python -m tests.bench.bench_store attempts=3000000 out=<folder to keep> [commits=430]

The rows are written straight to the tables, as a run that made a third of them samples would leave them: clips of two
experts and five rounds, in `commits` commits of a file a round and expert. An `out` that is there is taken as it is.
Every step is a process of its own; seconds are of its CPU, over what its imports take, and memory is its peak.
`compact` is asked for by name alone, as `step=compact`, for it changes the table. A table that the run's own driver
makes is `bench_scale`'s.
"""

import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from factory.config.arguments import run_request_command
from factory.graph.plan import make_plan, retry_policy
from factory.readers.base import ClipRef
from factory.store.location import Shard, write_shard
from factory.store.samples import CANDIDATES, OUTCOMES, Store
from factory.store.schema import SAMPLES, RunIdentity, TableSpec, attempt_id, sample_rows_to_table
from tasks.caches import json_with_checksum
from tests.factory.toy import ToyWork, row_of, stream

EXPERTS = ("pdm_closed", "recovery")
ROUNDS, TRIES = 5, 15  # of a walk: every third attempt is accepted
WORK = ToyWork(n_candidates=40)
CHANGING = ("compact",)
Step = Callable[[Path], object]


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    attempts: int = 3_000_000
    commits: int = 430
    step: str = ""  # this one alone, in this process


def main(request: Request) -> None:
    """Write the tables, then print a row for each step."""
    out = Path(request.out)
    if request.step:
        print(measured(STEPS[request.step], out))
        return
    if not out.exists():
        began = time.perf_counter()
        write(out, request.attempts, request.commits)
        print(f"written in {time.perf_counter() - began:.0f} s")
    print(f"{'step':<12}{'CPU s':>8}{'s':>8}{'MB':>7}")
    for name in [name for name in STEPS if name not in CHANGING]:
        command = [sys.executable, "-m", "tests.bench.bench_store", f"out={out}", f"step={name}"]
        said = subprocess.run(command, capture_output=True, text=True, check=False)
        print(f"{name:<12}{said.stdout.strip() or said.stderr.strip().splitlines()[-1]}", flush=True)


def measured(step: Step, out: Path) -> str:
    """CPU seconds, seconds, peak memory of one step."""
    began, before = time.perf_counter(), _cpu_s()
    with redirect_stdout(StringIO()):
        step(out)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return f"{_cpu_s() - before:8.1f}{time.perf_counter() - began:8.1f}{peak:7.0f}"


def clips(n: int) -> list[ClipRef]:
    return [ClipRef("bench", f"log{i // 50}", 1000 * i) for i in range(n)]


def write(out: Path, attempts: int, commits: int) -> None:
    """All tables, with what a run leaves beside them."""
    refs, identity = clips(math.ceil(attempts / TRIES / len(EXPERTS))), WORK.identity
    store = Store(out)
    digests = {expert: WORK.expert_digest(expert) for expert in EXPERTS}
    store.begin_run(store.checked_records(identity, digests, "stop"))
    store.record_plan(dict.fromkeys(EXPERTS, ROUNDS), [ref.clip_id for ref in refs])
    sample = sample_rows_to_table([_row()])
    for part in np.array_split(np.arange(len(refs)), commits):
        store.candidates.commit([_shard(store, CANDIDATES, _lists([refs[i] for i in part], identity))])
        shards, fell = [], []
        for expert in EXPERTS:
            accepted, rejected = _walks([refs[i] for i in part], expert, identity)
            for number, rows in accepted:
                shards.append(_shard(store, SAMPLES, _replaced(sample, rows | {"round": number})))
            fell.append(_replaced(_outcome(), rejected))
        store.samples.commit(shards)
        store.outcomes.commit([_shard(store, OUTCOMES, pa.concat_tables(fell))])
    told = {"began_ms": 1, "command": None, "folder": "/"}
    last = {"began_ms": 1, "exit_code": 0, "message": "", "executed": {}, "seconds": {}, "notes": []}
    for name, document in (("current_run.json", told), ("last_run.json", last)):
        (out / name).write_text(json_with_checksum(document))


def _row() -> dict[str, Any]:
    row = row_of(stream("bench"))
    first = {name: value[:1] for name, value in row.items() if name.startswith("agent_")}  # type: ignore[index]
    texts = dict.fromkeys(("attempt_id", "expert", "expert_digest", "vocabulary_digest"), "")
    return row | first | texts | {"settings_hash": "", "stage_versions": "", "round": 0, "candidate_index": 0}


def _walks(
    refs: Sequence[ClipRef], expert: str, identity: RunIdentity
) -> tuple[list[tuple[int, dict[str, Any]]], dict[str, Any]]:
    """Columns of the samples of each round, and of the outcomes."""
    digest, vocabulary = WORK.expert_digest(expert), identity.vocabulary_digest

    def columns(candidates: Sequence[int]) -> dict[str, Any]:
        pairs = [(ref, candidate) for ref in refs for candidate in candidates]
        return {
            "attempt_id": [attempt_id(ref.clip_id, candidate, vocabulary, expert, digest) for ref, candidate in pairs],
            "clip_id": [ref.clip_id for ref, _ in pairs],
            "log_id": [ref.log_id for ref, _ in pairs],
            "candidate_index": [candidate for _, candidate in pairs],
            "dataset": "bench",
            "expert": expert,
            "expert_digest": digest,
            "settings_hash": identity.settings_hash,
            "stage_versions": identity.versions_json,
        }

    step = TRIES // ROUNDS
    accepted = [(number, columns([number * step + step - 1])) for number in range(ROUNDS)]
    return accepted, columns([i for i in range(TRIES) if i % step != step - 1])


def _replaced(row: pa.Table, columns: dict[str, Any]) -> pa.Table:
    """One row again and again, but for some columns."""
    n = len(columns["attempt_id"])
    table = row.take(pa.array(np.zeros(n, np.int64)))
    for name, value in columns.items():
        at, kind = table.schema.get_field_index(name), table.schema.field(name).type
        values = pa.array(value, kind) if isinstance(value, list) else pa.repeat(pa.scalar(value, kind), n)
        table = table.set_column(at, table.schema.field(name), values)
    return table


def _outcome() -> pa.Table:
    row = {name: "" for name in OUTCOMES.schema.names if OUTCOMES.schema.field(name).type == pa.string()}
    told = {"kind": "rejected", "stage": "reward", "reason": "nc", "detail": "nc=0"}
    counts = {"candidate_index": 0, "tries": 1, "n_tried": 0}
    scores = {
        "subscores": {"nc": 0.0, "dac": 1.0, "ep": 0.3},
        "seconds": {"rollout": 0.02, "expert": 0.1, "reward": 0.01},
    }
    return pa.Table.from_pylist([row | told | counts | scores], schema=OUTCOMES.schema)


def _lists(refs: Sequence[ClipRef], identity: RunIdentity) -> pa.Table:
    one = {"index": 0, "vocabulary_index": 7, "end_x": 1.0, "end_y": 0.1, "end_heading": 0.0, "end_speed": 5.0}
    one |= {"cell": [1, -1], "score": 0.9, "reactive_score": 0.9}
    made = {"content_digest": "content", "prepare_digest": identity.prepare_digest, "stage": "", "reason": ""}
    made |= {"vocabulary_digest": identity.vocabulary_digest, "gate_counts": {"heading": 7, "lateral": 3}}  # type: ignore[dict-item]
    rows = [
        {"clip_id": ref.clip_id, "dataset": ref.dataset, "log_id": ref.log_id, **made}
        | {"candidates": [one | {"index": i} for i in range(WORK.n_candidates)], "n_candidates": WORK.n_candidates}
        for ref in refs
    ]
    return pa.Table.from_pylist(rows, schema=CANDIDATES.schema)


def _shard(store: Store, spec: TableSpec, rows: pa.Table) -> Shard:
    return write_shard(store.location.child(spec.name), spec, rows)


def open_(out: Path) -> object:
    """As a run begins: its settings held against the tables, its claim."""
    store = Store(out)
    digests = {expert: WORK.expert_digest(expert) for expert in EXPERTS}
    store.begin_run(store.checked_records(WORK.identity, digests, "stop"))
    return store


def plan(out: Path, rounds: int = ROUNDS) -> object:
    """What of the same command, or of one with more rounds, is left to do."""
    store, identity = Store(out), WORK.identity
    digests = {expert: WORK.expert_digest(expert) for expert in EXPERTS}
    records = store.checked_records(identity, digests, "stop")
    refs = clips(sum(file.n_rows for file in store.candidates.file_facts().values()))
    policy = retry_policy(False, identity.versions_json)
    history = store.history(identity, digests)
    made = make_plan(refs, EXPERTS, rounds, history, identity, "stop", policy, WORK.once)
    store.begin_run(records)
    if len(made.todo) != (len(refs) if rounds > ROUNDS else 0):
        raise RuntimeError(f"{len(made.todo)} of {len(refs)} clips are left to do")
    return made


def command(*words: str) -> Step:
    from factory.commands.table import COMMANDS

    return lambda out: COMMANDS[words[0]].load()([f"out={out}", *words[1:]])


def dashboard(out: Path) -> None:
    """The page's first questions."""
    from factory.views.board.server import Board

    board = Board(Store(out))
    for path in ("/api/overview", "/api/samples?size=6&simulated=1", "/api/failed"):
        if (found := board.answer(path)).status != 200:
            raise RuntimeError(f"{path}: {found.body!r}")


def card(out: Path) -> None:
    from factory.views.card import write_card

    write_card(Store(out))


def show(out: Path) -> None:
    """Five samples as one picture."""
    with tempfile.TemporaryDirectory() as folder:
        command("show", "sample=5", f"to={folder}/samples.png")(out)


STEPS: dict[str, Step] = {
    "open": open_,
    "resume": plan,
    "extend": lambda out: plan(out, ROUNDS + 1),
    "status": command("status"),
    "show": show,
    "dashboard": dashboard,
    "report": command("report"),
    "card": card,
    "failed": command("failed"),
    "verify": command("verify"),
    "compact": command("compact"),
}


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(run_request_command(main, sys.argv[1:]))
