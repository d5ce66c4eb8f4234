"""NAVSIM's tables of scores.

A table of a planner's scores is the CSV of `run_pdm_score.py` and `run_pdm_score_one_stage.py`. It has a row for each
token, then the summary: the mean of one stage, or stage one, stage two and both combined of two stages
(autonomousvision/navsim @ 0a380a9, navsim/planning/script/run_pdm_score.py:368-455 and run_pdm_score_one_stage.py).
Both of the code's eras have the same columns. That of the paper (SimScale @ f51ad64) has filtered sub-scores beside an
unfiltered score, that of today filters the score too: `write_tables` writes one file of each kind.

Tables are held against each other as runs of `compare`: a released file, one that NAVSIM wrote, or a folder that
`evaluate` made. Rows pair by their tokens. What of the two-stage score is published stands in a file's summary alone:
follow-ups weigh by where the plan ended, which no such file holds, so these differences have no interval.
"""

import csv
import gzip
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from factory.config.compose import ConfigError
from planners.evaluation.aggregation import HumanFilter, RunScores, Summary, group_by_clip, summarise_clips
from planners.evaluation.bootstrap import Interval
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow
from tasks.reward.aggregate import COLUMNS, FrameScores, means_over
from tasks.subscores import EC_WEIGHT, RECORDS, TOTAL_WEIGHT, multiplier_product, weighted_sum
from tasks.world.arrays import Array

FILTERS: tuple[HumanFilter, ...] = ("unfiltered", "filtered")
LONG = {record.name: record.long_name for record in RECORDS}  # in the public order
PLACES = [COLUMNS.index(name) for name in LONG]
ONE, TWO = "_stage_one", "_stage_two"
SCORE = COLUMNS.index("score")
AVERAGE = "average_all_frames"
EXTENDED = {stage: f"extended_pdm_score_{stage}" for stage in ("stage_one", "stage_two", "combined")}
SAME = 1e-9  # of a mean, whatever the order of its rows; of a row's score, whatever the order of its terms


def file_name(human_filter: HumanFilter) -> str:
    """Of a planner's table in its folder, by the filter of its score."""
    return f"navsim_{human_filter}.csv"


def head_of(two_stage: bool) -> list[str]:
    """The columns behind the row's number, in their order."""
    names = [name + end for end in ((ONE, TWO) if two_stage else ("",)) for name in LONG.values()]
    return ["token", "valid", *names, "score"]


def write_tables(folder: Path, rows: Sequence[FrameRow], tokens: Mapping[FrameKey, str]) -> None:
    """Both tables of a planner's rows; rows of one clip follow each other. Raises KeyError for a frame without token.

    With follow-ups it is the table of two stages, else of one. A row without a score is not `valid`, as one of which
    the public script says that the agent failed.
    """
    results = {clip.clip_id: clip for clip in group_by_clip(rows)}
    summary = summarise_clips([results[clip_id] for clip_id in dict.fromkeys(row.key.clip_id for row in rows)])
    two_stage = summary.two_stage is not None
    stages = ("stage_one", "stage_two") if two_stage else ("one_stage",)
    ordered = [row for stage in stages for row in rows if row.stage == stage]
    for human_filter in FILTERS:
        lines = [_line(tokens[row.key], row.stage, row.scores, human_filter, two_stage) for row in ordered]
        lines += _summary_lines(summary, human_filter, all(line[1] == "True" for line in lines))
        with (folder / file_name(human_filter)).open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(["", *head_of(two_stage)])
            table.writerows([number, *line] for number, line in enumerate(lines))


def _line(token: str, stage: str, scores: FrameScores, human_filter: HumanFilter, two_stage: bool) -> list[str]:
    own = scores.filtered[PLACES]
    none = np.full(len(own), np.nan)
    numbers = own if not two_stage else np.append(own, none) if stage == "stage_one" else np.append(none, own)
    score = float(getattr(scores, human_filter)[SCORE])
    return [token, str(not np.isnan(score)), *map(_text, [*numbers, score])]


def _summary_lines(summary: Summary, human_filter: HumanFilter, valid: bool) -> list[list[str]]:
    two_stage = summary.two_stage
    if two_stage is None:
        means = _line(AVERAGE, "one_stage", summary.one_stage, human_filter, False)
        return [[AVERAGE, str(valid), *means[2:]]]
    after = FrameScores(two_stage.stage_two, two_stage.stage_two)
    one, two = (
        _line(EXTENDED[stage], stage, scores, human_filter, True)[2:]
        for stage, scores in (("stage_one", two_stage.stage_one), ("stage_two", after))
    )
    n, final = len(LONG), float(getattr(two_stage.final, human_filter)[SCORE])
    combined = [*one[:n], *two[n:-1], _text(final)]
    return [[EXTENDED[name], str(valid), *line] for name, line in zip(EXTENDED, (one, two, combined))]


def _text(value: float) -> str:
    """The shortest text of just this number, as pandas writes it."""
    return "" if np.isnan(value) else repr(float(value))


