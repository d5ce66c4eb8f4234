"""`python -m planners.compare a=<run> b=<run>`: how two evaluated planners differ, with confidence intervals.

    python -m planners.compare a=eval/ltf_real b=eval/ltf_sim
    python -m planners.compare a=[eval/real_0,eval/real_1] b=[eval/sim_0,eval/sim_1] out=difference.csv

A run is a folder that `python -m planners.evaluate` made of one planner. Several runs of a side are trainings of one
planner with other seeds: clips and seeds are both drawn, pairs of seeds where both sides have equally many.
"""

import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.config import ConfigError, compose, fill
from planners.aggregation import ClipResult, by_clip
from planners.bootstrap import Interval, paired_interval
from planners.eval_record import read_record
from planners.score_rows import read_rows
from tasks.reward.one_stage import COLUMNS

Array = NDArray[np.float64]
BAD_CONFIG = 2


@dataclass(frozen=True)
class CompareSettings:
    """The keys of conf/compare.yaml."""

    a: str | list[str]
    b: str | list[str]
    column: str = "score"  # or a sub-score
    confidence: float = 0.95
    draws: int = 10_000
    seed: int = 0
    out: str | None = None  # a CSV file


@dataclass(frozen=True)
class Measured:
    """One column of S runs on C clips."""

    scores: Array  # (S, C)
    weights: Array  # (S, C) frames that a clip's score is the mean of


def measured(runs: Sequence[Sequence[ClipResult]], column: str) -> dict[tuple[str, str], Measured]:
    """(stage, filter) -> scores of the runs; stages that a run lacks, or that are not numbers, are left out.

    Raises ValueError where the runs are not over the same clips, naming what differs.
    """
    _check_clips(runs)
    found = {}
    for name in (("one_stage", f) for f in ("unfiltered", "filtered")):
        found[name] = Measured(*_arrays([[_one(clip, *name, column) for clip in run] for run in runs]))
    for stage in ("stage_one", "stage_two", "final"):
        for human_filter in ("none",) if stage == "stage_two" else ("unfiltered", "filtered"):
            scores = [
                [_one(clip, stage, human_filter, column) for clip in run if clip.groups is not None] for run in runs
            ]
            if scores[0]:
                found[stage, human_filter] = Measured(*_arrays(scores))
    return {name: values for name, values in found.items() if np.isfinite(values.scores).all()}


def compare(
    a: Sequence[Sequence[ClipResult]], b: Sequence[Sequence[ClipResult]], settings: CompareSettings
) -> dict[tuple[str, str], Interval]:
    """(stage, filter) -> difference of the runs b from the runs a. Raises ValueError where their clips differ."""
    _check_clips([*a, *b])
    of_a, of_b = measured(a, settings.column), measured(b, settings.column)
    return {
        name: paired_interval(
            of_a[name].scores,
            of_b[name].scores,
            weights=(of_a[name].weights, of_b[name].weights),
            confidence=settings.confidence,
            draws=settings.draws,
            seed=settings.seed,
        )
        for name in of_a
        if name in of_b
    }


def _one(clip: ClipResult, stage: str, human_filter: str, column: str) -> tuple[float, float]:
    """Score and number of frames."""
    place = COLUMNS.index(column)
    if stage == "one_stage":
        scores, count = clip.one_stage, 1
    else:
        two = clip.two_stage
        assert two is not None
        if stage == "stage_two":
            return float(two.stage_two[place]), 2.0 * clip.n_follow_ups
        scores, count = (two.stage_one, 2) if stage == "stage_one" else (two.final, 1)
    return float((scores.filtered if human_filter == "filtered" else scores.unfiltered)[place]), float(count)


def _arrays(runs: Sequence[Sequence[tuple[float, float]]]) -> tuple[Array, Array]:
    both = np.array(runs, dtype=np.float64)
    return both[..., 0], both[..., 1]


def _check_clips(runs: Sequence[Sequence[ClipResult]]) -> None:
    shapes = [{clip.clip_id: clip.n_follow_ups for clip in run} for run in runs]
    for n, shape in enumerate(shapes[1:], start=1):
        other = sorted(set(shape.items()) ^ set(shapes[0].items()))
        if other:
            raise ValueError(f"runs 0 and {n} are not over the same frames: clip {other[0][0]} is not in both alike")


def text_of(intervals: Mapping[tuple[str, str], Interval], confidence: float) -> str:
    """A table to be printed."""
    percent = f"{100 * confidence:g} %"
    lines = [f"{'stage':<10} {'filter':<11}{'a':>9}{'b':>9}{'b - a':>9}   {percent} interval"]
    for (stage, human_filter), found in intervals.items():
        lines.append(
            f"{stage:<10} {human_filter:<11}{found.a:9.4f}{found.b:9.4f}{found.difference:+9.4f}"
            f"   {found.low:+.4f} .. {found.high:+.4f}{'  *' if found.is_clear else ''}"
        )
    return "\n".join([*lines, f"*: zero lies outside the {percent} interval"])


def write_csv(path: Path, intervals: Mapping[tuple[str, str], Interval]) -> None:
    """One line a stage and filter."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["stage", "human_filter", "a", "b", "difference", "low", "high"])
        for name, found in intervals.items():
            table.writerow([*name, *asdict(found).values()])


def read_runs(folders: str | Sequence[str]) -> list[list[ClipResult]]:
    """The clips of each run. Raises ConfigError naming the folder that is none."""
    runs = []
    for folder in [folders] if isinstance(folders, str) else folders:
        try:
            runs.append(by_clip(read_rows(Path(folder))))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{folder}: not an evaluated planner: {error}") from error
    if not runs:
        raise ConfigError("compare.a and compare.b must name at least one run each")
    return runs


def check_same_rules(folders: Sequence[str]) -> None:
    """Raises ConfigError where two runs were made on another benchmark or by other rules."""
    records = [read_record(Path(folder)) for folder in folders]
    for folder, record in zip(folders, records):
        for what in ("benchmark_digest", "rules"):
            if record[what] != records[0][what]:
                raise ConfigError(f"{folders[0]} and {folder} differ in their {what}: evaluate both the same way")


def main(argv: Sequence[str]) -> int:
    """The command; 2 with a message for what cannot be compared."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        settings = fill(CompareSettings, compose("compare", argv), "compare")
        if settings.column not in COLUMNS:
            raise ConfigError(f"compare.column={settings.column}: one of {', '.join(COLUMNS)}")
        sides = [[side] if isinstance(side, str) else side for side in (settings.a, settings.b)]
        a, b = (read_runs(side) for side in sides)
        check_same_rules([*sides[0], *sides[1]])
        intervals = compare(a, b, settings)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    print(text_of(intervals, settings.confidence))
    if settings.out is not None:
        write_csv(Path(settings.out), intervals)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
