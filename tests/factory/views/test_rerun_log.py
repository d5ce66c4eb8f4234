"""Rerun recordings, read back with its SDK: the entities of a sample, and where things are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.views import rerun_log
from factory.views.rerun_log import RerunMissing, score_steps, write_recording
from tests.planners.samples import FRONT_YAWS, jpeg, pictures, plain, sample, write_table

main = COMMANDS["export"].load()


def row() -> dict[str, Any]:
    views = {name: jpeg(plain((40 * i, 90, 200))) for i, name in enumerate(FRONT_YAWS)}
    times = {"clip_start_s": 2.0, "now_s": 5.5, "world_from_ego": None, "stage_versions": "{}"}
    found = sample(3, "recovery", **pictures(views), **times)
    ids = [f"agent{i}" for i in range(len(found["agent_ids"]))]
    return found | {"agent_ids": ids, "agent_boxes": np.nan_to_num(found["agent_boxes"])}


def test_a_sub_score_is_one_until_it_fails() -> None:
    blank = {name: None for name in row() if name.startswith("stage2_")}
    steps = score_steps(row() | blank | {"stage2_nc": 0.0, "stage2_nc_fails_s": 1.2, "stage2_ep": 0.7})
    assert steps == [("nc", 0.0, 1.0), ("ep", 0.0, 0.7), ("nc", 1.2, 0.0)]


def test_without_the_sdk_the_command_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> None:
        raise RerunMissing(rerun_log.INSTALL)

    monkeypatch.setattr(rerun_log, "load_rerun", missing)
    write_table(tmp_path / "out", [sample(0, stage_versions="{}")])
    assert main(["rerun", f"out={tmp_path / 'out'}", "sample=0", f"to={tmp_path}"]) == 2
    assert "pip install" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.rrd"))


def test_a_recording_holds_what_the_sample_holds(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is an optional extra and not installed here")
    reader = pytest.importorskip("rerun.chunk", reason="reading a recording back needs rerun-sdk 0.41 or later")
    shown = row()
    path = tmp_path / "sample.rrd"
    write_recording(path, shown)
    entities: dict[str, set[str]] = {}
    for chunk in reader.RrdReader(str(path)).stream():
        columns = chunk.to_record_batch().schema.names
        entities.setdefault(str(chunk.entity_path), set()).update(columns)
    for name in FRONT_YAWS:
        held = " ".join(entities[f"/now/ego/{name}"])
        assert "EncodedImage" in held and "Pinhole" in held and "Transform3D" in held
    assert any("Boxes3D" in column for column in entities["/now/agents"])
    for drive in ("logged", "perturbed", "expert"):
        assert any("LineStrips3D" in column for column in entities[f"/now/trajectories/{drive}"])
    assert "/sample" in entities and "/scores/nc" in entities
