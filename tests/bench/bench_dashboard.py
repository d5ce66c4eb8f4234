"""The dashboard on a large run: how long it takes to open, to page, to show a sample, and what it reads.

    python -m tests.bench.bench_dashboard table=<out of a run with images> [samples=20000] [out=<folder to keep>]

The large run holds the rows of the given one again and again under new ids, images and all, in shards of 64 MB. Its
server is a process of its own; questions come over six connections, as a browser's do. Bytes are what that process
read from files (/proc/<pid>/io). An `out` that is there already is taken as it is.
"""

import hashlib
import http.client
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import local

import numpy as np
import pyarrow as pa

from factory.store.attempts import CANDIDATES, OUTCOMES
from factory.store.location import Location
from factory.store.parquet_file import TableSpec, write_shard
from factory.store.samples import Store
from factory.store.schema import SAMPLES
from factory.store.table import KeyedTable
from factory.views.board.server import STATIC

SHARD_BYTES = 64 * 2**20
CONNECTIONS = 6
PAGES = 10
SCORES = ["attempt_id", "expert", "round", "stage1_score", "stage2_score"]


def main(table: str, samples: int = 20_000, out: str | None = None) -> None:
    """Prints one table."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(out or f"{folder}/large")
        if not target.exists():
            began = time.perf_counter()
            replicate(Path(table), target, samples)
            print(f"replicated in {time.perf_counter() - began:.0f} s")
        measure(target)


def replicate(source: Path, out: Path, n: int) -> None:
    """A run of n samples, and of outcomes and candidates in proportion, out of the rows of another."""
    store = Store(source)
    out.mkdir(parents=True)
    for name in ("run.json", "last_run.json"):
        shutil.copy(source / name, out / name)
    for table, spec in ((store.candidates, CANDIDATES), (store.outcomes, OUTCOMES)):
        rows = table.read()
        copies = -(-n // len(store.samples))
        _write(out, spec, [_renamed(rows, copy) for copy in range(copies)])
    left = n
    groups: dict[tuple[str, ...], list[str]] = {}
    files = store.samples.live_files()
    for path, partition in sorted(files.items()):
        groups.setdefault(tuple(partition.values()), []).append(path)
    for copy in range(-(-n // len(store.samples))):
        for paths in groups.values():
            rows = pa.concat_tables([store.samples.read_file(path, files[path]) for path in paths])
            rows = rows.slice(0, max(0, left))
            left -= rows.num_rows
            each = max(1, int(SHARD_BYTES // max(1, rows.nbytes // max(1, rows.num_rows))))
            parts = [rows.slice(start, each) for start in range(0, rows.num_rows, each)]
            _write(out, SAMPLES, [_renamed(part, copy) for part in parts])


def _renamed(rows: pa.Table, copy: int) -> pa.Table:
    """The rows with ids of their own copy; copy 0 keeps its ids."""
    for name in ("attempt_id", "clip_id"):
        if name in rows.column_names and copy:
            ids = [hashlib.sha256(f"{key} {copy}".encode()).hexdigest()[:16] for key in rows[name].to_pylist()]
            rows = rows.set_column(rows.column_names.index(name), rows.schema.field(name), pa.array(ids))
    return rows


def _write(out: Path, spec: TableSpec, parts: Sequence[pa.Table]) -> None:
    location = Location.parse(out).child(spec.name)
    KeyedTable(location, spec).commit([write_shard(location, spec, part) for part in parts if part.num_rows])


def measure(out: Path) -> None:
    """Starts the command on a free port, asks, and prints."""
    store = Store(out)
    files = store.samples.file_facts().values()
    size = sum(file.n_bytes for file in files) / 1e9
    print(f"{sum(file.n_rows for file in files):,} samples in {len(files)} files, {size:.2f} GB\n")
    print("| what | time | read |\n|---|---|---|")
    command = [sys.executable, "-m", "factory", "dashboard", f"out={out}", "port=0"]
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        said = next(line for line in server.stdout if "http:" in line)
        port = int(said.split(":")[-1].split("/")[0])
        _row("command started, the tables read", time.perf_counter() - began, _read(server.pid))
        try:
            asked(port, server.pid)
        finally:
            server.terminate()
    began, before = time.perf_counter(), _read("self")
    rows = Store(out).samples.read(SCORES)
    assert rows.num_rows
    _row(f"query on scores alone ({len(SCORES)} columns)", time.perf_counter() - began, _read("self") - before)


def asked(port: int, pid: int) -> None:
    """Every kind of question, first the ones that a browser puts when the page is opened."""
    held = local()

    def get(path: str) -> bytes:
        if not hasattr(held, "connection"):
            held.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
        held.connection.request("GET", path)
        answer = held.connection.getresponse()
        body = answer.read()
        assert answer.status == 200, (path, body)
        return body

    with ThreadPoolExecutor(CONNECTIONS) as browser:

        def cards(query: str) -> int:
            page = json.loads(get(f"/api/samples?{query}"))
            names = [
                f"/picture/{i['attempt_id']}/{n}.jpg?v={i['file']}" for i in page["items"] for n in ("front", "bev")
            ]
            list(browser.map(get, names))
            return int(page["pages"])

        def opened() -> None:
            list(browser.map(get, ["/", *(f"/static/{path.name}" for path in STATIC.iterdir()), "/api/overview"]))
            cards("size=6&simulated=1")

        def timed(what: str, *calls: Callable[[], object]) -> None:
            before, spent = _read(pid), []
            for call in calls:
                began = time.perf_counter()
                call()
                spent.append(time.perf_counter() - began)
            text = what if len(calls) == 1 else f"{what}, median of {len(calls)}"
            _row(text, float(np.median(spent)), (_read(pid) - before) / len(calls))

        timed("page opened for the first time, its pictures too", opened)
        timed("page opened again", opened)
        pages = cards("page=1")
        places = [2 + i * (pages - 2) // PAGES for i in range(PAGES)]
        timed("gallery page, its numbers", *(lambda p=p: get(f"/api/samples?page={p}") for p in places))  # type: ignore[misc]
        timed("gallery page, its 24 pictures too", *(lambda p=p: cards(f"page={p}") for p in places))  # type: ignore[misc]
        timed("gallery page seen before", *(lambda p=p: cards(f"page={p}") for p in places))  # type: ignore[misc]
        item = json.loads(get(f"/api/samples?page={pages // 2}"))["items"][0]
        timed("a sample's page, its numbers", lambda: get(f"/api/samples/{item['attempt_id']}"))


def _read(pid: int | str) -> int:
    """Bytes that a process has read so far."""
    return int(Path(f"/proc/{pid}/io").read_text().split()[1])


def _row(what: str, seconds: float, n_bytes: float) -> None:
    print(f"| {what} | {1e3 * seconds:.0f} ms | {n_bytes / 1e6:.1f} MB |", flush=True)


if __name__ == "__main__":
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    main(given["table"], int(given.get("samples", "20000")), given.get("out"))
