"""Scores of all navtest's tokens by NAVSIM's own scorer (reference/navtest_scores), and the solve they hang on.

Rows of the human's and of PDM-Closed's drives, as NAVSIM's pinned environment gives them on its auditors' machine
("stock") and with the tracker's solver mended ("fallback").
"""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from tasks.subscores import OF_ONE_PLAN, RECORDS, TOTAL_WEIGHT, multiplier_product, weighted_sum
from tests.tasks.rollout.test_profiles import fitted

LONG_NAME = {record.name: record.long_name for record in RECORDS}
HOW = ("stock", "fallback")
BY_200_DIGITS_MPS = 12.533835468245853


def published(shared_root: Path, name: str) -> list[dict[str, str]]:
    """The rows of every token, and their average last."""
    path = shared_root / "reference" / "navtest_scores" / f"{name}_reactive.csv.gz"
    with gzip.open(path, "rt", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("name", "mean"),
    [
        ("human_replay_stock", 0.7399),
        ("human_replay_fallback", 0.8834),
        ("pdm_closed_stock", 0.6713),
        ("pdm_closed_fallback", 0.8597),
    ],
)
def test_every_token_s_score_is_the_formula_of_its_own_columns(shared_root: Path, name: str, mean: float) -> None:
    rows = published(shared_root, name)
    *tokens, average = rows
    assert len(tokens) == 12_146 and not average["frame_type"]
    columns = {name: np.array([float(row[LONG_NAME[name]]) for row in rows]) for name in OF_ONE_PLAN}
    scores = np.array([float(row["score"]) for row in rows])
    ours = multiplier_product(columns) * weighted_sum(columns) / TOTAL_WEIGHT
    np.testing.assert_allclose(ours[:-1], scores[:-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(scores[:-1].mean(), scores[-1], rtol=0, atol=1e-12)
    assert scores[-1] == pytest.approx(mean, abs=5e-5)


def test_the_lost_speed_costs_collisions_and_never_the_road(shared_root: Path) -> None:
    stock, cured = ({row["token"]: row for row in published(shared_root, f"human_replay_{how}")[:-1]} for how in HOW)
    lost = {
        name: sum(float(stock[token][LONG_NAME[name]]) == 0.0 < float(cured[token][LONG_NAME[name]]) for token in stock)
        for name in ("nc", "dac")
    }
    assert stock.keys() == cured.keys() and lost == {"nc": 944, "dac": 0}


def test_the_speed_that_navsim_s_solver_loses_is_found(shared_root: Path) -> None:
    """One plan for which `np.linalg.pinv` of NAVSIM's environment gives -491 m/s."""
    given = np.load(shared_root / "reference" / "navtest_scores" / "tracker_input_40x40.npz")
    plan = np.zeros((1, 41, 3))
    plan[0, 1:, :2] = np.cumsum(given["xy_disp"][0], axis=0)
    plan[0, :, 2] = given["heading_prof"][0, 0]
    assert (given["heading_prof"] == given["heading_prof"][0, 0]).all()
    speed, _ = fitted(plan)
    assert speed[0, 0] == pytest.approx(BY_200_DIGITS_MPS, abs=1e-10)
