"""The table of evaluated planners, as CSV and to be printed."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from planners.evaluation.aggregation import SummaryLine
from tasks.reward.aggregate import COLUMNS

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
    """Nothing where there is no number."""
    return "" if np.isnan(value) else value
