"""Which pictures a sample gets: a human's photos all there or an error, a simulated drive's from what was sensed."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.config.run import load_config
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.graph.steps import HUMAN_CANDIDATE, PreparedClip, SampleColumns, run_attempt
from factory.pipeline import FactoryWork
from factory.readers.base import BadClip
from factory.setup.settings import assemble
from factory.stages.imaging import nearest_photo, scene_in_clip_time
from factory.stages.sensors import block_of
from tasks.render.scene.asset import Exposure, RenderAsset
from tasks.render.scene.sky import SkyMap
from tasks.render.splatting.gaussians import EMPTY
from tasks.stages import HUMAN
from tasks.world.clip import Clip

CAMERAS = ("ring_front_left", "ring_front_center")
SMALL = TownSettings(cameras=CAMERAS, width=64, height=36, lidar_beams=0)
SIZE = ["render.width=64", "render.height=36", "render.scene=discs", "vocabulary.k=300"]
SIZE += ["render.psnr_min=0", "render.gate.vehicle_min=0", "render.gate.guessed_max=1", "experts=[pdm_closed,human]"]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One clip's log with photos of two cameras, 6.7 m of driving apart, and no lidar."""
    reader = SyntheticReader(tmp_path_factory.mktemp("town"), 1, 0, SMALL)
    reader.index()
    return reader.root


def prepared_by(root: Path, out: Path, *overrides: str) -> tuple[FactoryWork, PreparedClip]:
    work = assemble(load_config(["clips=av2", f"clips.root={root}", f"out={out}", *SIZE, *overrides])).work
    prepared = work.prepare(work.reader.index().refs[0])
    assert isinstance(prepared, PreparedClip)
    return work, prepared


def clip_of(root: Path, out: Path) -> Clip:
    work, _ = prepared_by(root, out)
    return work.reader.read(work.reader.index().refs[0])


def human_row(root: Path, out: Path, *overrides: str) -> dict[str, object]:
    work, prepared = prepared_by(root, out, *overrides)
    human = run_attempt(work, prepared, HUMAN_CANDIDATE, HUMAN)
    assert isinstance(human, SampleColumns)
    return dict(human.row)


@pytest.mark.slow
def test_a_human_sample_has_a_photo_of_every_camera_at_every_instant_also_without_lidar(
    town: Path, tmp_path: Path
) -> None:
    row = human_row(town, tmp_path)
    assert row["image_source"] == "photo"
    taken = [(image["camera"], round(image["time_s"], 3)) for image in row["images"]]  # type: ignore[attr-defined]
    assert sorted(taken) == sorted((camera, at) for camera in CAMERAS for at in (-1.5, -1.0, -0.5, 0.0))


def test_photos_too_far_apart_for_parallax_give_a_simulated_drive_no_pictures(town: Path, tmp_path: Path) -> None:
    work, prepared = prepared_by(town, tmp_path)
    results = (run_attempt(work, prepared, row.index, "pdm_closed") for row in prepared.candidates)
    sample = next(result for result in results if isinstance(result, SampleColumns))
    assert sample.row["image_source"] == "none" and sample.row["images"] is None


@pytest.mark.slow
def test_a_missing_photo_is_a_bad_clip_that_names_camera_and_time(town: Path, tmp_path: Path) -> None:
    root = tmp_path / "logs"
    shutil.copytree(town, root)
    clip = clip_of(root, tmp_path)
    Path(nearest_photo(clip, "ring_front_left", 1.0).uri).unlink()
    message = (
        rf"camera ring_front_left: no photo within 0\.06 s of {clip.start_s + 1:.2f} s .* restore the missing file"
    )
    with pytest.raises(BadClip, match=message):
        human_row(root, tmp_path)
    assert human_row(root, tmp_path, "render.cameras=[ring_front_center]")["image_source"] == "photo"


def test_of_many_photos_the_nearest_is_taken(town: Path, tmp_path: Path) -> None:
    clip = clip_of(town, tmp_path)
    first = clip.images[0]
    often = replace(clip, images=tuple(replace(first, time_s=0.05 * k + 0.02) for k in range(100)))
    assert nearest_photo(often, first.sensor, 1.0).time_s == pytest.approx(1.02)


def test_a_clip_is_drawn_with_what_its_cameras_made_of_the_light_in_its_own_time(town: Path, tmp_path: Path) -> None:
    """The scene counts from the block's first step, two seconds before the clip's."""
    clip = clip_of(town, tmp_path)
    block = replace(block_of(clip), start_s=clip.start_s - 2.0)
    gains = tuple(
        Exposure("front", time_s, np.float32(gain * np.eye(3, 4))) for time_s, gain in ((2.0, 1.5), (3.0, 0.5))
    )
    asset = RenderAsset(np.zeros(3), EMPTY, {}, SkyMap(np.zeros((2, 4, 3), np.float32)), 30.0, exposures=gains)
    scene = scene_in_clip_time(replace(clip, block=block), asset)
    assert [float(scene.affine_of("front", time_s)[0, 0]) for time_s in (0.0, 0.5, 1.0)] == [1.5, 1.0, 0.5]
