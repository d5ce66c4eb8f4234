"""Three processes: `factory scene serve` draws, `planners drive` runs the rollout, `planners serve` drives."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("carla_driver_interface", reason='the contract needs pip install ".[planners]"')

from factory.alpasim.scenes import scenes_of_run
from factory.alpasim.sensors import Sensors
from factory.datasets.av2.reader import AV2Reader
from factory.exits import BAD_CONFIG, COMPLETE
from factory.store.samples import Store
from planners.drive.cameras import RenderedCameras
from planners.drive.drive import main
from planners.drive.renderer import ServedCameras
from planners.drive.starts import extend_clip, logged_start
from tasks.render.scene.asset import psnr
from tasks.render.settings import Frames, RenderSettings
from tests.factory.alpasim.test_scene_service import run as run  # the fixture
from tests.factory.conftest import small_town as small_town  # the fixture
from tests.planners.drive.test_drive import rows
from tests.planners.drive.test_painted import front, unit
from tests.planners.navsim.trained import made, saved


@contextmanager
def served(*words: str) -> Iterator[str]:
    """The address of a command that serves."""
    command, alone = [sys.executable, "-m", *words, "port=0"], os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=alone) as process:
        assert process.stdout is not None
        try:
            yield next(line for line in process.stdout if line.startswith("answers at ")).split()[-1]
        finally:
            process.send_signal(signal.SIGTERM)


def words(small_town: Path, out: Path, *more: str) -> list[str]:
    """One clip of the run that is served, on small pictures."""
    clips = ["clips=av2", f"clips.root={small_town}", "limit=1", "seconds=2.1", "render.width=64", "render.height=36"]
    return [*clips, "bounds=false", "pictures=[renderer]", f"out={out}", *more]


@pytest.mark.slow
def test_three_processes_drive_as_one_to_the_bit(run: Store, small_town: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)  # in all three: a plan's rounding depends on it
    spec = saved(made("ltf_small", command="curvature"), tmp_path / "ltf")
    with (
        served("factory", "scene", "serve", run.location.uri) as renderer,
        served("planners", "serve", "protocol=alpasim", f"planner={spec}") as driver,
    ):
        asked = words(small_town, tmp_path / "three", f"driver={driver}", f"renderer={renderer}")
        assert main(asked) == COMPLETE
        here = f"planner={spec}", f"renderer={run.location.uri}"
        assert main(words(small_town, tmp_path / "one", *here)) == COMPLETE
    (three,), (one,) = rows(tmp_path / "three"), rows(tmp_path / "one")
    assert three["pictures"] == "renderer" and len(three["plans"]) == 4  # type: ignore[arg-type]
    apart = {"drive_id", "planner", "planner_digest"}
    assert {k: str(v) for k, v in three.items() if k not in apart} == {
        k: str(v) for k, v in one.items() if k not in apart
    }


def test_its_pictures_are_those_of_the_engine(run: Store, small_town: Path) -> None:
    """At the log's pose, JPEG and poses in 32 bits lie between the two; a metre to the left it sees another."""
    settings = RenderSettings(width=64, height=36, frames=Frames.NOW, jpeg_quality=95)
    reader = AV2Reader(small_town)
    clip = extend_clip(reader.read(reader.index().refs[0]), 300)
    served = scenes_of_run(run).find("scene_id", clip.clip_id)
    there = ServedCameras(clip, settings, Sensors(scenes_of_run(run)).service.answer)
    here = RenderedCameras(clip, settings, served.asset, served.cameras)
    scene = logged_start(clip).scene
    history = scene.ego_history.copy()
    history[-1, :2] += -np.sin(history[-1, 2]), np.cos(history[-1, 2])
    ours, theirs, aside = (
        unit(front(seen.images(where, 0)))
        for seen, where in ((here, scene), (there, scene), (there, replace(scene, ego_history=history)))
    )
    assert psnr(ours, theirs) > 33.0 > psnr(ours, aside)


def test_a_renderer_that_is_not_there_is_told_and_one_without_its_pictures_refused(
    small_town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("planners.drive.contract.STARTUP_S", 0.2)
    looks = "planner=tests.planners.drive.looking:Bright"
    assert main(words(small_town, tmp_path, looks, "renderer=127.0.0.1:9")) == BAD_CONFIG
    assert "renderer=127.0.0.1:9: get_version: " in capsys.readouterr().err
    assert main(words(small_town, tmp_path, looks)) == BAD_CONFIG
    assert "renderer=host:port, or a run, goes with pictures=[renderer]" in capsys.readouterr().err
