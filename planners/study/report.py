"""What was compared, frame by frame, in one file, and the tables that are made of it alone.

frames.parquet has a row for each frame and planner: EPDMS (float32), where the frame starts and where the plan from a
logged frame ends, which is what follow-ups are weighted by. Frames are the same for all planners, so that their columns
take next to nothing. What was trained and what is held against what stands in the file's metadata.

`write_tables` makes of it comparisons.csv (means over seeds, differences with intervals over clips, logs and towns),
trainings.csv (each training), bounds.csv and tables.md, to be read.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from planners.evaluation.aggregation import (
    BOUNDS,
    FILTERS_NOTE,
    MEASURES,
    ClipResult,
    HumanFilter,
    group_by_clip,
    score_column,
    scores_in_percent,
    stage_title,
    stages_shown,
    write_csv,
)
from planners.evaluation.benchmark_folder import read_clip_logs
from planners.evaluation.compare import CompareSettings, compare, difference_columns, is_clear_row
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, read_rows
from planners.study.setups import Comparison, Setup, words_of
from tasks.reward.aggregate import COLUMNS, FrameScores

FRAMES = "frames.parquet"
META = b"study"
SCORE = COLUMNS.index("score")
NAMES = ("training", "stage", "log_id", "clip_id", "kind")
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in NAMES),
        ("candidate_index", pa.int32()),
        ("score", pa.float32()),  # EPDMS, 0 .. 1
        ("score_filtered", pa.float32()),  # null: the same
        *((name, pa.float64()) for name in ("start_x", "start_y")),  # rear axle of the frame, world [m]
        *((name, pa.float64()) for name in ("end_x", "end_y")),  # of the plan, world [m]; null for follow-ups
    ]
)
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners compare` has them
INTERVALS = (
    "In brackets: the difference from what the setup is held against, its 95 % interval over clips (paired bootstrap, "
    "with seeds) and, of stage two and the final score, over logs and towns (Student's t over these, or the bootstrap "
    "where it is wider); bold where zero lies outside of each and there are several logs."
)
CLAIMED = ("stage_two", "final")  # the stages whose intervals over logs and towns are shown too

Row = dict[str, Any]  # of comparisons.csv
Clips = Mapping[str, Sequence[ClipResult]]  # by label of the planner; scores alone, no sub-scores


@dataclass(frozen=True)
class StudyFrames:
    """What a study's frames.parquet holds."""

    trainings: tuple[Mapping[str, Any], ...]  # facts of each, with its label under "training"
    comparisons: tuple[Comparison, ...]
    clips: Clips  # also of ensembles and bounds


def rows_of(labels: Iterable[str], evaluations: Path, benchmark: str) -> Iterator[tuple[str, list[FrameRow]]]:
    """The scored frames of each evaluated planner, with the logs of their clips as the benchmark has them."""
    logs = read_clip_logs(benchmark)
    for label in labels:
        yield label, [replace(row, log_id=logs[row.key.clip_id]) for row in read_rows(evaluations / label)]


def write_study(
    path: Path,
    rows: Iterator[tuple[str, Sequence[FrameRow]]],
    trainings: Sequence[Mapping[str, Any]],
    comparisons: Sequence[Comparison],
) -> None:
    """Write a StudyFrames of the rows of each planner, by its label. Whole or not at all."""
    meta = {"trainings": [dict(one) for one in trainings], "comparisons": [asdict(one) for one in comparisons]}
    schema = SCHEMA.with_metadata({META: json.dumps(meta).encode()})
    table = pa.concat_tables(_table(label, of_one) for label, of_one in rows).cast(schema)
    unfinished = path.with_name(f".{path.name}.unfinished")
    pq.write_table(
        table,
        unfinished,
        compression="zstd",
        compression_level=9,
        use_dictionary=[*NAMES, "candidate_index", "start_x", "start_y"],
        write_statistics=False,
    )
    unfinished.replace(path)


def read_study(path: Path) -> StudyFrames:
    """What `write_study` wrote. Raises FileNotFoundError, or ValueError for a file that is none."""
    table = pq.read_table(path)
    kept = (table.schema.metadata or {}).get(META)
    if kept is None or table.column_names != SCHEMA.names:
        raise ValueError(f"{path}: no rows of a study: it must have the columns {', '.join(SCHEMA.names)}")
    columns = (table[name].to_numpy(zero_copy_only=False) for name in SCHEMA.names)
    clips = {
        str(label): group_by_clip([_row(*values) for _, *values in rows])
        for label, rows in groupby(zip(*columns), key=itemgetter(0))
    }
    meta = json.loads(kept)
    for one in meta["comparisons"]:
        one |= {side: one[side] and Setup(**one[side]) for side in ("setup", "reference")}
    return StudyFrames(tuple(meta["trainings"]), tuple(Comparison(**one) for one in meta["comparisons"]), clips)


def _table(label: str, rows: Sequence[FrameRow]) -> pa.Table:
    ordered = sorted(rows, key=lambda row: (row.key.clip_id, row.stage, row.key.candidate_index, row.key.kind))
    return pa.Table.from_pylist([_flat(label, row) for row in ordered], SCHEMA)


