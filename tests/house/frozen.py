"""What runs gave, column by column, to be held against another version of the code.

    python -m tests.house.frozen <shared data> to=before.json              # of this checkout
    python -m tests.house.frozen <shared data> to=after.json against=before.json [code=<another checkout>]

Runs of the synthetic town with pictures, of Argoverse 2 and of nuScenes, each in the process and on Ray, and a training
on the town's samples, all by the commands that users give. Kept are a digest of each column of the three tables but
those that name versions, settings or the expert's digest (ids made of them too), and the training's curve. The same
machine and the same versions of what is installed give the same digests; what differs is printed, with exit code 1.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import DeltaTable

REPOSITORY = Path(__file__).parents[2]
LEFT_OUT = (
    *("settings_hash", "stage_versions", "expert_digest", "attempt_id", "clip_id", "content_digest"),
    *("vocabulary_digest", "asset_digest", "prepare_digest", "seconds", "error", "run_id", "worker", "machine"),
)
RUNS = {
    "town": ["preset=demo", "clips.n_clips=4", "rounds=2"],
    "av2": ["clips=av2", "clips.root={shared}/data/av2/sensor", "clips.split=train", "limit=3", "rounds=2"],
    "nuscenes": ["clips=scenarionet", "clips.root={shared}/data/scenarionet/nuscenes", "clips.split=train", "limit=5"],
}
TRAINING = ["planner=ego_mlp_small", "planner.training.batch_size=8", "steps=40", "log_every=1", "workers=1"]


def digest_of(column: pa.ChunkedArray) -> str:
    """Of a column's values in their order, as Python writes them: NaN is NaN, and no padding or chunk counts."""
    return hashlib.sha256(repr(column.to_pylist()).encode()).hexdigest()[:16]


def table_of(folder: Path) -> pa.Table:
    """A Delta table's rows, in an order that no id or worker decides."""
    table = pa.concat_tables([pq.read_table(f) for f in DeltaTable(str(folder)).file_uris()], promote_options="default")
    kept = table.select([name for name in table.column_names if name not in LEFT_OUT])
    return kept.take(pa.array(sorted(range(len(kept)), key=lambda n: repr(kept.slice(n, 1).to_pylist()))))


def ran(code: Path, words: list[str]) -> None:
    """A command of a checkout's code, which must come out well."""
    env = os.environ | {"PYTHONPATH": str(code)}
    print("$ python -m", *words, flush=True)
    done = subprocess.run([sys.executable, "-m", *words], cwd=code, env=env, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"exit code {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")


def frozen(code: Path, shared: Path, folder: Path) -> dict[str, Any]:
    """name of run, executor, table and column -> digest; `training` -> the curve's digest."""
    found: dict[str, Any] = {}
    for name, words in RUNS.items():
        for executor in ("local", "ray"):
            out = folder / name / executor
            given = [word.format(shared=shared) for word in words]
            ran(code, ["factory.run", *given, f"executor={executor}", f"out={out}"])
            for kind in ("samples", "outcomes", "candidates"):
                if not (out / kind).is_dir():
                    continue
                table = table_of(out / kind)
                for column in table.column_names:
                    found[f"{name} {executor} {kind} {column}"] = digest_of(table[column])
                found[f"{name} {executor} {kind} rows"] = len(table)
    table, trained = folder / "town" / "local", folder / "trained"
    ran(code, ["planners", "train", f"data.real=[{table}]", f"data.sim=[{table}]", f"out={trained}", *TRAINING])
    (curve,) = trained.rglob("losses.csv")
    found["training"] = hashlib.sha256(curve.read_bytes()).hexdigest()[:16]
    return found


def main() -> int:
    """Write what was found; 1 where it is not what `against` holds."""
    shared, *rest = sys.argv[1:]
    given = dict(word.split("=", 1) for word in rest)
    with tempfile.TemporaryDirectory() as folder:
        found = frozen(Path(given.get("code", REPOSITORY)).resolve(), Path(shared).resolve(), Path(folder))
    Path(given["to"]).write_text(json.dumps(found, indent=1) + "\n")
    if "against" not in given:
        return 0
    before = json.loads(Path(given["against"]).read_text())
    lost, new = sorted(before.keys() - found.keys()), sorted(found.keys() - before.keys())
    changed = sorted(key for key in before.keys() & found.keys() if before[key] != found[key])
    for what, keys in (("gone", lost), ("new", new), ("changed", changed)):
        print(*(f"{what}: {key}" for key in keys), sep="\n", end="\n" if keys else "")
    print(f"{len(before.keys() & found.keys()) - len(changed)} equal, {len(changed)} changed")
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())
