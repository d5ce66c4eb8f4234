"""What the pages say of the big comparison is what its kept rows say."""

import csv
import shutil
from pathlib import Path

import pytest

from planners.ab.report import write_report

ROOT = Path(__file__).parents[3]
KEPT = ROOT / "experiments" / "ab"
LONG = ("towns", "acceleration", "drives", "drives_acceleration")


def differences(part: str, against: str = "real") -> dict[tuple[str, str], dict[str, str]]:
    """(arm, measure) -> its row."""
    rows = csv.DictReader((KEPT / part / "differences.csv").open())
    return {(row["who"], row["measure"]): row for row in rows if row["against"] == against}


@pytest.mark.slow
@pytest.mark.parametrize("part", [*(pytest.param(part, marks=pytest.mark.long) for part in LONG), "looking"])
def test_tables_verdict_and_picture_are_made_of_the_kept_rows(part: str, tmp_path: Path) -> None:
    for name in ("frames.parquet", "drives.parquet"):
        shutil.copy(KEPT / part / name, tmp_path / name)
    write_report(tmp_path)
    for name in ("ab.md", "ab.svg", "differences.csv"):
        assert (tmp_path / name).read_text() == (KEPT / part / name).read_text(), name


def shown(row: dict[str, str], *names: str) -> list[str]:
    return [f"{float(row[name]):+.1f}" for name in names]


@pytest.mark.parametrize("part", ["towns", "drives", "looking"])
def test_the_readme_says_the_difference_with_its_widest_interval(part: str) -> None:
    readme = " ".join((ROOT / "README.md").read_text().split())
    for measure in ("two-stage EPDMS", "scene score"):
        row = differences(part)["pdm_closed", measure]
        difference, low, high = shown(row, "difference", "low", "high")
        said = f"| {float(row['reference']):.1f} | {float(row['mean']):.1f} | {difference} ({low} to {high}) |"
        assert said in readme, said


def test_the_pages_table_has_every_arms_difference() -> None:
    page = (ROOT / "docs" / "training.md").read_text()
    lines = {line.split("|")[1].strip(" `"): line for line in page.splitlines() if line.startswith("| `")}
    for part, measures in {
        "towns": ("two-stage EPDMS", "scene score", "scene score from aside"),
        "drives": ("two-stage EPDMS", "scene score"),
    }.items():
        for (who, measure), row in differences(part).items():
            if measure in measures and not who.startswith("("):
                difference, low, high = shown(row, "difference", "low", "high")
                assert f"{difference} ({low}..{high})" in lines[who], (part, who, measure)