def _flat(label: str, row: FrameRow) -> dict[str, Any]:
    score, filtered = (np.float32(values[SCORE]) for values in (row.scores.unfiltered, row.scores.filtered))
    same = score == filtered or np.isnan(filtered)
    ends = (None, None) if row.stage == "stage_two" else row.end
    facts = (row.log_id, row.key.clip_id, row.key.kind, row.key.candidate_index)
    return dict(
        zip(SCHEMA.names, (label, row.stage, *facts, score, None if same else filtered, *row.start[:2], *ends[:2]))
    )


def _row(
    stage: Any, log_id: str, clip_id: str, kind: str, candidate: int, score: float, filtered: float, *places: float
) -> FrameRow:
    """As it was scored, with NaN for what the file does not hold."""
    scores = np.full((2, len(COLUMNS)), np.nan)
    scores[:, SCORE] = score, score if np.isnan(filtered) else filtered
    start, end = (np.array([*places[i : i + 2], np.nan]) for i in (0, 2))
    key = FrameKey(clip_id, kind, int(candidate))
    return FrameRow(stage, key, FrameScores(*scores), np.nan, start, end, log_id=log_id)


def write_tables(frames: Path, out: Path, human_filter: HumanFilter) -> None:
    """The tables of a file of `write_study`, into `out`; human_filter: of tables.md, the CSVs hold both."""
    study = read_study(frames)
    out.mkdir(parents=True, exist_ok=True)
    scores = {label: scores_in_percent(clips) for label, clips in study.clips.items()}
    bounds = [{"planner": name, **scores[name]} for name in BOUNDS if name in scores]
    rows = comparison_rows(study)
    write_csv(out / "comparisons.csv", rows)
    if bounds:
        write_csv(out / "bounds.csv", bounds)
    write_csv(out / "trainings.csv", [{**facts, **scores[facts["training"]]} for facts in study.trainings])
    (out / "tables.md").write_text(markdown_of(rows, human_filter), encoding="utf-8")


def comparison_rows(frames: StudyFrames) -> list[Row]:
    """A row for each comparison and each of MEASURES, in percent: mean over seeds, difference, 95 % intervals."""
    rows = []
    for one in frames.comparisons:
        sides = [[frames.clips[setup.label_of(seed)] for seed in range(one.seeds)] for setup in one.setups]
        intervals = compare(sides[1], sides[0], RULES) if one.reference else {}
        scores = [scores_in_percent(clips) for clips in sides[0]]
        for stage, human_filter in MEASURES:
            each = [score[score_column(stage, human_filter)] for score in scores]
            row = {**one.facts, "stage": stage, "human_filter": human_filter, "epdms": float(np.mean(each))}
            row["each"] = " ".join(f"{score:.1f}" for score in each)
            row["reference"] = one.reference.label if one.reference else ""
            rows.append(row | difference_columns(intervals.get((stage, human_filter))))
    return rows


def markdown_of(rows: Sequence[Row], human_filter: HumanFilter) -> str:
    """EPDMS in percent; in brackets the difference from the reference with its intervals, bold where clear.

    The first interval is over clips. rows: those of comparisons.csv, a comparison's measures one after the other; of
    those with and without the human filter one is shown. A row that is itself a reference stands in front of what is
    held against it.
    """
    mine = [row for row in rows if row["human_filter"] in (human_filter, "none")]
    stages = [stage for stage in stages_shown(human_filter) if any(row["stage"] == stage for row in mine)]
    head = ("planner", "trained on", "equal", "seeds", *map(stage_title, stages), "final of each seed")
    lines = [*wrap(f"Scores are {human_filter}: {FILTERS_NOTE[0]}; {FILTERS_NOTE[1]}.", 120), ""]
    lines += [*wrap(INTERVALS, 120), ""]
    for part, of_part in groupby(mine, key=lambda row: row["part"]):
        rows = list(of_part)
        body = [_cells(rows[i : i + len(stages)]) for i in range(0, len(rows), len(stages))]
        lines += [f"## {part}", "", *markdown_table(head, body)]
    return "\n".join(lines)


def _cells(stages: Sequence[Row]) -> list[str]:
    """Of the rows of one comparison."""
    one = stages[-1]
    facts = [f"`{one['planner']}`", words_of(one), one["budget"], str(one["seeds"])]
    return [*facts, *map(_score, stages), one["each"]]


def _score(row: Row) -> str:
    text = f"{row['epdms']:.1f}"
    if not row["reference"]:
        return text
    bold = "**" if is_clear_row(row) else ""
    said = [f"{bold}{row['difference']:+.1f}{bold}: {row['low']:+.1f} .. {row['high']:+.1f}"]
    if row["stage"] in CLAIMED:
        known = [level for level in ("log", "town") if row.get(f"low_{level}", "") != ""]
        said += [f"{level}s {row[f'low_{level}']:+.1f} .. {row[f'high_{level}']:+.1f}" for level in known]
    return f"{text} ({'; '.join(said)})"


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Its lines, and an empty one behind."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body)] + [""]