@dataclass(frozen=True)
class PublicTable:
    """What such a file holds, ours or another's."""

    file: str
    logged: Mapping[str, Array]  # token -> (C,) COLUMNS
    follow_ups: Mapping[str, Array]  # the same; none of one stage
    summary: Mapping[str, Array]  # of one_stage, or stage_one, stage_two and final, of which only the score is anything
    failed: tuple[str, ...] = ()  # tokens without any number

    @property
    def stage(self) -> str:
        """Of the logged frames."""
        return "one_stage" if "one_stage" in self.summary else "stage_one"

    @cached_property
    def human_filter(self) -> HumanFilter:
        """Of its score: unfiltered where some logged row has another than its own filtered sub-scores make."""
        rows = np.stack(list(self.logged.values()))
        known = ~np.isnan(rows[:, SCORE])
        differs = np.abs(score_of_columns(rows[known]) - rows[known, SCORE]) > SAME
        return "unfiltered" if differs.any() else "filtered"

    def scores(self, human_filter: HumanFilter) -> dict[str, Array] | None:
        """Token -> (C,) of the logged frames; None: a file of filtered scores does not hold the unfiltered ones."""
        if human_filter == self.human_filter:
            return dict(self.logged)
        if human_filter == "unfiltered":
            return None
        rows = np.stack(list(self.logged.values()))
        rows[:, SCORE] = score_of_columns(rows)
        return dict(zip(self.logged, rows))


def score_of_columns(rows: Array) -> Array:
    """(N,) what sub-scores (N, C) of COLUMNS make, without extended comfort where there is none."""
    named = {name: rows[:, i] for i, name in enumerate(COLUMNS)}
    known = ~np.isnan(named["ec"])
    terms = weighted_sum(named) + np.where(known, EC_WEIGHT * np.nan_to_num(named["ec"]), 0.0)
    made: Array = multiplier_product(named) * (terms / (TOTAL_WEIGHT + np.where(known, EC_WEIGHT, 0.0)))
    return made


