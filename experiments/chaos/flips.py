"""One flipped bit at a time in files that a run keeps: `python -m experiments.chaos.flips [FLIPS] [WORD]`.

Of each file, or of those whose kind has the word in it: how often the damage was found, how often what came out was the
same all the same (a byte that nothing says anything with), and how often something else came out or raised, which must
be never.
"""

import logging
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from factory.config.compose import ConfigError
from factory.graph.execute import Execution, execute
from factory.graph.steps import prepare
from factory.setup.vocabulary import load_recovery_table, save_recovery_table
from factory.stages.scene_file import BadScene, read_scene, write_scene
from factory.store.location import encode_tree
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.store.verify import damaged_logs, restore_logs, verify
from planners.training.checkpoint import load_planner, load_training, save_checkpoint
from tasks.experts.recovery import RecoveryTable
from tests.factory.stages.test_scene_file import scene
from tests.factory.toy import ToyWork, refs
from tests.planners.toy import Toy, ToySettings

Outcome = str
FLIPS = 1500


def flipped(path: Path, flips: int, look: Callable[[], Outcome]) -> Counter[Outcome]:
    """What `look` says of the file with one bit flipped, at places drawn by chance; the file is whole afterwards."""
    rng, whole, told = np.random.default_rng(0), path.read_bytes(), Counter[Outcome]()
    for _ in range(flips):
        at, bit = int(rng.integers(len(whole))), int(rng.integers(8))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :])
        try:
            told[look()] += 1
        except BaseException as error:
            told[f"raised {type(error).__name__}"] += 1
    path.write_bytes(whole)
    return told


def kinds(out: Path) -> dict[str, tuple[Path, int, Callable[[], Outcome]]]:
    """Kind -> a file, the share of the flips that it gets (one in n), and what to do with it."""
    work, store, ref = ToyWork(), Store(out), refs(1)[0]
    prepared = encode_tree(prepare(work, store.location, ref)[1])
    cached = next(path for path in (out / "cache/prepared").iterdir() if path.name.startswith(ref.clip_id))
    shard = sorted(out.glob("samples/*/*/*.parquet"))[0]
    rows = [str(sample) for sample in SampleTable(out)]
    commit, copy = (out / "samples" / folder / f"{0:020}.json" for folder in ("_delta_log", "_commits"))
    table, drawn = out / "table.npz", RecoveryTable(np.random.default_rng(0).normal(size=(9, 40, 3)))
    save_recovery_table(table, drawn, {})
    block = out / "block-1.safetensors"
    golden = write_scene(block, scene())

    def again() -> Outcome:
        report, clip = prepare(work, store.location, ref)
        return "found" if getattr(report, "note", "") and encode_tree(clip) == prepared else "other"

    originals = {path: path.read_bytes() for path in (commit, copy)}

    def log(path: Path) -> Outcome:
        (found,) = damaged_logs(store.location)
        restore_logs(store.location)
        return "found" if found.name.endswith(path.name) and path.read_bytes() == originals[path] else "other"

    def of_shard() -> Outcome:
        return "found" if shard.name in verify(Store(out)).damage[0] else "other"

    def read() -> Outcome:
        try:
            return "same" if [str(sample) for sample in SampleTable(out)] == rows else "other"
        except OSError as error:
            return "found" if shard.name in str(error) else "unnamed"

    def recovery() -> Outcome:
        try:
            return "same" if load_recovery_table(table).digest == drawn.digest else "other"
        except ValueError:
            return "found"

    def drawn_scene() -> Outcome:
        try:
            return "same" if read_scene(block).digest == golden.digest else "other"
        except BadScene:
            return "found"

    trained = save_checkpoint(out, 1, trained_planner(), {}, {"optimiser": {"step": torch.arange(200.0)}})
    learned = learned_of(trained)

    def checkpoint(path: Path) -> Outcome:
        try:
            return "same" if learned_of(trained) == learned else "other"
        except ConfigError as error:
            return "found" if path.name in str(error) else "unnamed"

    parts = {
        f"checkpoint of a training, {path.name}": (path, 1, partial(checkpoint, path))
        for path in sorted(trained.iterdir())
    }
    return parts | {
        "prepared clip, as a run loads it": (cached, 1, again),
        "recovery table": (table, 1, recovery),
        "scene of a block": (block, 1, drawn_scene),
        "commit in a table's log, by verify and its repair": (commit, 3, lambda: log(commit)),
        "its copy": (copy, 3, lambda: log(copy)),
        "shard, by verify": (shard, 5, of_shard),
        "shard, by the reader": (shard, 3, read),
    }


def trained_planner() -> Toy:
    torch.manual_seed(0)
    return Toy(ToySettings(), {"mean_plan": np.random.default_rng(0).normal(size=(8, 3))})


def learned_of(folder: Path) -> str:
    """What a checkpoint's planner plans with and its training goes on from. Raises ConfigError."""
    planner = load_planner(folder)
    weights = {name: weight.tolist() for name, weight in planner.state_dict().items()}
    arrays = {name: array.tolist() for name, array in planner.arrays.items()}
    return repr((planner.settings, weights, arrays, load_training(folder)["optimiser"]["step"].tolist()))


def main(flips: int = FLIPS, word: str = "") -> None:
    logging.disable()
    folder = Path(tempfile.mkdtemp())
    out = folder / "out"
    execute(ToyWork(), refs(3), ["recovery", "human"], 2, Store(out), Execution("local"), say=lambda line: None)
    print("| file | flips | found | the same came out | anything else |\n|---|---|---|---|---|")
    chosen = {kind: how for kind, how in kinds(out).items() if word in kind}
    for kind, (path, part, look) in chosen.items():
        told = flipped(path, flips // part, look)
        rest = ", ".join(f"{told[name]} {name}" for name in told if name not in ("found", "same")) or "0"
        print(f"| {kind} | {flips // part} | {told['found']} | {told['same']} | {rest} |", flush=True)
    shutil.rmtree(folder)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), *sys.argv[2:])
