"""The scene engine's pictures in a drive: like the log's photos where the log drives, others where it does not."""

from dataclasses import replace
from pathlib import Path

import pytest

from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.readers.base import BadClip
from planners.drive.cameras import RenderedCameras, open_rendered_cameras
from planners.drive.starts import extend_clip, logged_start
from tasks.render.scene.asset import psnr
from tasks.render.settings import Frames, RenderSettings, SceneFrom
from tasks.world.clip import NOW, Clip
from tests.planners.drive.test_painted import front, unit
from tests.tasks.streets import street_clip

DISCS = RenderSettings(
    width=96, height=54, frames=Frames.NOW, scene=SceneFrom.DISCS, psnr_min=0.0, jpeg_quality=95
)  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    settings = TownSettings(("ring_front_center",), 96, 54, jpeg_quality=95)
    reader = SyntheticReader(tmp_path_factory.mktemp("town"), 1, settings=settings)
    return extend_clip(reader.read(reader.index().refs[0]), 300)


@pytest.fixture(scope="module")
def cameras(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> RenderedCameras:
    return open_rendered_cameras(clip, DISCS, str(tmp_path_factory.mktemp("cache")))


@pytest.mark.slow
def test_where_the_log_drives_the_engine_shows_what_the_photos_do(clip: Clip, cameras: RenderedCameras) -> None:
    scene = logged_start(clip).scene
    files = {round(file.time_s, 2): Path(file.uri) for file in clip.images}
    assert psnr(unit(front(cameras.images(scene, 0))), unit(files[round(NOW * 0.1, 2)].read_bytes())) > 18.0


@pytest.mark.slow
def test_vehicles_are_where_the_simulation_has_them(clip: Clip, cameras: RenderedCameras) -> None:
    """The lead vehicle 4 m further away: another picture."""
    scene = logged_start(clip).scene
    lead, boxes = scene.agents.track_ids.index("lead"), scene.agents.boxes.copy()
    boxes[:, lead, 0] += 4.0
    moved = replace(scene, agents=replace(scene.agents, boxes=boxes))
    assert psnr(unit(front(cameras.images(moved, 0))), unit(front(cameras.images(scene, 0)))) < 45.0


@pytest.mark.slow
def test_a_scene_that_is_too_poor_is_refused(clip: Clip, tmp_path: Path) -> None:
    strict = replace(DISCS, psnr_min=60.0)
    with pytest.raises(BadClip, match="below 60"):
        open_rendered_cameras(clip, strict, str(tmp_path))


def test_without_sensors_there_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(BadClip, match="no photos and no lidar"):
        open_rendered_cameras(street_clip(), DISCS, str(tmp_path))
