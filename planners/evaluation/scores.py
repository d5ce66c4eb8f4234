"""The scores of evaluated planners, as plain numbers."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from planners.evaluation.aggregation import MEASURES, ClipResult, HumanFilter, by_clip, lines_of, score_of, summary_of
from planners.evaluation.score_rows import read_rows

PAPER: HumanFilter = "unfiltered"  # what is held against the paper's tables
BOUNDS = ("human", "pdm_closed", "constant_velocity")


def shown(human_filter: HumanFilter) -> dict[str, str]:
    """Stage -> the filter under which it stands in a table of so filtered scores."""
    return {stage: which for stage, which in MEASURES if which in (human_filter, "none")}


def scores_of(folder: Path) -> dict[str, float]:
    """`scores_of_clips` of one evaluated planner."""
    return scores_of_clips(by_clip(read_rows(folder)))


def scores_of_clips(clips: Sequence[ClipResult]) -> dict[str, float]:
    """Of one planner: name_of(stage, filter) -> EPDMS in percent, and its share of uniform fallbacks."""
    found = {}
    for line in lines_of("", summary_of(clips)):
        found[name_of(line.stage, line.human_filter)] = 100.0 * score_of(line.columns)
        if line.stage == "final":
            found["uniform_share"] = line.uniform_share
    return found


def name_of(stage: str, human_filter: str) -> str:
    """Column of a score."""
    return stage if human_filter == "none" else f"{stage}_{human_filter}"


def title_of(stage: str, human_filter: str) -> str:
    """A score in words, with what it may be held against."""
    words = {
        "one_stage": "EPDMS of one stage",
        "stage_one": "EPDMS of stage one",
        "stage_two": "EPDMS of stage two",
        "follow_ups": "EPDMS of follow-ups (plain mean)",
        "final": "two-stage EPDMS",
    }[stage]
    return f"{words}{'' if human_filter == 'none' else f', {human_filter}'}"


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows of equal columns; numbers with four decimals are enough for scores in percent."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})
