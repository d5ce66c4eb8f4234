"""The study's tables in words, and its picture of all differences."""

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from planners.evaluation.aggregation import MEASURES
from planners.study.figures import draw_differences
from planners.study.report import markdown_of
from planners.study.setups import Comparison, Setup, words_of
from planners.study.study import PARTS, StudySettings, comparisons
from tests.planners.study.test_setups import settings


def rows_of(
    one: Comparison, epdms: float, difference: tuple[float, float, float] | None = None, one_log: bool = False
) -> list[dict[str, Any]]:
    against = dict(zip(("difference", "low", "high"), difference or ("", "", "")))
    if difference and not one_log:
        against |= {"low_log": difference[1], "high_log": difference[2]}
    reference = {"reference": "some" if difference else "", **against}
    return [
        {**one.facts, "stage": stage, "human_filter": which, "epdms": epdms, "each": "1.0 2.0", **reference}
        for stage, which in MEASURES
    ]


REAL = Setup("ltf", "real", 0, "steps")
MORE = Setup("ltf", "pdm_closed", 5, "steps")


def test_a_difference_is_bold_where_its_intervals_leave_out_zero_and_there_are_several_logs() -> None:
    real, more = (Comparison("main", setup, None, 2, "steps") for setup in (REAL, MORE))
    clear, open_, worse = (5.04, 0.96, 10.0), (5.0, -1.0, 10.0), (-5.0, -9.0, -1.0)
    found = [*rows_of(real, 30.0), *rows_of(more, 35.04, clear), *rows_of(more, 35.0, open_), *rows_of(more, 25, worse)]
    found += rows_of(more, 35.04, clear, one_log=True)
    text = markdown_of(found, "unfiltered")
    assert text.startswith("Scores are unfiltered: unfiltered compares with the paper's tables")
    assert max(map(len, text.partition("##")[0].splitlines())) <= 120
    lines = text[text.index("##") :].splitlines()
    assert lines[0] == "## main"
    assert lines[2].split(" | ")[4:-1] == ["one stage", "stage one", "stage two", "follow-ups (plain mean)", "final"]
    assert lines[4] == "| `ltf` | real | steps | 2 | 30.0 | 30.0 | 30.0 | 30.0 | 30.0 | 1.0 2.0 |"
    assert lines[5].count("35.0 (**+5.0**: +1.0 .. +10.0") == 5
    assert lines[6].count("35.0 (+5.0: -1.0 .. +10.0") == 5
    assert lines[7].count("25.0 (**-5.0**: -9.0 .. -1.0") == 5
    assert lines[8].count("35.0 (+5.0: +1.0 .. +10.0)") == 5
    assert {line.count("|") for line in lines[2:9]} == {11}


def test_a_table_holds_scores_of_one_human_filter_and_says_which() -> None:
    rows = rows_of(Comparison("main", REAL, None, 1), 1.0)
    for row in rows:
        row["epdms"] = {"unfiltered": 10.0, "filtered": 20.0, "none": 30.0}[row["human_filter"]]
    for which, said in (
        ("unfiltered", "10.0 | 10.0 | 30.0 | 30.0 | 10.0"),
        ("filtered", "20.0 | 20.0 | 30.0 | 30.0 | 20.0"),
    ):
        text = markdown_of(rows, which)
        assert text.startswith(f"Scores are {which}: ") and f"| {said} |" in text


def test_every_part_has_its_own_table() -> None:
    found = [*rows_of(Comparison("main", REAL, None, 3), 1.0), *rows_of(Comparison("ratio", MORE, None, 2), 2.0)]
    heads = [line for line in markdown_of(found, "unfiltered").splitlines() if line.startswith("##")]
    assert heads == ["## main", "## ratio"]


def told_apart(chosen: StudySettings, part: str) -> list[tuple[str, str, str]]:
    mine = [one for one in comparisons(chosen) if one.part == part]
    return [(one.facts["planner"], words_of(one.facts), one.facts["budget"]) for one in mine]


@pytest.mark.parametrize("part", PARTS)
def test_no_two_setups_of_a_part_are_called_the_same(part: str) -> None:
    said = told_apart(settings(), part)
    assert len(set(said)) == len(said) > 1


def test_all_differences_are_drawn_on_one_sheet(tmp_path: Path) -> None:
    one = Comparison("main", MORE, REAL, 3)
    few, many = tmp_path / "few.png", tmp_path / "many.png"
    clear, open_ = (
        [row for row in rows_of(one, 1.0, interval) if row["human_filter"] != "filtered"]
        for interval in ((1.0, 0.5, 1.5), (1.0, -0.5, 1.5))
    )
    draw_differences(clear, few)
    draw_differences(open_ * 40, many)
    with Image.open(few) as a, Image.open(many) as b:
        assert b.height > 4 * a.height and a.convert("L").getextrema()[0] < 128
