"""What a run costs, by stage and around its stages, and the same command again; beside another checkout's.

    python -m tests.bench.bench_run [turns=3] [other=<checkout>] clips=av2 clips.root=<logs> ... render=none

The other words are those of `factory.run`, without `out` and `executor`. CPU seconds of the cheapest of the turns; with
`other` the two take turns, and their rows are held against each other, column by column. A checkout from before stages
counted CPU seconds has none by stage.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
from deltalake import DeltaTable

TOWN = ["clips=synthetic", "rounds=3", "render=none"]  # where no run is named
HERE = Path(__file__).resolve().parents[2]
SAMPLES = "samples per core-hour"
Costs = dict[str, float]  # CPU seconds by part, and SAMPLES


def measured(tree: Path, words: Sequence[str], out: Path) -> Costs:
    """A run of the checkout `tree`, and the same command again. Raises SystemExit with the run's last words."""
    first, again = (_costs_of(tree, [*words, f"out={out}"]) for _ in range(2))
    last = json.loads((out / "last_run.json").read_text())
    parts = {f"  {stage}": times.get("cpu_seconds", math.nan) for stage, times in last["seconds"].items()}
    cost = {part: first[part] for part in ("imports", "start-up", "tasks and tables")} | parts
    cost["  no stage's"] = first["tasks and tables"] - sum(parts.values())
    cost |= {"end": first["end"], "whole": sum(first.values()), "again": sum(again.values())}
    return cost | {SAMPLES: 3600.0 * last["counts"]["accepted"] / cost["whole"]}


def _costs_of(tree: Path, words: Sequence[str]) -> Costs:
    has = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-P", str(Path(__file__).with_name("one_run.py")), *words]
    done = subprocess.run(command, cwd=tree, env=has | {"PYTHONPATH": str(tree)}, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"the run in {tree} ended with {done.returncode}: {done.stderr.strip()[-500:]}")
    found: Costs = json.loads(done.stdout.splitlines()[-1])
    return found


def unequal_columns(one: Path, other: Path) -> list[str]:
    """Columns of two runs' tables whose values differ anywhere; timings are no values."""
    found = []
    for table in ("candidates", "samples", "outcomes"):
        tables: list[pa.Table] = [DeltaTable(out / table).to_pyarrow_table() for out in (one, other)]
        a, b = (rows.sort_by("clip_id" if table == "candidates" else "attempt_id") for rows in tables)
        names = set(a.column_names) ^ set(b.column_names)
        names |= {name for name in set(a.column_names) & set(b.column_names) if not _equal(a[name], b[name])}
        found += [f"{table}.{name}" for name in sorted(names - {"seconds"})]
    return found


def _equal(a: pa.ChunkedArray, b: pa.ChunkedArray) -> bool:
    """Not-a-number equals itself."""
    return repr(a.to_pylist()) == repr(b.to_pylist())


def main(options: Sequence[str]) -> None:
    """Prints the table."""
    own = {word.partition("=")[0]: word.partition("=")[2] for word in options if word.startswith(("turns=", "other="))}
    words = [word for word in options if word.partition("=")[0] not in own] or TOWN
    trees = [HERE, *([Path(own["other"]).resolve()] if "other" in own else [])]
    turns: list[list[Costs]] = [[] for _ in trees]
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(int(own.get("turns", "3"))):
            for number, tree in enumerate(trees):
                turns[number].append(measured(tree, words, Path(folder) / f"{turn}-{number}"))
        if len(trees) > 1:
            differ = unequal_columns(Path(folder) / "0-0", Path(folder) / "0-1")
            print(f"rows: {'equal in every column' if not differ else 'other in ' + ', '.join(differ)}\n")
    print(f"| CPU s | {' | '.join(['here', 'other'][: len(trees)])} |\n|---|{'---|' * len(trees)}")
    least = [min(costs, key=lambda cost: cost["whole"]) for costs in turns]
    for part in least[0]:
        digits = 0 if part == SAMPLES else 2
        print(f"| {part} | {' | '.join(f'{costs[part]:.{digits}f}' for costs in least)} |")


if __name__ == "__main__":
    main(sys.argv[1:])
