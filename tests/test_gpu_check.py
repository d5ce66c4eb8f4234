"""`make gpu-check`: what it says where there is no GPU, and that its tables come out."""

import sys
from pathlib import Path

import pytest

from tests.bench.gpu_check import main


def test_without_gsplat_it_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert main({"page": str(tmp_path / "page.txt")}) == 2
    out, err = capsys.readouterr()
    assert not list(tmp_path.iterdir()) and out == "" and err.count("\n") == 1 and "needs torch and gsplat" in err


@pytest.mark.slow
def test_through_the_kernels_all_agrees(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A small one: seven scenes, two fits and the plain one, pictures of two sizes in six ways, a sample of each."""
    options = {"on": "cpu", "gaussians": "400", "iterations": "14", "width": "64", "height": "36", "threads": "1"}
    options |= {"seconds": "0.1", "page": str(tmp_path / "page.txt")}
    assert main(options) == 0
    said = capsys.readouterr().out
    assert (tmp_path / "page.txt").read_text() == said and "4 instants an hour, drawn by one worker: " in said
    lines = said.splitlines()
    rows = [line for line in lines if line.startswith("| ") and "---" not in line]
    assert (
        len(rows) == (1 + 7) + (1 + 3) + (1 + 2 * 6) + (1 + 2) and sum(line.endswith("| well |") for line in rows) == 7
    )
    assert lines[-1].startswith("all agree")