def read_table(path: Path) -> PublicTable:
    """A file of either script, `.csv` or `.csv.gz`.

    Raises OSError, or ValueError for a file of other columns, one without its summary rows, a token that stands twice
    and a summary of logged frames that is not the mean of the file's own rows.
    """
    lines = list(_lines(path))
    head = lines[0] if lines else []
    two_stage = head[1:] == head_of(True)
    if not two_stage and head[1:] != head_of(False):
        raise ValueError(f"{path}: no table of NAVSIM's: its columns must be {', '.join(head_of(False))}, or of stages")
    ends = set(EXTENDED.values()) if two_stage else {AVERAGE}
    found: dict[str, tuple[Array, Array, float]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(head):
            raise ValueError(f"{path}, line {number}: {len(line)} cells, the head has {len(head)}")
        if line[1] in found:
            raise ValueError(f"{path}, line {number}: token {line[1]} stands there twice")
        try:
            numbers = np.array([float(cell or "nan") for cell in line[3:]])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
        parts = numbers[: len(LONG)], numbers[len(LONG) : -1] if two_stage else numbers[:0]
        found[line[1]] = *parts, float(numbers[-1])
    if missing := sorted(ends - found.keys()):
        raise ValueError(f"{path}: no row {missing[0]}: it was not written to its end")
    rows = {token: of_one for token, of_one in found.items() if token not in ends}
    logged = {token: _columns(one, score) for token, (one, _, score) in rows.items() if np.isfinite(one).any()}
    follow_ups = {token: _columns(two, score) for token, (_, two, score) in rows.items() if np.isfinite(two).any()}
    if not logged:
        raise ValueError(f"{path}: no scored row of a logged frame")
    summary = {"one_stage": _columns(found[AVERAGE][0], found[AVERAGE][2])} if not two_stage else _stages_of(found)
    failed = tuple(token for token in rows if token not in logged and token not in follow_ups)
    table = PublicTable(str(path), logged, follow_ups, summary, failed)
    said, again = summary[table.stage], means_over(np.stack(list(logged.values())))
    for name, written, mean in zip(COLUMNS, said, again):
        if not np.isclose(written, mean, rtol=0.0, atol=SAME, equal_nan=True):
            raise ValueError(
                f"{path}: the summary of {table.stage} says {written} for {LONG.get(name, name)}, its {len(logged)} "
                f"rows make {mean}: rows are missing or were changed"
            )
    return table


def _lines(path: Path) -> Iterator[list[str]]:
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", newline="", encoding="utf-8") as file:
        yield from csv.reader(file)


def _stages_of(found: Mapping[str, tuple[Array, Array, float]]) -> dict[str, Array]:
    one, two, both = (found[EXTENDED[name]] for name in EXTENDED)
    return {
        "stage_one": _columns(one[0], one[2]),
        "stage_two": _columns(two[1], two[2]),
        "final": _columns(np.full(len(LONG), np.nan), both[2]),
    }


def _columns(sub_scores: Array, score: float) -> Array:
    row = np.full(len(COLUMNS), np.nan)
    row[PLACES], row[SCORE] = sub_scores, score
    return row


Measure = tuple[str, str]  # stage, human filter
SUFFIXES = (".csv", ".csv.gz")
NOTE = (
    "tables of NAVSIM's: stage_two and final are the files' own summaries and have no interval, since no file says "
    "where a plan ended"
)


def read_tables(paths: Sequence[str]) -> list[list[PublicTable]]:
    """Of each run its table, of a folder both of its tables. Raises ConfigError naming what is none."""
    runs = []
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [path / file_name(human_filter) for human_filter in FILTERS]
            if not files[0].is_file():
                raise ConfigError(
                    f"{path}: no {files[0].name}: evaluate writes it on a benchmark whose frames have NAVSIM's tokens "
                    "(docs/training.md), and only of such can a planner be held against a table of NAVSIM's"
                )
        try:
            runs.append([read_table(file) for file in files])
        except (OSError, ValueError) as error:
            raise ConfigError(str(error)) from error
    return runs


def table_scores(runs: Sequence[Sequence[PublicTable]], column: str) -> dict[Measure, RunScores]:
    """(stage, filter) -> one column of the runs over their tokens; what a run does not hold is left out.

    Raises ConfigError where runs are not over the same tokens, or some of a stage failed.
    """
    found = {}
    for name in _measures(runs):
        rows = [_rows(run, *name) for run in runs]
        whole = [one for one in rows if one]
        if len(whole) == len(rows):
            found[name] = _paired(runs, whole, column)
    return found


def check_same_tokens(first: Mapping[Measure, RunScores], second: Mapping[Measure, RunScores]) -> None:
    """Raises ConfigError where the sides share no stage, or hold one of other tokens."""
    if not first.keys() & second.keys():
        stages = [sorted({name[0] for name in side}) for side in (first, second)]
        raise ConfigError(f"a is of {', '.join(stages[0])}, b of {', '.join(stages[1])}: nothing to hold against it")
    for name in first.keys() & second.keys():
        if other := set(first[name].clips) ^ set(second[name].clips):
            raise ConfigError(f"{name[0]}: {len(other)} tokens stand on one side alone, such as {min(other)}")


def published_mean_differences(
    a: Sequence[Sequence[PublicTable]], b: Sequence[Sequence[PublicTable]], column: str
) -> dict[Measure, Interval]:
    """(stage, filter) -> difference of the published means of two stages, without an interval."""
    of_a, of_b = (_published(side, column) for side in (a, b))
    return {
        name: Interval(of_b[name] - of_a[name], np.nan, np.nan, of_a[name], of_b[name]) for name in of_a if name in of_b
    }


def _measures(runs: Sequence[Sequence[PublicTable]]) -> list[Measure]:
    return [*((runs[0][0].stage, which) for which in FILTERS), ("follow_ups", "none")]


def _rows(run: Sequence[PublicTable], stage: str, human_filter: str) -> Mapping[str, Array] | None:
    """Token -> (C,) of one run."""
    if run[0].stage != stage and stage != "follow_ups":
        raise ConfigError(f"{run[0].file}: a table of {run[0].stage}, another run has {stage}")
    if stage == "follow_ups":
        return run[0].follow_ups
    if len(run) > 1:  # of a folder, whose files say by their names what they are
        return dict(zip(FILTERS, run))[_which(human_filter)].logged
    return run[0].scores(_which(human_filter))


def _which(human_filter: str) -> HumanFilter:
    return "filtered" if human_filter == "filtered" else "unfiltered"


def _paired(runs: Sequence[Sequence[PublicTable]], rows: Sequence[Mapping[str, Array]], column: str) -> RunScores:
    tokens = tuple(sorted(rows[0]))
    for run, one in zip(runs, rows):
        if other := one.keys() ^ rows[0].keys():
            failed = " and failed" if min(other) in (*run[0].failed, *runs[0][0].failed) else ""
            raise ConfigError(
                f"{run[0].file} and {runs[0][0].file} differ in {len(other)} tokens, such as {min(other)}{failed}"
            )
    scores = np.array([[one[token][COLUMNS.index(column)] for token in tokens] for one in rows])
    known = np.isfinite(scores).all(axis=0)  # extended comfort alone is not of every frame
    kept = tuple(token for token, there in zip(tokens, known) if there)
    return RunScores(kept, ("",) * len(kept), scores[:, known], np.ones((len(rows), len(kept))))


def _published(runs: Sequence[Sequence[PublicTable]], column: str) -> dict[Measure, float]:
    """Means over the runs of what their files say of stage two and both stages."""
    place, found = COLUMNS.index(column), {}
    for name in (("stage_two", "none"), *(("final", which) for which in FILTERS)):
        said = [_summary(run, *name) for run in runs]
        values = [float(one[place]) for one in said if one is not None]
        if len(values) == len(runs) and np.isfinite(values).all():
            found[name] = float(np.mean(values))
    return found


def _summary(run: Sequence[PublicTable], stage: str, human_filter: str) -> Array | None:
    if stage == "stage_two" or len(run) == 1:
        its_own = stage == "stage_two" or run[0].human_filter == human_filter
        return run[0].summary.get(stage) if its_own else None
    return dict(zip(FILTERS, run))[_which(human_filter)].summary.get(stage)
