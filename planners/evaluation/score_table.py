"""The table of evaluated planners, as CSV and as a picture."""

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from planners.evaluation.aggregation import SummaryLine
from tasks.reward.aggregate import COLUMNS
from tasks.world.arrays import Image

HEAD = ("planner", "stage", "human_filter", *COLUMNS, "clips", "frames", "uniform_share", "uniform_share_before")
ROW_PX, NAME_PX, CELL_PX, MARGIN_PX = 24, 8, 62, 12  # NAME_PX: a letter's width
# What each line may be held against; said beside every table.
FILTERS_NOTE = (
    "unfiltered compares with the paper's tables, filtered with today's leaderboard (human-penalty filter)",
    "stage_two is weighted as navhard's; follow_ups is the plain mean of its rows, which no published table holds",
)
INK, FAINT, STRIPE, PAPER = (30, 30, 30), (140, 140, 140), (238, 241, 244), (252, 252, 250)
FONT, SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.42


def write_table(folder: Path, lines: Sequence[SummaryLine]) -> None:
    """`summary.csv` and `summary.png` in the folder."""
    with (folder / "summary.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(HEAD)
        for line in lines:
            numbers = [*line.columns, line.n_clips, line.n_frames, line.uniform_share, line.uniform_share_before]
            table.writerow([line.planner, line.stage, line.human_filter, *map(_plain, numbers)])
    done, data = cv2.imencode(".png", cv2.cvtColor(picture(lines), cv2.COLOR_RGB2BGR))
    assert done, "OpenCV cannot write .png"
    (folder / "summary.png").write_bytes(bytes(data))


def table_text(lines: Sequence[SummaryLine]) -> str:
    """The same to be printed, in percent."""
    rows = [_head(), *(_cells(line) for line in lines)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]

    def padded(row: list[str]) -> str:
        return "  ".join(f"{cell:{'<' if i < 3 else '>'}{width}}" for i, (cell, width) in enumerate(zip(row, widths)))

    return "\n".join([*map(padded, rows), *FILTERS_NOTE])


def picture(lines: Sequence[SummaryLine]) -> Image:
    """The same drawn: RGB (height, width, 3)."""
    rows = [_head(), *(_cells(line) for line in lines)]
    names = [MARGIN_PX + NAME_PX * max(len(row[i]) for row in rows) for i in range(3)]
    widths = [*names, *[CELL_PX] * (len(rows[0]) - 3)]
    height = ROW_PX * (len(rows) + len(FILTERS_NOTE)) + 2 * MARGIN_PX
    image = np.full((height, sum(widths) + 2 * MARGIN_PX, 3), PAPER, np.uint8)
    planners = list(dict.fromkeys(row[0] for row in rows[1:]))
    for r, row in enumerate(rows):
        top = MARGIN_PX + r * ROW_PX
        if r and planners.index(row[0]) % 2 == 0:
            image[top : top + ROW_PX] = STRIPE
        left = MARGIN_PX
        for i, (cell, width) in enumerate(zip(row, widths)):
            (text_px, _), _ = cv2.getTextSize(cell, FONT, SIZE, 1)
            x = left if i < 3 else left + width - text_px
            colour = INK if r and (i == 0 or row[2] != "filtered") else FAINT
            cv2.putText(image, cell, (x, top + ROW_PX - 8), FONT, SIZE, colour, 1, cv2.LINE_AA)
            left += width
    for r, note in enumerate(FILTERS_NOTE, start=len(rows) + 1):
        cv2.putText(image, note, (MARGIN_PX, MARGIN_PX + r * ROW_PX - 8), FONT, SIZE, FAINT, 1, cv2.LINE_AA)
    return image


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
