"""Benches of scenes at their smallest: they run, and print the rows that docs/reconstruction.md quotes."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.bench import bench_gate, bench_guess, bench_kitti, bench_scenes, bench_town

pytestmark = pytest.mark.long

Printed = Callable[..., list[str]]
FEW = ("iterations=2", "start_gaussians=2000", "most_gaussians=2000")


@pytest.fixture
def printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Printed:
    """The rows of a bench's tables, their heads left out."""

    def run(bench: ModuleType, *words: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", [bench.__name__, *words, f"out={tmp_path}"])
        bench.main()
        lines = capsys.readouterr().out.splitlines()
        return [line for line, after in zip(lines, [*lines[1:], ""]) if line[:2] == "| " and after[:3] != "|--"]

    return run


def test_a_town_is_looked_at_where_no_photo_was(printed: Printed) -> None:
    rows = printed(bench_town, "width=64", "height=36", "steps=5", *FEW)
    assert [row.split(" | ")[0] for row in rows][:2] == ["| held out", "| 1 m to the left"] and len(rows) > 8


def test_the_gate_is_held_against_the_painter(printed: Printed) -> None:
    rows = printed(bench_gate, "chosen=0", "held=0", "clips=1", "drives=1", "every=9", "iterations=2")
    assert len(rows) >= 2 * len(bench_gate.LIMITS)


def test_kitti_is_fitted_and_seen_by_its_other_camera(printed: Printed, shared_root: Path) -> None:
    rows = printed(bench_kitti, str(shared_root / "data/kitti_raw"), "first=0", "last=23", *FEW)
    assert any(row.startswith("| 2 | ") for row in rows), rows


def test_scenes_come_in_one_table(printed: Printed, shared_root: Path) -> None:
    (row,) = printed(bench_scenes, f"kitti={shared_root / 'data/kitti_raw'}", "town=0", "iterations=2")
    assert row.startswith("| KITTI 0001 | ") and row.count(" | ") == 8


def test_guesses_are_held_against_the_eye(printed: Printed) -> None:
    rows = printed(bench_guess, "iterations=2")
    assert rows and all(row.startswith("| town, ") for row in rows)
