"""`python -m planners.compare a=<run> b=<run>`: how two evaluated planners differ, with confidence intervals.

    python -m planners.compare a=eval/ltf_real b=eval/ltf_sim
    python -m planners.compare a=[eval/real_0,eval/real_1] b=[eval/sim_0,eval/sim_1] out=difference.csv
    python -m planners.compare table=docs/study/clips.csv a=gtrs_dense-real-steps-0 b=gtrs_dense-pdm_closed5-epochs-0

A run is a folder that `python -m planners.evaluate` made of one planner, or a column of a study's clips.csv. Several
runs of a side are trainings of one planner with other seeds: clips and seeds are both drawn, pairs of seeds where both
sides have equally many.
"""

import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from factory.config import ConfigError, compose, fill
from planners.aggregation import ClipResult, by_clip
from planners.bootstrap import Interval, paired_interval
from planners.clip_table import read_clips
from planners.eval_record import read_record
from planners.measured import Measured, check_same_clips, measured
from planners.score_rows import read_rows
from planners.score_table import FILTERS_NOTE
from tasks.reward.one_stage import COLUMNS

BAD_CONFIG = 2


@dataclass(frozen=True)
class CompareSettings:
    """The keys of conf/compare.yaml."""

    a: str | list[str]
    b: str | list[str]
    table: str | None = None  # clips.csv of a study, of which a and b are columns
    column: str = "score"  # or a sub-score
    confidence: float = 0.95
    draws: int = 10_000
    seed: int = 0
    out: str | None = None  # a CSV file


def compare(
    a: Sequence[Sequence[ClipResult]], b: Sequence[Sequence[ClipResult]], settings: CompareSettings
) -> dict[tuple[str, str], Interval]:
    """(stage, filter) -> difference of the runs b from the runs a. Raises ValueError where their clips differ."""
    check_same_clips([*a, *b])
    return intervals(measured(a, settings.column), measured(b, settings.column), settings)


def intervals(
    of_a: Mapping[tuple[str, str], Measured], of_b: Mapping[tuple[str, str], Measured], settings: CompareSettings
) -> dict[tuple[str, str], Interval]:
    """(stage, filter) -> difference of what runs scored on the same clips, of stages that both sides have."""
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


def text_of(found: Mapping[tuple[str, str], Interval], confidence: float) -> str:
    """A table to be printed."""
    percent = f"{100 * confidence:g} %"
    lines = [f"{'stage':<10} {'filter':<11}{'a':>9}{'b':>9}{'b - a':>9}   {percent} interval"]
    for (stage, human_filter), one in found.items():
        lines.append(
            f"{stage:<10} {human_filter:<11}{one.a:9.4f}{one.b:9.4f}{one.difference:+9.4f}"
            f"   {one.low:+.4f} .. {one.high:+.4f}{'  *' if one.is_clear else ''}"
        )
    return "\n".join([*lines, f"*: zero lies outside the {percent} interval", *FILTERS_NOTE])


def write_csv(path: Path, found: Mapping[tuple[str, str], Interval]) -> None:
    """One line a stage and filter."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["stage", "human_filter", "a", "b", "difference", "low", "high"])
        for name, one in found.items():
            table.writerow([*name, *asdict(one).values()])


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
        if settings.table is not None:
            if settings.column != "score":
                raise ConfigError(f"compare.column={settings.column}: {settings.table} holds scores alone")
            of_a, of_b = (read_clips(Path(settings.table), side) for side in sides)
            found = intervals(of_a, of_b, settings)
        else:
            a, b = (read_runs(side) for side in sides)
            check_same_rules([*sides[0], *sides[1]])
            found = compare(a, b, settings)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    print(text_of(found, settings.confidence))
    if settings.out is not None:
        write_csv(Path(settings.out), found)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
