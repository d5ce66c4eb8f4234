"""How evaluated planners differ, with confidence intervals over clips, logs and towns: what `planners compare` prints.

Intervals over logs and over towns, where they are known, take all clips of one together
(planners/evaluation/bootstrap.py): clips of one log share their scene, and an interval over clips alone is too narrow.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factory.config.compose import ConfigError
from planners.evaluation import navsim
from planners.evaluation.aggregation import (
    FILTERS_NOTE,
    ClipResult,
    RunScores,
    check_same_clips,
    collect_scores,
    group_by_clip,
)
from planners.evaluation.bootstrap import LEVELS, Interval, cluster_labels_by_level, paired_interval
from planners.evaluation.few_clusters import Span
from planners.evaluation.score_rows import read_record, read_rows


@dataclass(frozen=True)
class CompareSettings:
    """Everything on the command line of `planners compare`."""

    a: str | list[str]  # folder of an evaluated planner, table of NAVSIM's, or a list of them
    b: str | list[str]
    drives: str | None = None  # the folder where `planners drive` let both sides drive
    column: str = "score"  # or a sub-score: nc dac tlc ddc ep ttc lk hc ec
    confidence: float = 0.95
    draws: int = 10_000
    seed: int = 0
    out: str | None = None  # a CSV file


Measure = navsim.Measure
FINAL: Measure = ("final", "unfiltered")
ByLevel = Mapping[str, Interval]  # of planners.evaluation.bootstrap.LEVELS, those that are known


def compare(
    a: Sequence[Sequence[ClipResult]], b: Sequence[Sequence[ClipResult]], settings: CompareSettings
) -> dict[Measure, ByLevel]:
    """Difference of the runs b from the runs a. Raises ValueError where their clips differ."""
    check_same_clips([*a, *b])
    return intervals(collect_scores(a, settings.column), collect_scores(b, settings.column), settings)


def intervals(
    of_a: Mapping[Measure, RunScores], of_b: Mapping[Measure, RunScores], settings: CompareSettings
) -> dict[Measure, ByLevel]:
    """Difference of what runs scored on the same clips, of measures that both sides have, over clips, logs and towns.

    Raises ValueError where the sides are not over the same clips.
    """
    return {name: _by_level(of_a[name], of_b[name], settings) for name in of_a if name in of_b}


def _by_level(a: RunScores, b: RunScores, settings: CompareSettings) -> ByLevel:
    if a.clips != b.clips:
        raise ValueError("the runs were not scored on the same clips")
    return {
        level: paired_interval(
            a.scores,
            b.scores,
            weights=(a.weights, b.weights),
            clusters=None if level == "clip" else clusters,
            confidence=settings.confidence,
            draws=settings.draws,
            seed=settings.seed,
        )
        for level, clusters in cluster_labels_by_level(a.clips, a.logs).items()
    }


def is_clear(found: ByLevel) -> bool:
    """Whether zero lies outside of every interval that there is."""
    return all(one.is_clear for one in found.values())


def difference_columns(found: ByLevel) -> dict[str, float | str]:
    """Columns of a table: the difference and its bounds over each of LEVELS, empty where there is none."""
    row: dict[str, float | str] = {"difference": found["clip"].difference}
    for level in LEVELS:
        one = found.get(level)
        known = one is not None and np.isfinite(one.low)
        for name in ("low", "high"):
            row[name if level == "clip" else f"{name}_{level}"] = getattr(one, name) if known else ""
    return row


def compare_tables(a: Sequence[str], b: Sequence[str], settings: CompareSettings) -> dict[Measure, ByLevel]:
    """The same where a run is a table of NAVSIM's. Raises ConfigError."""
    runs = navsim.read_tables(a), navsim.read_tables(b)
    of_a, of_b = (navsim.table_scores(side, settings.column) for side in runs)
    navsim.check_same_tokens(of_a, of_b)
    found: dict[Measure, ByLevel] = dict(intervals(of_a, of_b, settings))
    summaries = navsim.published_mean_differences(*runs, settings.column)
    return found | {name: {"clip": one} for name, one in summaries.items()}


