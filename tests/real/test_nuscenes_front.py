"""One drive of nuScenes with its front camera as a video beside it: from the sidecar to colour pictures at new poses.

No picture of it enters the repository (CC BY-NC-SA 4.0).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.config.run import load_config
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.exits import COMPLETE
from factory.graph.execute import Execution, execute
from factory.readers.pictures import file_and_frame
from factory.setup.settings import assemble
from factory.stages.assets import Sensing, block_sensing
from factory.stages.imaging import PHOTO_SLACK_S, nearest_photo
from factory.stages.sensors import block_of, load_photos
from factory.store.reader import SampleTable, image_of
from factory.store.samples import Store
from tasks.render.scene.asset import psnr
from tasks.render.scene.features import triangulate_matches
from tasks.render.scene.sensed import Tracks
from tasks.render.settings import STEPS_OF, Frames, RenderSettings
from tasks.world.clip import NOW, STEP_S, Clip

LOG, SIZE = "sd_nuscenes_v1.0-mini_scene-0103", (200, 112)


@pytest.fixture(scope="module")
def folder(shared_root: Path) -> Path:
    return shared_root / "data" / "nuscenes_front"


@pytest.fixture(scope="module")
def clips(folder: Path) -> list[Clip]:
    reader = ScenarioNetReader(folder / f"{LOG}.pkl", cameras=folder)
    index = reader.index()
    assert not index.broken and [ref.start_ms for ref in index.refs] == list(range(500, 10_000, 1000))
    assert {reader.block(ref) for ref in index.refs} == {f"{LOG}@0s"}
    return [reader.read(ref) for ref in index.refs]


def test_every_clip_has_a_photo_of_every_instant_and_all_forty_make_its_block(clips: list[Clip]) -> None:
    for clip in clips:
        assert block_sensing(clip, RenderSettings()) is Sensing.PHOTOS_ONLY
        assert [file_and_frame(image.uri)[1] for image in block_of(clip).images] == list(range(40))
        for offset in STEPS_OF[Frames.ALL]:
            time_s = (NOW + offset) * STEP_S
            assert abs(nearest_photo(clip, "CAM_FRONT", time_s).time_s - time_s) < PHOTO_SLACK_S


@pytest.mark.slow
def test_frames_of_the_video_belong_to_the_poses_of_the_sidecar(clips: list[Clip]) -> None:
    """Corners matched between photos meet ahead of both cameras, and do not where the film runs backwards."""
    block = block_of(clips[0])
    photos = load_photos(block.images[:10], clips[0].cameras, 400, 225)
    back = [replace(one, world_from_camera=other.world_from_camera) for one, other in zip(photos, photos[::-1])]
    tracks = Tracks(block.agents, np.zeros(3))
    right, wrong = (len(triangulate_matches(some, tracks)) for some in (photos, back))
    assert right > 200 and right > 4 * wrong, (right, wrong)


@pytest.mark.slow
def test_a_run_ends_with_photos_and_with_colour_pictures_where_nobody_drove(folder: Path, tmp_path: Path) -> None:
    settings = [
        "clips=scenarionet", f"clips.root={folder / f'{LOG}.pkl'}", f"clips.cameras={folder}", "clips.split=train",
        f"vocabulary.file={folder.parent / 'vocabulary/human_8192x40x3.npy'}", "experts=[pdm_closed,human]", "limit=1",
        "reward.labels=none", f"render.width={SIZE[0]}", f"render.height={SIZE[1]}", "render.scene=discs",
        "render.rig.adjust=off", "render.psnr_min=0", "render.gate.enabled=false", f"out={tmp_path}",
    ]  # fmt: skip
    run = assemble(load_config(settings))
    store = Store(tmp_path)
    summary = execute(
        run.work, run.index.refs[:1], run.config.experts, 1, store, Execution("local", 1), say=lambda line: None
    )
    assert summary.exit_code == COMPLETE
    table = SampleTable(str(tmp_path))
    rows = {row["expert"]: row for row in (table[i] for i in range(len(table)))}
    human, simulated = rows["human"], rows["pdm_closed"]
    assert (human["image_source"], simulated["image_source"]) == ("photo", "render")
    assert "photos_only" in simulated["tags"] and simulated["psnr"] > 19.0  # 20.4
    assert simulated["licence"] == "CC BY-NC-SA 4.0 (nuScenes via ScenarioNet)"
    clip = run.reader.read(run.index.refs[0])
    (photo,) = load_photos([nearest_photo(clip, "CAM_FRONT", NOW * STEP_S)], clip.cameras, *SIZE)
    assert psnr(image_of(human, "CAM_FRONT", human["images"][3]["time_s"]) / 255.0, photo.rgb / 255.0) > 30.0
    picture = image_of(simulated, "CAM_FRONT", 0.0).astype(float)
    assert (picture.max(axis=-1) - picture.min(axis=-1)).mean() > 5.0  # bricks and leaves, not lidar's grey
    moved = np.hypot(*(np.asarray(simulated["now_pose"])[:2] - clip.ego_states[:, :2]).T).min()
    assert moved > 0.05 or abs(simulated["candidate_end"][2]) > 0.02  # from where, or how, nobody drove
