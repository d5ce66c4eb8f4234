"""Trainings by torch.compile: the curve of those without, and checkpoints that do not tell."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from planners.training.checkpoint import load_planner, read_record
from planners.training.curves import LOSSES
from planners.training.train import main
from tests.planners.training.test_train import command, table

__all__ = ["table"]
COMPILER = os.environ.get("CXX", "g++")
compiles = pytest.mark.skipif(shutil.which(COMPILER) is None, reason=f"torch.compile needs {COMPILER}")


def curve(out: Path) -> np.ndarray:
    return np.loadtxt(out / LOSSES, delimiter=",", skiprows=1)


@compiles
@pytest.mark.slow
def test_compiled_and_eager_trainings_have_one_curve_and_each_goes_on_as_the_other(table: str, tmp_path: Path) -> None:
    """With dropout: it is drawn as without compilation."""
    for name, first, then in (
        ("eager", "false", "false"),
        ("begun compiled", "true", "false"),
        ("ended compiled", "false", "true"),
    ):
        out = tmp_path / name
        assert main(command(table, out, "steps=6", f"compile={first}")) == 0
        assert main(command(table, out, "steps=12", f"compile={then}", "resume=further")) == 0
        np.testing.assert_allclose(curve(out), curve(tmp_path / "eager"), rtol=1e-5)
        ours, theirs = load_planner(out).state_dict(), load_planner(tmp_path / "eager").state_dict()
        assert list(ours) == list(theirs)
        for key, weights in theirs.items():
            np.testing.assert_allclose(ours[key], weights, rtol=0.0, atol=1e-5)
    assert read_record(tmp_path / "begun compiled")["earlier"] == [{"until_step": 6, "compile": True, "steps": 6}]


def test_without_a_compiler_it_is_refused_at_once(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert main(command(table, tmp_path / "out", "compile=true")) == 2
    assert "there is no no-such-compiler: install a C++ compiler" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
