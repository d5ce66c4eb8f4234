"""From the rows of one planner to its scores: one stage, each of two stages, their product (docs/reward.md 2l, 3)."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow
from tasks.reward.aggregate import COLUMNS, FrameScores, Group, TwoStageScores, aggregate, has_uniform_weights, means_of
from tasks.world.arrays import Array

HumanFilter = Literal["unfiltered", "filtered"]
# Every score that tables hold: stage, human filter. No human drove from a follow-up frame, so nothing filters there.
MEASURES: tuple[tuple[str, str], ...] = (
    ("one_stage", "unfiltered"),
    ("one_stage", "filtered"),
    ("stage_one", "unfiltered"),
    ("stage_one", "filtered"),
    ("stage_two", "none"),  # navhard's: the mean over groups of weighted means
    ("follow_ups", "none"),  # the plain mean of follow-up rows, which no published table holds
    ("final", "unfiltered"),
    ("final", "filtered"),
)


@dataclass(frozen=True)
class ClipResult:
    """One clip and one planner."""

    clip_id: str
    one_stage: FrameScores  # of the logged frame now, among the one-stage evaluation's traffic
    groups: tuple[Group, Group] | None  # now, before; None: the clip has no follow-ups
    log_id: str = ""  # empty: unknown

    @property
    def n_follow_ups(self) -> int:
        """Pairs."""
        return 0 if self.groups is None else len(self.groups[0].stage_two)

    @cached_property
    def two_stage(self) -> TwoStageScores | None:
        """Of this clip alone."""
        return None if self.groups is None else aggregate([self.groups])


@dataclass(frozen=True)
class Summary:
    """Means over clips; columns tasks.reward.aggregate.COLUMNS."""

    n_clips: int
    n_two_stage: int  # clips with follow-ups
    n_follow_ups: int  # pairs
    one_stage: FrameScores
    two_stage: TwoStageScores | None
    uniform_share: float  # of clips whose follow-ups now all weigh the same, NaN without follow-ups
    uniform_share_before: float  # the same for those 0.5 s before


@dataclass(frozen=True)
class SummaryLine:
    """One line of the table of all planners."""

    planner: str
    stage: str  # of MEASURES
    human_filter: str  # of MEASURES
    columns: Array  # (C,) COLUMNS
    n_clips: int
    n_frames: int
    uniform_share: float  # final only, else NaN
    uniform_share_before: float


def group_by_clip(rows: Sequence[FrameRow]) -> list[ClipResult]:
    """One result a clip, by clip id, whatever the order of the rows. Raises ValueError naming a lacking frame."""
    clips: dict[str, list[FrameRow]] = {}
    for row in rows:
        clips.setdefault(row.key.clip_id, []).append(row)
    return [_of_clip(clip_id, clips[clip_id]) for clip_id in sorted(clips)]


def summarise(rows: Sequence[FrameRow]) -> Summary:
    """Means over the clips of all rows of one planner. Raises ValueError for no rows or a lacking frame."""
    return summarise_clips(group_by_clip(rows))


def summarise_clips(clips: Sequence[ClipResult]) -> Summary:
    """Means over the clips of one planner. Raises ValueError for none."""
    if not clips:
        raise ValueError("no frame was scored")
    groups = [clip.groups for clip in clips if clip.groups is not None]
    shares = [
        float(np.mean([has_uniform_weights(pair[side].endpoint_xy, pair[side].starts_xy) for pair in groups]))
        if groups
        else np.nan
        for side in (0, 1)
    ]
    return Summary(
        n_clips=len(clips),
        n_two_stage=len(groups),
        n_follow_ups=sum(clip.n_follow_ups for clip in clips),
        one_stage=means_of([clip.one_stage for clip in clips]),
        two_stage=aggregate(groups) if groups else None,
        uniform_share=shares[0],
        uniform_share_before=shares[1],
    )


def summary_lines(planner: str, summary: Summary) -> list[SummaryLine]:
    """The lines of one planner."""
    logged, follow_ups = 2 * summary.n_two_stage, 2 * summary.n_follow_ups
    n_frames = {"one_stage": summary.n_clips, "stage_one": logged, "final": logged + follow_ups}
    lines = []
    for stage, human_filter in MEASURES:
        if stage != "one_stage" and summary.two_stage is None:
            continue
        columns = stage_columns(summary.one_stage, summary.two_stage, stage, human_filter)
        n_clips = summary.n_clips if stage == "one_stage" else summary.n_two_stage
        shares = (summary.uniform_share, summary.uniform_share_before) if stage == "final" else (np.nan, np.nan)
        frames = n_frames.get(stage, follow_ups)
        lines.append(SummaryLine(planner, stage, human_filter, columns, n_clips, frames, *shares))
    return lines


def stage_columns(one_stage: FrameScores, two_stage: TwoStageScores | None, stage: str, human_filter: str) -> Array:
    """COLUMNS (C,) of one of MEASURES. two_stage is needed for all but one_stage."""
    if stage == "one_stage":
        scores = one_stage
    else:
        assert two_stage is not None
        if stage in ("stage_two", "follow_ups"):
            return two_stage.stage_two if stage == "stage_two" else two_stage.follow_ups
        scores = two_stage.stage_one if stage == "stage_one" else two_stage.final
    return scores.filtered if human_filter == "filtered" else scores.unfiltered


def total_score(columns: Array) -> float:
    """The last of COLUMNS."""
    return float(columns[COLUMNS.index("score")])


Found = dict[tuple[str, FrameKey], FrameRow]


def _of_clip(clip_id: str, rows: Sequence[FrameRow]) -> ClipResult:
    found: Found = {}
    for row in rows:
        if (row.stage, row.key) in found:
            raise ValueError(f"{row.key}: two rows in {row.stage}")
        found[row.stage, row.key] = row
    one_stage = found.get(("one_stage", FrameKey.logged(clip_id)[0]))
    if one_stage is None:
        raise ValueError(f"clip {clip_id}: no row of the logged frame in one_stage")
    has_follow_ups = any(stage == "stage_two" for stage, _ in found)
    groups = _groups(clip_id, found) if has_follow_ups else None
    return ClipResult(clip_id, one_stage.scores, groups, one_stage.log_id)


def _groups(clip_id: str, found: Found) -> tuple[Group, Group]:
    """The groups now and 0.5 s before of a clip with follow-ups."""
    candidates = sorted({key.candidate_index for stage, key in found if stage == "stage_two"})
    groups = []
    for side, logged in enumerate(FrameKey.logged(clip_id)):
        wanted = [("stage_one", logged)]
        wanted += [("stage_two", FrameKey.follow_up(clip_id, i)[side]) for i in candidates]
        for stage, key in wanted:
            if (stage, key) not in found:
                raise ValueError(f"{key}: no row in {stage}")
        first, *after = [found[place] for place in wanted]
        groups.append(
            Group(
                stage_one=first.scores,
                endpoint_xy=first.end[:2],
                stage_two=np.stack([row.scores.unfiltered for row in after]),
                starts_xy=np.stack([row.start[:2] for row in after]),
            )
        )
    return groups[0], groups[1]


PAPER: HumanFilter = "unfiltered"  # what is held against the paper's tables
BOUNDS = ("human", "pdm_closed", "constant_velocity")


def stage_title(stage: str) -> str:
    """A stage as tables call it."""
    return "follow-ups (plain mean)" if stage == "follow_ups" else stage.replace("_", " ")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows of equal columns; numbers with four decimals are enough for scores in percent."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})


@dataclass(frozen=True)
class RunScores:
    """One column of S runs on C clips."""

    clips: tuple[str, ...]
    logs: tuple[str, ...]  # of each clip; empty: unknown
    scores: Array  # (S, C)
    weights: Array  # (S, C) how much a clip's score counts in a mean: rows or groups that it is the mean of


def collect_scores(runs: Sequence[Sequence[ClipResult]], column: str) -> dict[tuple[str, str], RunScores]:
    """(stage, filter) -> scores of the runs; stages that a run lacks, or that are not numbers, are left out.

    Raises ValueError where the runs are not over the same clips, naming what differs.
    """
    check_same_clips(runs)
    found = {}
    for stage, human_filter in MEASURES:
        mine = [[clip for clip in run if stage == "one_stage" or clip.groups is not None] for run in runs]
        if mine[0]:
            found[stage, human_filter] = _of_stage(mine, stage, human_filter, column)
    return {name: values for name, values in found.items() if np.isfinite(values.scores).all()}


def _of_stage(runs: Sequence[Sequence[ClipResult]], stage: str, human_filter: str, column: str) -> RunScores:
    place = COLUMNS.index(column)

    def score(clip: ClipResult) -> float:
        two_stage = None if stage == "one_stage" else clip.two_stage
        return float(stage_columns(clip.one_stage, two_stage, stage, human_filter)[place])

    return RunScores(
        clips=tuple(clip.clip_id for clip in runs[0]),
        logs=tuple(clip.log_id for clip in runs[0]),
        scores=np.array([[score(clip) for clip in run] for run in runs]),
        weights=np.array([[float(_count(clip, stage)) for clip in run] for run in runs]),
    )


def _count(clip: ClipResult, stage: str) -> int:
    """Rows of stage one, groups of stage two and follow-up rows: what a clip's score is the mean of."""
    return {"stage_one": 2, "stage_two": 2, "follow_ups": 2 * clip.n_follow_ups}.get(stage, 1)


