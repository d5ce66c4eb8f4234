"""The painter's pictures in a drive: those of the log where the log drives, others where it does not."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from examples.csv_logs import write_log
from factory.datasets.town.reader import SyntheticReader, TownPainter, parse_town_log_id
from factory.datasets.town.settings import TownSettings
from factory.exits import BAD_CONFIG, COMPLETE
from planners.drive.cameras import NoCameras, Observer, PaintedCameras
from planners.drive.drive import main
from planners.drive.starts import extend_clip, logged_start
from tasks.render.scene.asset import psnr
from tasks.render.settings import Frames, RenderSettings
from tasks.world.clip import CLIP_STEPS, NOW, Clip, Scene
from tests.planners.drive.test_drive import rows, words
from tests.planners.drive.test_drive import towns as towns  # the fixture
from tests.tasks.streets import street_clip

SMALL = RenderSettings(width=64, height=36, frames=Frames.NOW, cameras=("ring_front_center",), jpeg_quality=95)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A clip whose log has the front camera's photos up to T."""
    settings = TownSettings(
        ("ring_front_center",), 64, 36, jpeg_quality=95, photo_steps=16, steps_per_photo=5, lidar_beams=0
    )
    reader = SyntheticReader(tmp_path_factory.mktemp("town"), 1, settings=settings)
    clip = reader.read(reader.index().refs[0])
    return extend_clip(clip, 300, TownPainter().lights(clip, 300))


def unit(jpeg: bytes) -> np.ndarray:
    """(H, W, 3) in [0, 1]."""
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded.astype(np.float32) / np.float32(255.0)


def front(images: Any) -> bytes:
    """The only camera's picture."""
    (image,) = images
    return bytes(image["jpeg"])


@pytest.mark.slow
def test_where_the_log_drives_the_painter_shows_the_log_s_photos(photographed: Clip) -> None:
    """At T and 1.5 s before; who is beyond 100 m of the log's ego is not annotated and not painted."""
    scene, cameras = logged_start(photographed).scene, PaintedCameras(photographed, SMALL, TownPainter())
    files = {round(file.time_s, 2): Path(file.uri) for file in photographed.images}
    for offset in (0, -15):
        painted = unit(front(cameras.images(scene, offset)))
        assert psnr(painted, unit(files[round((NOW + offset) * 0.1, 2)].read_bytes())) > 35.0


@pytest.mark.slow
def test_it_paints_what_the_simulation_has(photographed: Clip) -> None:
    """From a metre further to the left, and without anybody, other pictures."""
    scene, cameras = logged_start(photographed).scene, PaintedCameras(photographed, SMALL, TownPainter())
    here = unit(front(cameras.images(scene, 0)))
    beside = scene.ego_history.copy()
    heading = beside[-1, 2]
    beside[-1, :2] += -np.sin(heading), np.cos(heading)
    alone = replace(scene, agents=replace(scene.agents, valid=np.zeros_like(scene.agents.valid)))
    for other in (replace(scene, ego_history=beside), alone):
        assert psnr(unit(front(cameras.images(other, 0))), here) < 35.0


@pytest.mark.slow
def test_the_lights_are_the_log_s_and_go_on(photographed: Clip) -> None:
    states = photographed.lights.states
    assert len(states) == 300
    assert set(np.unique(states[CLIP_STEPS:])) <= {1, 2, 3}


def test_only_the_town_has_a_painter() -> None:
    assert parse_town_log_id("town-7-0000-straight-multi-lane") == (7, 0)
    for other in ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "town-0-0000-another-name"):
        with pytest.raises(ValueError, match="not of the synthetic town"):
            parse_town_log_id(other)


class Counting(NoCameras):
    """DriveCameras that note when they look."""

    def images(self, scene: Scene, offset: int) -> list[Mapping[str, Any]]:
        return [{"camera": "a", "time_s": offset * 0.1, "seen": scene.step + offset}]


def test_what_was_seen_is_what_a_sample_s_earlier_pictures_are() -> None:
    """Two looks half a second apart: the first looks back, the second remembers."""
    clip = extend_clip(street_clip(), 200)
    scene, observer = logged_start(clip).scene, Observer(Counting(offsets=(-15, -10, -5, 0)))
    shown = []
    for step in (NOW, NOW + 5):
        images = observer.observe(replace(scene, step=step))[1]()["images"]
        shown.append([(image["seen"], round(image["time_s"], 6)) for image in images])
    assert shown[0] == [(0, -1.5), (5, -1.0), (10, -0.5), (15, 0.0)]
    assert shown[1] == [(5, -1.5), (10, -1.0), (15, -0.5), (20, 0.0)]


LOOKING = ["planner=tests.planners.drive.looking:Bright", "render.width=64", "render.height=36"]


@pytest.mark.slow
def test_a_planner_that_looks_drives_by_the_painter_s_pictures(towns: Path, tmp_path: Path) -> None:
    assert main([*words(towns, tmp_path, "limit=1", *LOOKING), "seconds=1.5"]) == COMPLETE
    (row,) = rows(tmp_path)
    assert (row["pictures"], row["planner"]) == ("truth", "tests.planners.drive.looking.Bright")
    assert len(row["plans"]) == 2  # type: ignore[arg-type]


def test_other_logs_have_no_painter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Said before anything is driven."""
    write_log(tmp_path / "log")
    clips = ["clips=custom", "clips._target_=examples.csv_logs.CsvReader", f"+clips.root={tmp_path}"]
    assert main([*clips, *LOOKING, f"out={tmp_path / 'out'}", "bounds=false"]) == BAD_CONFIG
    assert "pictures=engine" in capsys.readouterr().err
