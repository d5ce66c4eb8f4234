"""Tables are made of its per-frame rows alone, and are those of the evaluations' own folders."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from planners.evaluation.aggregation import BOUNDS, MEASURES, ClipResult, group_by_clip, scores_in_percent
from planners.evaluation.compare import compare
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, read_rows, write_rows
from planners.study.report import FRAMES, RULES, markdown_of, read_study, rows_of, write_study, write_tables
from planners.study.setups import Comparison, Setup
from tests.planners.made_rows import clip_rows, row

ROOT = Path(__file__).parents[3]
KEPT = ROOT / "experiments" / "study" / "frames" / "towns.parquet"
REAL, MORE = Setup("ltf", "real", 0, "steps"), Setup("ltf", "pdm_closed", 5, "steps")
COMPARISONS = (Comparison("main", REAL, None, 2, "steps"), Comparison("main", MORE, REAL, 2, "steps"))
LABELS = [*(setup.label_of(seed) for setup in (REAL, MORE) for seed in range(2)), *BOUNDS]
LOGS = {f"clip{i}": f"town-{i // 4}-{i // 2:04d}-curve" for i in range(8)}


def scored(seed: int, plans_follow_ups: bool = True) -> list[FrameRow]:
    """Eight clips of four logs of two towns; frames lie where the benchmark has them, ends where the planner's are."""
    place, rng = np.random.default_rng(0), np.random.default_rng(seed)
    rows = []
    for clip_id in LOGS:
        keys = FrameKey.logged(clip_id)
        starts = place.uniform(-300.0, 300.0, (2, 2))
        ends = starts + rng.normal(scale=0.5, size=(2, 2))
        one, *both = rng.uniform(size=3)
        rows.append(row("one_stage", keys[0], one, one + 0.1, tuple(starts[0]), tuple(ends[0])))
        for key, score, start, end in zip(keys, both, starts, ends):
            rows.append(row("stage_one", key, score, score + 0.1, tuple(start), tuple(end)))
        for i in range(3):
            for side, key in enumerate(FrameKey.follow_up(clip_id, i)):
                score = rng.uniform() if plans_follow_ups else np.nan
                start = starts[side] + place.normal(scale=0.7, size=2)
                rows.append(row("stage_two", key, score, start=tuple(start), end=(score, 0.0)))
    return rows


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Evaluated planners, their benchmark's document, and the report's rows."""
    for seed, label in enumerate(LABELS):
        (tmp_path / "evaluations" / label).mkdir(parents=True)
        write_rows(tmp_path / "evaluations" / label, scored(seed, label != "human"))
    clips = [{"clip_id": clip, "log_id": log, "follow_ups": [0, 1, 2]} for clip, log in LOGS.items()]
    (tmp_path / "benchmark.json").write_text(json.dumps({"format": 1, "clips": clips, "left_out": []}))
    (tmp_path / "report").mkdir()
    facts = [{"training": label, "real": 10, "simulated": 5 * n} for n, label in enumerate(LABELS[:4])]
    rows = rows_of(LABELS, tmp_path / "evaluations", str(tmp_path))
    write_study(tmp_path / "report" / FRAMES, rows, facts, COMPARISONS)
    return tmp_path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_scores_of_the_file_are_those_of_the_folders(study: Path) -> None:
    write_tables(study / "report" / FRAMES, study / "report", "unfiltered")
    trainings = {row["training"]: row for row in table(study / "report" / "trainings.csv")}
    bounds = {row["planner"]: row for row in table(study / "report" / "bounds.csv")}
    assert [*trainings, *bounds] == LABELS
    for label, found in {**trainings, **bounds}.items():
        of_folder = scores_in_percent(group_by_clip(read_rows(study / "evaluations" / label)))
        for name, score in of_folder.items():
            assert float(found[name]) == pytest.approx(score, abs=1e-4, nan_ok=True), (label, name)
    assert trainings[LABELS[1]]["simulated"] == "5"
    assert float(trainings[LABELS[0]]["stage_two"]) != pytest.approx(float(trainings[LABELS[0]]["follow_ups"]), abs=0.1)


def test_intervals_stand_over_clips_logs_and_towns_for_both_filters(study: Path) -> None:
    write_tables(study / "report" / FRAMES, study / "report", "filtered")
    rows = table(study / "report" / "comparisons.csv")
    finals = [row for row in rows if row["stage"] == "final" and row["reference"]]
    assert [row["human_filter"] for row in finals] == ["unfiltered", "filtered"]
    for found in finals:
        for level in ("", "_log", "_town"):
            assert float(found[f"low{level}"]) <= float(found["difference"]) <= float(found[f"high{level}"])
    said = (study / "report" / "tables.md").read_text()
    assert said.startswith("Scores are filtered") and "; logs " in said and "; towns " in said


def test_plans_that_end_far_from_every_follow_up_are_counted(tmp_path: Path) -> None:
    for end_m, share in ((0.0, 0.0), (50.0, 1.0)):
        follow_ups, ends = [((0.5, 0.5), (0.0, 0.0), (0.0, 0.0))], ((end_m, 0.0), (end_m, 0.0))
        rows = [row for clip in "abc" for row in clip_rows(clip, 0.5, (0.5, 0.5), ends, follow_ups)]
        facts = [{"training": REAL.label_of(0), "real": 1, "simulated": 0}]
        alone = [Comparison("main", REAL, None, 1, "steps")]
        write_study(tmp_path / FRAMES, iter([(REAL.label_of(0), rows)]), facts, alone)
        write_tables(tmp_path / FRAMES, tmp_path, "unfiltered")
        (found,) = table(tmp_path / "trainings.csv")
        assert float(found["uniform_share"]) == share


def lines_of(
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


def test_a_difference_is_bold_where_its_intervals_leave_out_zero_and_there_are_several_logs() -> None:
    real, more = (Comparison("main", setup, None, 2, "steps") for setup in (REAL, MORE))
    clear, open_, worse = (5.04, 0.96, 10.0), (5.0, -1.0, 10.0), (-5.0, -9.0, -1.0)
    found = [*lines_of(real, 30.0), *lines_of(more, 35.04, clear), *lines_of(more, 35.0, open_)]
    found += [*lines_of(more, 25, worse), *lines_of(more, 35.04, clear, one_log=True)]
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
    rows = lines_of(Comparison("main", REAL, None, 1), 1.0)
    for line in rows:
        line["epdms"] = {"unfiltered": 10.0, "filtered": 20.0, "none": 30.0}[line["human_filter"]]
    for which, said in (
        ("unfiltered", "10.0 | 10.0 | 30.0 | 30.0 | 10.0"),
        ("filtered", "20.0 | 20.0 | 30.0 | 30.0 | 20.0"),
    ):
        text = markdown_of(rows, which)
        assert text.startswith(f"Scores are {which}: ") and f"| {said} |" in text


def test_what_is_no_study_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=FRAMES):
        read_study(tmp_path / FRAMES)
    write_rows(tmp_path, scored(0))
    with pytest.raises(ValueError, match="no rows of a study"):
        read_study(tmp_path / FRAMES)


FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")


@pytest.mark.slow
def test_what_the_readme_says_of_simulated_samples_is_what_the_kept_frames_say() -> None:
    """Scores and intervals over six towns, which are Student's: a bootstrap of stage two says +1.6 .. +13.1."""
    clips = read_study(KEPT).clips

    def means(what: str, seeds: str) -> list[Sequence[ClipResult]]:
        return [clips[f"{family}-{what}-{seed}"] for family in FAMILIES for seed in seeds]

    readme = " ".join((ROOT / "README.md").read_text().split())
    found = compare(means("real-steps", "012"), means("pdm_closed5-epochs", "012"), RULES)
    final, stage_two = found["final", "unfiltered"]["town"], found["stage_two", "none"]["town"]
    for one in (final, stage_two):
        low, high = f"{100 * one.low:+.1f}", f"{100 * one.high:+.1f}"
        row = f"| {100 * one.a:.1f} | {100 * one.b:.1f} | {100 * one.difference:+.1f} ({low} to {high}) |"
        assert row in readme, row
        assert not one.is_clear, "zero lies inside"
    control = compare(means("pdm_closed5-epochs", "01"), means("logged5-steps", "01"), RULES)
    same = control["final", "unfiltered"]["clip"]
    assert f"{100 * same.b:.1f} against {100 * same.a:.1f} (" in readme
    assert f"constant velocity scores {scores_in_percent(clips['constant_velocity'])['final_unfiltered']:.1f}" in readme
