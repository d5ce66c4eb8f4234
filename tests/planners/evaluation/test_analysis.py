"""Real against simulated frames, from rows made by hand."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from planners.evaluation.analysis import analyse, main
from planners.evaluation.score_rows import FrameRow, write_rows
from tests.planners.made_rows import clip_rows


def rows() -> list[FrameRow]:
    """Real at T 0.95 and 0.45, simulated at T+H 0.05, 0.15 and 1.0; every other row is another number."""
    here = ((0.0, 0.0), (0.0, 0.0))
    a = clip_rows("a", 0.3, (0.95, 0.3), here, [((0.05, 0.3), *here), ((0.15, 0.3), *here)])
    b = clip_rows("b", 0.3, (0.45, 0.3), here, [((1.0, 0.3), *here)])
    tags = {0.95: ("following",), 0.05: ("following", "stopping"), 1.0: ("following",), 0.45: ("red_light",)}
    return [replace(row, tags=tags.get(float(row.scores.unfiltered[-1]), ())) for row in (*a, *b)]


def test_frames_are_counted_by_tenths_of_their_score() -> None:
    analysis = analyse(rows())
    real, simulated = analysis.shares
    np.testing.assert_allclose(real, [0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5])
    np.testing.assert_allclose(simulated, [1 / 3, 1 / 3, 0, 0, 0, 0, 0, 0, 0, 1 / 3])
    assert analysis.real.mean() == pytest.approx(0.7) and analysis.simulated.mean() == pytest.approx(0.4)


def test_tags_are_ranked_by_their_simulated_mean() -> None:
    tags = analyse(rows()).tags
    assert [tag.tag for tag in tags] == ["stopping", "following", "red_light"]
    stopping, following, red = tags
    assert (stopping.n_real, stopping.n_simulated, stopping.simulated) == (0, 1, 0.05)
    assert (following.n_real, following.real, following.n_simulated) == (1, 0.95, 2)
    assert following.simulated == pytest.approx(0.525)
    assert (red.n_real, red.n_simulated) == (1, 0) and np.isnan(red.simulated) and np.isnan(stopping.real)


def test_the_command_writes_tables_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_rows(tmp_path, rows())
    assert main([f"run={tmp_path}", f"out={tmp_path / 'out'}"]) == 0
    assert "0.7000 on real, 0.4000 on simulated" in capsys.readouterr().out
    shares = list(csv.DictReader((tmp_path / "out" / "distribution.csv").open()))
    assert len(shares) == 10 and float(shares[9]["real_share"]) == 0.5
    assert next(csv.DictReader((tmp_path / "out" / "tags.csv").open()))["real_epdms"] == ""
    assert cv2.imread(str(tmp_path / "out" / "analysis.png")) is not None


def test_what_cannot_be_analysed_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="follow-up"):
        analyse([row for row in rows() if row.stage != "stage_two"])
    for argv, message in (([f"run={tmp_path}"], "frames.parquet"), (["rnu=x"], "rnu"), (["x"], "expected one of")):
        assert main(argv) == 2
        assert message in capsys.readouterr().err
