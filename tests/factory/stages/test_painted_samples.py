"""Samples as the town's painter shows them, each where its drive has come to.

That the painter shows the log's photos where the log drives, tests/planners/drive/test_painted.py says.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import load_config, typed_run_config
from factory.graph.steps import PreparedClip, SampleColumns, run_attempt
from factory.pipeline import FactoryWork
from factory.setup.settings import assemble
from tasks.render.scene.asset import psnr

CAMERA = "ring_front_center"
WORDS = ["clips=synthetic_towns", "clips.seeds=[3]", "clips.logs_per_town=1", "render.jpeg_quality=95"]
WORDS += ["render.width=64", "render.height=36", "render.frames=now", "reward.labels=none", "executor=local"]
WORDS += [f"render.cameras=[{CAMERA}]", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0"]
PAINTED = ["render=none", "render.mode=painter"]


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("towns")


def prepared_by(towns: Path, *words: str) -> tuple[FactoryWork, PreparedClip]:
    asked = [*WORDS, f"clips.cache_dir={towns}", f"out={towns / 'out'}", *words]
    work = assemble(load_config(asked)).work
    prepared = work.prepare(work.reader.index().refs[0])
    assert isinstance(prepared, PreparedClip)
    return work, prepared


def row_of(work: FactoryWork, prepared: PreparedClip, candidate: int, expert: str) -> dict[str, object]:
    found = run_attempt(work, prepared, candidate, expert)
    assert isinstance(found, SampleColumns)
    return dict(found.row)


def now(row: dict[str, object]) -> np.ndarray:
    """(H, W, 3) in [0, 1] of the only picture."""
    images: list[dict[str, bytes]] = row["images"]  # type: ignore[assignment]
    assert len(images) == 1
    decoded = cv2.imdecode(np.frombuffer(images[0]["jpeg"], np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded.astype(np.float32) / np.float32(255.0)


@pytest.mark.slow
def test_a_perturbed_drive_is_painted_where_it_has_come_to_and_the_log_alone_where_the_log_was(towns: Path) -> None:
    free = ["experts=[logged]", "reward.full=[]", "reward.progress_above=-1", "reward.off_route=false"]
    free += ["reward.after=false", "reward.near_log=false", "vocabulary.k=4096"]
    moved = row_of(*prepared_by(towns, *PAINTED, *free), 0, "logged")
    logged = row_of(*prepared_by(towns, *PAINTED, *free, "perturb.at_log=true", "traffic=replay"), 0, "logged")
    assert moved["image_source"] == logged["image_source"] == "painter"
    assert psnr(now(moved), now(logged)) < 30.0
    np.testing.assert_allclose(np.asarray(logged["candidate_end"])[:3], 0.0)
    assert np.abs(np.asarray(moved["candidate_end"])[:3]).max() > 0.1
    end = np.asarray(logged["parent_states"])[1]
    np.testing.assert_allclose(np.asarray(logged["now_pose"]), end[:3])


def test_clips_of_no_town_have_no_painter() -> None:
    config = load_config([*WORDS, "render.mode=painter", "out=nowhere"])
    values = {**vars(config), "clips": {"_target_": "my.Reader"}, "render": replace(config.render)}
    with pytest.raises(ConfigError, match="only the synthetic town has a painter"):
        typed_run_config(values)


def test_a_camera_that_the_usual_rig_lacks_is_refused_at_once() -> None:
    with pytest.raises(ConfigError, match="no camera rear"):
        load_config([*WORDS, "clips.settings.cameras=[]", "render.mode=painter", "render.cameras=[rear]"])