def comparison_text(found: Mapping[Measure, ByLevel], confidence: float, of_tables: bool = False) -> str:
    """A table to be printed; of_tables: of `compare_tables`."""
    percent = f"{100 * confidence:g} %"
    levels = [level for level in LEVELS if any(level in by_level for by_level in found.values())]
    over = "".join(f"   {f'{percent} over {level}s':<18}" for level in levels)
    lines = [f"{'stage':<10} {'filter':<11}{'a':>9}{'b':>9}{'b - a':>9}{over}"]
    for (stage, human_filter), by_level in found.items():
        one = by_level["clip"]
        nothing = "no interval" if of_tables else "only one"
        said = "".join(f"   {_bounds(by_level[level], nothing):<18}" for level in levels)
        line = f"{stage:<10} {human_filter:<11}{one.a:9.4f}{one.b:9.4f}{one.difference:+9.4f}{said}"
        lines.append(f"{line}{'  *' if is_clear(by_level) else ''}".rstrip())
    lines.append(f"*: zero lies outside of each {percent} interval")
    if of_tables:
        lines.append(navsim.NOTE)
    elif "log" not in levels:
        lines.append("the runs do not say which log a clip is of: evaluate them again for intervals over logs")
    return "\n".join([*lines, *FILTERS_NOTE])


def _bounds(one: Interval, nothing: str) -> str:
    return f"{one.low:+.4f} .. {one.high:+.4f}" if np.isfinite(one.low) else nothing


def score_sentence(found: Mapping[Measure, ByLevel], settings: CompareSettings) -> str:
    """Of the two-stage score, else of one stage's, over the highest level of which there are two clusters."""
    measure = FINAL if FINAL in found else next(iter(found))
    known = [level for level, one in found[measure].items() if np.isfinite(one.low)] or ["clip"]
    what = "EPDMS" if settings.column == "score" else settings.column.upper()
    words = f"two-stage {what}" if measure == FINAL else what
    return difference_sentence(words, found[measure][known[-1]], known[-1], settings.confidence)


def difference_sentence(what: str, one: Interval, level: str, confidence: float, unit: str = "") -> str:
    """What both sides have in hundredths, the difference, its interval over clusters of a level, and what that says.

    Of few clusters it names both intervals where they differ, and the p of sign flips.
    """
    said = f"{what} {100 * one.b:.1f}{unit} against {100 * one.a:.1f}{unit}, {100 * one.difference:+.1f}"
    if not np.isfinite(one.low):
        return f"{said} (no interval)"
    verdict = ("better" if one.low > 0.0 else "worse") if one.is_clear else "no difference told from zero"
    ends, student, wild = (_ends(span) for span in ((one.low, one.high), one.student, one.wild))
    both = f"; t {student}, wild bootstrap {wild}" if np.isfinite(one.wild[0]) and student != wild else ""
    flips = f"; p {one.p:.2g}" if np.isfinite(one.p) else ""
    return f"{said} ({100 * confidence:g} % over {one.n} {level}s: {ends}{both}{flips}), {verdict}"


def _ends(span: Span) -> str:
    return f"{100 * span[0]:+.1f} to {100 * span[1]:+.1f}"


def write_csv(path: Path, found: Mapping[Measure, ByLevel]) -> None:
    """One line a measure."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        for n, (name, by_level) in enumerate(found.items()):
            row = difference_columns(by_level)
            if n == 0:
                table.writerow(["stage", "human_filter", "a", "b", *row])
            table.writerow([*name, by_level["clip"].a, by_level["clip"].b, *row.values()])


def read_runs(folders: str | Sequence[str]) -> list[list[ClipResult]]:
    """The clips of each run. Raises ConfigError naming the folder that is none."""
    runs = []
    for folder in [folders] if isinstance(folders, str) else folders:
        try:
            runs.append(group_by_clip(read_rows(Path(folder))))
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