def check_same_clips(runs: Sequence[Sequence[ClipResult]]) -> None:
    """Raises ValueError naming a clip that not all runs have with as many follow-ups."""
    shapes = [{clip.clip_id: clip.n_follow_ups for clip in run} for run in runs]
    for n, shape in enumerate(shapes[1:], start=1):
        other = sorted(set(shape.items()) ^ set(shapes[0].items()))
        if other:
            raise ValueError(f"runs 0 and {n} are not over the same frames: clip {other[0][0]} is not in both alike")


# The table of evaluated planners, as CSV and to be printed.

HEAD = ("planner", "stage", "human_filter", *COLUMNS, "clips", "frames", "uniform_share", "uniform_share_before")
# What each line may be held against; said beside every table.
FILTERS_NOTE = (
    "unfiltered compares with the paper's tables, filtered with today's leaderboard (human-penalty filter)",
    "stage_two is weighted as navhard's; follow_ups is the plain mean of its rows, which no published table holds",
)


def write_table(folder: Path, lines: Sequence[SummaryLine]) -> None:
    """`summary.csv` in the folder."""
    with (folder / "summary.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(HEAD)
        for line in lines:
            numbers = [*line.columns, line.n_clips, line.n_frames, line.uniform_share, line.uniform_share_before]
            table.writerow([line.planner, line.stage, line.human_filter, *map(_plain, numbers)])


def table_text(lines: Sequence[SummaryLine]) -> str:
    """The same to be printed, in percent."""
    rows = [_head(), *(_cells(line) for line in lines)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]

    def padded(row: list[str]) -> str:
        return "  ".join(f"{cell:{'<' if i < 3 else '>'}{width}}" for i, (cell, width) in enumerate(zip(row, widths)))

    return "\n".join([*map(padded, rows), *FILTERS_NOTE])


def _head() -> list[str]:
    return ["planner", "stage", "filter", *(name.upper() for name in COLUMNS[:-1]), "EPDMS", "frames", "uniform"]


def _cells(line: SummaryLine) -> list[str]:
    percent = [_percent(value) for value in line.columns]
    return [line.planner, line.stage, line.human_filter, *percent, str(line.n_frames), _percent(line.uniform_share)]


def _percent(value: float) -> str:
    return "-" if np.isnan(value) else f"{100.0 * value:.1f}"


def _plain(value: float) -> float | str:
    """As a CSV holds it: an empty text for NaN."""
    return "" if np.isnan(value) else value
