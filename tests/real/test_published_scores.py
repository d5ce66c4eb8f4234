"""Published per-scene scores (SimScale's release, reference/simscale_csv) against this project's formula and means.

What a published column is decides what may be held against it: follow-up rows and stage one are checked number by
number; of stage two, whose weights need the plans' ends, only that it is no plain mean.
"""

import csv
import gzip
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from planners.ab.compare import main
from planners.evaluation.navsim import read_table
from tasks.reward.aggregate import COLUMNS, columns_of, means_over
from tasks.reward.epdms import Scores
from tasks.subscores import RECORDS

Array = NDArray[np.float64]
THEIRS = {record.name: record.long_name for record in RECORDS}
NAVHARD = {"ltf_sim_navhard": 0.44801101737, "gtrs_dense_vov_sim_expert_navhard": 0.65459996490}  # stage two, published
SCORE, EC = COLUMNS.index("score"), COLUMNS.index("ec")


@dataclass(frozen=True)
class Published:
    """COLUMNS as the file has them; EC is NaN where there was no frame before."""

    stage_one: Array  # (N, 10)
    stage_two: Array  # (M, 10)
    summary: dict[str, Array]  # stage_one, stage_two -> (10,)


def rows_of(root: Path, name: str) -> list[dict[str, str]]:
    with gzip.open(root / "reference" / "simscale_csv" / f"{name}.csv.gz", "rt", newline="") as file:
        return list(csv.DictReader(file))


def table_of(rows: list[dict[str, str]], suffix: str = "") -> Array:
    names = [f"{THEIRS[name]}{suffix}" for name in COLUMNS[:-1]]
    return np.array([[float(row[name] or "nan") for name in (*names, "score")] for row in rows])


def navhard(root: Path, name: str) -> Published:
    rows = rows_of(root, name)
    frames = [row for row in rows if not row["token"].startswith("extended")]
    named = {row["token"].removeprefix("extended_pdm_score_"): row for row in rows if row not in frames}
    one = [row for row in frames if row["ego_progress_stage_one"]]
    two = [row for row in frames if row["ego_progress_stage_two"]]
    stages = ("stage_one", "stage_two")
    return Published(
        table_of(one, "_stage_one"),
        table_of(two, "_stage_two"),
        {stage: table_of([named[stage]], f"_{stage}")[0] for stage in stages},
    )


def formula(table: Array) -> Array:
    """(N,) the scores that this project makes of a published row's own sub-scores."""
    sub_scores = {name: table[:, i] for i, name in enumerate(COLUMNS[:EC])}
    zeros = {field.name: np.zeros(len(table)) for field in fields(Scores)}
    multiplier = np.prod([sub_scores[name] for name in ("nc", "dac", "tlc", "ddc")], axis=0)
    weighted = 5 * sub_scores["ep"] + 5 * sub_scores["ttc"] + 2 * sub_scores["lk"] + 2 * sub_scores["hc"]
    made = Scores(**zeros | sub_scores | {"multiplier": multiplier, "pdm_score": multiplier * weighted / 14})
    scores: Array = columns_of(made, table[:, EC])[:, SCORE]
    return scores


@pytest.mark.parametrize("name", NAVHARD)
def test_every_follow_up_row_is_the_formula_of_its_own_columns(shared_root: Path, name: str) -> None:
    follow_ups = navhard(shared_root, name).stage_two
    assert follow_ups.shape == (5462, 10)
    np.testing.assert_allclose(formula(follow_ups), follow_ups[:, SCORE], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "unfiltered", "of_columns"),
    [("ltf_sim_navhard", 0.6625, 0.7340), ("gtrs_dense_vov_sim_expert_navhard", 0.7175, 0.7580)],
)
def test_the_published_stage_one_score_is_unfiltered_beside_filtered_columns(
    shared_root: Path, name: str, unfiltered: float, of_columns: float
) -> None:
    stage_one = navhard(shared_root, name).stage_one
    of_row = formula(stage_one)
    differs = np.abs(of_row - stage_one[:, SCORE]) > 1e-6
    assert 54 <= differs.sum() <= 70
    # A filter can only raise: where they differ, the columns are worth more than the score beside them.
    assert (of_row[differs] > stage_one[differs, SCORE]).all()
    assert stage_one[:, SCORE].mean() == pytest.approx(unfiltered, abs=1e-4)  # the paper's 66.3 and 71.7
    assert of_row.mean() == pytest.approx(of_columns, abs=1e-4)


@pytest.mark.parametrize("name", ["ltf_sim_navtest", *NAVHARD])
def test_a_released_table_makes_its_own_summary_again_to_the_last_digit(shared_root: Path, name: str) -> None:
    """Of logged frames, in every column; which rows weigh what in stage two, no file says."""
    table = read_table(shared_root / "reference" / "simscale_csv" / f"{name}.csv.gz")
    assert table.human_filter == "unfiltered" and not table.failed
    again, published = means_over(np.stack(list(table.logged.values()))), table.summary[table.stage]
    # the public script takes rows in the split's order, which the file has not: one score ends in another bit
    ends_otherwise = [SCORE] if name.startswith("gtrs") else []
    np.testing.assert_array_equal(np.delete(again, ends_otherwise), np.delete(published, ends_otherwise))
    np.testing.assert_array_max_ulp(again, published, 2)


def test_compare_takes_released_tables_on_both_sides(
    shared_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = (shared_root / "reference" / "simscale_csv" / f"{name}.csv.gz" for name in NAVHARD)
    assert main([f"a={a}", f"b={b}", "draws=50", f"out={tmp_path / 'found.csv'}"]) == 0
    capsys.readouterr()
    with (tmp_path / "found.csv").open() as file:
        found = {(row["stage"], row["human_filter"]): row for row in csv.DictReader(file)}
    assert len(found) == 5
    for side, name in zip("ab", NAVHARD):
        combined = next(row for row in rows_of(shared_root, name) if row["token"] == "extended_pdm_score_combined")
        assert float(found["final", "unfiltered"][side]) == float(combined["score"])
        assert float(found["stage_two", "none"][side]) == pytest.approx(NAVHARD[name], abs=1e-11)
        stage_one = navhard(shared_root, name).summary["stage_one"][SCORE]
        assert float(found["stage_one", "unfiltered"][side]) == pytest.approx(stage_one, abs=1e-14)
    assert (found["final", "unfiltered"]["low"], found["final", "unfiltered"]["high"]) == ("", "")
    assert float(found["stage_one", "unfiltered"]["low"]) > 0.0
