"""`python -m planners import`: from a Lightning checkpoint to a folder that everything else takes."""

import errno
import io
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import torch

from planners.evaluation.planner_names import find_planner as evaluated_planner
from planners.published.import_planner import main
from planners.training.checkpoint import read_record
from tests.planners.published.formula import inputs
from tests.planners.published.ours import batch_of, formula_weights
from tests.planners.published.test_parity import TOLERANCE, recorded


class FullDisk(io.StringIO):
    """Standard output into a file on one."""

    def flush(self) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.slow
def test_a_checkpoint_becomes_a_folder_that_plans_as_the_public_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, path, out = recorded("ltf"), tmp_path / "epoch=99-step=123.ckpt", tmp_path / "out"
    weights = formula_weights(one.names, inputs(*one.picture))
    named = {f"agent._transfuser_model.{name}": value for name, value in weights.items()}
    torch.save({"state_dict": named, "global_step": 123}, path)
    size = ["planner.settings.image.width=256", "planner.settings.image.height=64"]
    with redirect_stdout(FullDisk()):
        assert main([str(path), "planner=ltf_public", f"out={out}", *size]) == 2 and not out.exists()
    assert "space" in capsys.readouterr().err
    (out / "checkpoints" / ".00000000.1").mkdir(parents=True)  # as a full disk leaves it
    assert main([str(path), "planner=ltf_public", f"out={out}", *size]) == 0
    said = capsys.readouterr().out
    assert f"in {len(one.names)} arrays are the planner's weights" in said
    record = read_record(out)
    assert record["parameters"] == one.parameters and record["trained"]["imported"].startswith(f"{path.name} ")
    planner = evaluated_planner(str(out))
    assert planner.load is not None
    plan = planner.load().plan(batch_of(inputs(*one.picture)))
    assert np.abs(plan.numpy() - one.results["eval trajectory"]).max() < TOLERANCE
    assert main([str(path), "planner=ltf_public", f"out={out}", *size]) == 2
    assert "holds a training already" in capsys.readouterr().err


def test_what_does_not_fit_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"agent._transfuser_model._status_encoding.weight": torch.ones(1)}}, path)
    (tmp_path / "b.ckpt").write_bytes(b"")
    for words, said in (
        ([str(path), f"out={tmp_path / 'out'}", "planner=ltf_publik"], "ltf_public"),
        ([str(path), f"out={tmp_path / 'out'}", "planner.settings.variant=publik"], "publik"),
        ([str(path), f"out={tmp_path / 'out'}"], "lacks _backbone.image_encoder"),
        ([str(path), str(tmp_path / "b.ckpt"), f"out={tmp_path / 'out'}"], "one checkpoint at a time"),
        ([f"checkpoint={tmp_path / 'c.ckpt'}", f"out={tmp_path / 'out'}"], "there is no such file"),
        ([str(tmp_path / "c.ckpt"), f"out={tmp_path / 'out'}"], "there is no such file"),
        ([str(path)], "out"),
    ):
        assert main(words) == 2, words
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1, error
    assert not (tmp_path / "out").exists()
