"""A stored sample's block seen again: photos beside renderings of their poses, the side views, the film."""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.config.run import load_config
from factory.setup.settings import assemble
from factory.store.reader import SampleTable, decode_stored_image
from factory.store.samples import Store
from factory.views.pictures import sample_bev
from factory.views.rendered_again import (
    ASIDE_M,
    agents_in_world,
    ego_pose_at,
    load_scene,
    nearest_photo_sample,
    photo_rendering_pairs,
    render_cameras,
    sample_film,
    scene_digest_of,
    side_views,
)
from factory.views.status import REASON_WORDS
from tasks.render.scene.asset import RenderAsset, psnr
from tasks.stages import STAGES
from tests.factory.toy import executed

main = COMMANDS["show"].load()

SIZE = ["render.width=64", "render.height=36", "render.scene=discs", "vocabulary.k=300"]
SIZE += ["render.psnr_min=0", "render.gate.vehicle_min=0", "render.gate.guessed_max=1", "experts=[pdm_closed,human]"]


@pytest.fixture(scope="module")
def store(small_town: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """One clip of the town: a rendered sample and the human one with photos."""
    folder = tmp_path_factory.mktemp("seen")
    run = assemble(load_config(["clips=av2", f"clips.root={small_town}", f"out={folder / 'out'}", *SIZE]))
    store = Store(folder / "out")
    executed(run.work, run.index.refs[:1], run.config.experts, 1, store)
    return store


def rows(store: Store) -> tuple[dict[str, Any], dict[str, Any]]:
    """(rendered, human)."""
    found = {row["expert"]: row for row in SampleTable(store.location.uri)}
    return found["pdm_closed"], found["human"]


def scene(store: Store) -> RenderAsset:
    found = load_scene(store, rows(store)[0]["asset_digest"])
    assert found is not None
    return found


@pytest.mark.slow
def test_a_row_holds_all_that_its_own_images_were_drawn_from(store: Store) -> None:
    rendered, _ = rows(store)
    agents = agents_in_world(rendered)
    for image in rendered["images"]:
        step = 15 + round(10 * image["time_s"])
        pose = ego_pose_at(rendered, step)
        np.testing.assert_allclose(pose, np.reshape(image["ego_pose"], (4, 4)), atol=1e-3)
        (again,) = render_cameras(scene(store), rendered["cameras"], pose, agents, image["time_s"])
        assert psnr(again, decode_stored_image(image)) > 30.0  # JPEG and float32 poses


def test_a_photo_stands_beside_what_the_scene_shows_from_its_pose(store: Store) -> None:
    rendered, human = rows(store)
    photos = nearest_photo_sample(store, rendered, scene(store))
    assert photos is not None and photos["attempt_id"] == human["attempt_id"]
    ((photo, again),) = photo_rendering_pairs(scene(store), photos, rendered["clip_start_s"] + rendered["now_s"])
    assert "photo, -4.0 s from the sample's now" in photo.caption and "dB" in again.caption
    np.testing.assert_array_equal(photo.pixels, decode_stored_image(human["images"][-1]))
    assert psnr(photo.pixels, again.pixels) > 15.0
    other = photo_rendering_pairs(scene(store), photos, human["clip_start_s"] + human["now_s"] - 1.5)[0]
    np.testing.assert_array_equal(other[0].pixels, decode_stored_image(human["images"][0]))


def test_the_view_from_the_side_moves_what_is_near_and_not_the_horizon(store: Store) -> None:
    rendered, human = rows(store)
    strip = side_views(scene(store), rendered)
    sides = ["2 m to the left", "1 m to the left", "", "1 m to the right", "2 m to the right"]
    assert [seen.caption if seen.caption in sides else "" for seen in strip] == sides, "left of the strip is left"
    assert strip[2].caption == "ring_front_center, rendered at now"
    assert len(ASIDE_M) == 5 and len({seen.pixels.tobytes() for seen in strip}) == 5
    now = next(image for image in rendered["images"] if abs(image["time_s"]) < 0.05)
    assert psnr(strip[2].pixels, decode_stored_image(now)) > 30.0
    assert side_views(scene(store), {**human, "images": None}) == []


def test_a_row_of_photos_is_compared_with_the_scene_of_its_clip(store: Store) -> None:
    rendered, human = rows(store)
    assert human["asset_digest"] is None and scene_digest_of(store, human) == rendered["asset_digest"]


def test_a_film_s_frames_have_even_sides_with_the_scene_and_without(store: Store) -> None:
    rendered, human = rows(store)
    for row, asset in ((rendered, scene(store)), (human, None), ({**rendered, "images": [], "cameras": None}, None)):
        assert all(side % 2 == 0 for side in next(sample_film(row, asset)).shape[:2])
    assert (sample_bev(rendered, step=0) != sample_bev(rendered, step=55)).any()


@pytest.mark.slow
def test_show_writes_the_picture_and_the_film(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import av

    human = sorted(store.samples).index(rows(store)[1]["attempt_id"])
    out = f"out={store.location.uri}"
    assert main([out, f"sample={human}", "film=true", f"to={tmp_path / 'x.png'}"]) == 0
    assert str(tmp_path / "x.mp4") in capsys.readouterr().out
    with av.open(str(tmp_path / "x.mp4")) as container:
        (stream,) = container.streams
        assert stream.codec_context.name == "h264" and sum(1 for _ in container.decode(stream)) == 56
    whole = cv2.imread(str(tmp_path / "x.png"))
    cache, aside = Path(store.location.uri) / "cache", tmp_path / "cache"
    shutil.move(cache, aside)
    try:
        assert main([out, f"sample={human}", f"to={tmp_path / 'y.png'}"]) == 0
    finally:
        shutil.move(aside, cache)
    assert "is not in the run's cache" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "y.png")).shape[0] < whole.shape[0]
    assert main([out, "film=true"]) == 2


def test_every_reason_of_every_stage_has_its_words() -> None:
    assert {reason for stage in STAGES for reason in stage.reasons} <= set(REASON_WORDS)
