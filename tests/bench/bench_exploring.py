"""Planners' scores against samples, by how those were drawn: `python -m tests.bench.bench_exploring uniform=a,b ...`

Each word is a name and the folders of `python -m planners alternate` of as many seeds, with the same held-out clips.
EPDMS and failures of the closed loop over the 4 s from T of those clips, after each turn; differences are to the first
name's, pair by pair. Intervals, 95 %: clips are drawn by towns, and seeds (planners.evaluation.bootstrap).
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factory.store.explored.table import open_explored
from factory.store.location import Location
from planners.evaluation.bootstrap import Interval, clusters_of, paired_interval
from planners.training.checkpoint import read_record
from tasks.world.arrays import Array


@dataclass(frozen=True)
class HeldOut:
    """A turn of a name: S seeds, C clips in the order of their ids."""

    samples: float  # simulated ones that were learned from, mean of the seeds
    scores: Array  # (S, C) EPDMS
    fails: Array  # (S, C) 0 or 1
    towns: tuple[str, ...]  # (C,)


def held_out(folders: Sequence[Path], turn: int) -> HeldOut:
    """Raises ValueError where the folders' clips differ."""
    tables = [
        sorted(
            open_explored(Location.parse(folder / "held_out" / str(turn)))
            .read(["clip_id", "log_id", "score", "fails"])
            .to_pylist(),
            key=lambda row: str(row["clip_id"]),
        )
        for folder in folders
    ]
    ids = [[row["clip_id"] for row in rows] for rows in tables]
    if any(one != ids[0] for one in ids) or not ids[0]:
        raise ValueError(f"{', '.join(map(str, folders))}: turn {turn} was held out on other clips, or none")
    samples = [read_record(folder / "trained" / str(turn))["samples"]["simulated"] for folder in folders]
    scores = np.array([[row["score"] for row in rows] for rows in tables])
    fails = np.array([[float(bool(row["fails"])) for row in rows] for rows in tables])
    towns = clusters_of(ids[0], [row["log_id"] for row in tables[0]])["town"]
    return HeldOut(float(np.mean(samples)), scores, fails, towns)


def shown(found: Interval, percent: bool = False) -> str:
    """A number and its interval."""
    factor, digits = (100.0, 0) if percent else (1.0, 2)
    low, high = (f"{factor * value:.{digits}f}" for value in (found.low, found.high))
    return f"{factor * found.difference:.{digits}f} [{low}, {high}]"


def main(words: Sequence[str]) -> None:
    """Print the table."""
    named = {name: [Path(one) for one in folders.split(",")] for name, _, folders in (w.partition("=") for w in words)}
    first = next(iter(named))
    turns = min(sum(1 for _ in (folder / "held_out").iterdir()) for folders in named.values() for folder in folders)
    print("| turn | drawn | seeds | samples | EPDMS | fails, % | EPDMS against " + first + " |")
    print("|---|---|---|---|---|---|---|")
    for turn in range(turns):
        base = held_out(named[first], turn)
        for name, folders in named.items():
            found = held_out(folders, turn)
            none = np.zeros_like(found.scores)
            score = paired_interval(none, found.scores, clusters=found.towns)
            fails = paired_interval(none, found.fails, clusters=found.towns)
            against = "" if name == first else shown(paired_interval(base.scores, found.scores, clusters=found.towns))
            facts = f"{turn} | {name} | {len(folders)} | {found.samples:.1f}"
            print(f"| {facts} | {shown(score)} | {shown(fails, percent=True)} | {against} |")


if __name__ == "__main__":
    main(sys.argv[1:])
