"""Sensor files opened, broken ones named, and scenes stored."""

import re
import sys
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from factory.graph.steps import StopCheck, TaskStopped
from factory.readers.base import BadClip
from factory.stages import assets
from factory.stages.assets import Sensing, block_id, block_sensing, load_or_build_scene
from factory.stages.scene_file import read_dtype
from factory.stages.sensors import block_of, choose_cameras, decode_image, load_sensors
from tasks.render.fit import reconstruct
from tasks.render.scene.build import AssetSettings, psnr
from tasks.render.scene.engine import encode_jpeg
from tasks.render.settings import Backend, FitSettings, RenderSettings, SceneDtype, SceneFrom
from tasks.render.splatting.gsplat_backend import BackendMissing
from tasks.world.clip import CLIP_STEPS, AgentTracks, Camera, Clip, SensorFile
from tasks.world.frames import EGO_STATE_SIZE
from tasks.world.road_map import RoadMap, Route

SETTINGS = RenderSettings(width=48, height=32, scene=SceneFrom.DISCS, asset=AssetSettings(hold_out_every=0))
FRONT = np.array([[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])


def smooth_image(seed: int) -> np.ndarray:
    small = np.random.default_rng(seed).uniform(60, 200, (4, 6, 3)).astype(np.float32)
    return cv2.resize(small, (96, 64), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


@pytest.fixture
def clip(tmp_path: Path) -> Clip:
    """Three photos of one camera and two sweeps of flat ground."""
    images, sweeps = [], []
    x, y = np.meshgrid(np.linspace(2.0, 30.0, 60), np.linspace(-8.0, 8.0, 60))
    for k in range(3):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * k
        image = tmp_path / f"{k}.jpg"
        image.write_bytes(encode_jpeg(smooth_image(1), 95))
        images.append(SensorFile("front", str(image), 0.5 * k, pose))
        points = tmp_path / f"{k}.feather"
        table = {"x": x.ravel(), "y": y.ravel(), "z": 0 * x.ravel()}
        pyarrow.feather.write_feather(pa.table({n: v.astype(np.float32) for n, v in table.items()}), str(points))
        sweeps.append(SensorFile("lidar", str(points), 0.5 * k, pose))
    intrinsics = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
    agents = AgentTracks(
        (), (), np.zeros((CLIP_STEPS, 0, 5)), np.zeros((CLIP_STEPS, 0, 2)), np.zeros((CLIP_STEPS, 0), bool),
        np.zeros((CLIP_STEPS, 0)), np.zeros(0),
    )  # fmt: skip
    return Clip(
        clip_id="c",
        dataset="test",
        log_id="log",
        split="train",
        start_s=0.0,
        ego_states=np.zeros((CLIP_STEPS, EGO_STATE_SIZE)),
        world_from_ego=np.tile(np.eye(4), (CLIP_STEPS, 1, 1)),
        agents=agents,
        road_map=RoadMap({}, ()),
        route=Route((), (), frozenset()),
        centerline=np.zeros((2, 3)),
        cameras=(Camera("front", 96, 64, intrinsics, np.zeros(5), FRONT),),
        images=tuple(images),
        sweeps=tuple(sweeps),
    )


def test_photos_come_at_the_size_asked_for_with_intrinsics_and_pose_to_match(clip: Clip) -> None:
    data = load_sensors(block_of(clip), clip.cameras, 48, 32)
    assert [photo.rgb.shape for photo in data.photos] == [(32, 48, 3)] * 3
    assert [photo.time_s for photo in data.photos] == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(data.photos[0].intrinsics, [[30, 0, 24], [0, 30, 16], [0, 0, 1]])
    np.testing.assert_allclose(data.photos[2].world_from_camera[:3, 3], [5.0, 0.0, 1.5])
    assert psnr(data.photos[0].rgb, cv2.resize(smooth_image(1), (48, 32), interpolation=cv2.INTER_AREA)) > 35.0
    assert len(data.sweeps) == 3 and data.sweeps[1].points.shape == (3600, 3)


def test_a_photo_of_another_shape_is_cut_in_the_middle_and_pixels_stay_square(clip: Clip) -> None:
    photo = load_sensors(block_of(clip), clip.cameras, 24, 32).photos[0]
    np.testing.assert_allclose(photo.intrinsics, [[30, 0, 12], [0, 30, 16], [0, 0, 1]])
    whole = cv2.resize(smooth_image(1), (48, 32), interpolation=cv2.INTER_AREA)
    assert psnr(photo.rgb, whole[:, 12:36]) > 35.0


def test_jpeg_keeps_colours_and_their_order() -> None:
    image = smooth_image(2)
    image[..., 0] = 230
    back = decode_image(encode_jpeg(image, 95), "x")
    assert psnr(back, image) > 35.0


def test_a_missing_camera_is_named_with_those_there_are(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no camera rear; this rig has front"):
        choose_cameras(clip.cameras, ["rear"])


WHOLE = encode_jpeg(smooth_image(0), 90)


@pytest.mark.parametrize("content", [b"", b"not a jpeg", WHOLE[:60], WHOLE[: len(WHOLE) // 2], WHOLE[:-20]])
def test_a_broken_image_is_a_bad_clip_that_names_the_file(clip: Clip, content: bytes) -> None:
    Path(clip.images[1].uri).write_bytes(content)
    with pytest.raises(BadClip, match=r"1\.jpg: image"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)


def test_a_missing_or_wrongly_sized_image_is_a_bad_clip(clip: Clip) -> None:
    Path(clip.images[0].uri).unlink()
    with pytest.raises(BadClip, match=r"0\.jpg: image: cannot be read"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)
    Path(clip.images[0].uri).write_bytes(encode_jpeg(smooth_image(0)[:50], 90))
    with pytest.raises(BadClip, match=r"size: 96x50, but front takes 96x64"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)


@pytest.mark.parametrize("grey", [0, 255])
def test_a_photo_of_a_dead_camera_is_a_bad_clip_and_never_a_black_frame(clip: Clip, grey: int) -> None:
    Path(clip.images[2].uri).write_bytes(encode_jpeg(np.full((64, 96, 3), grey, np.uint8), 90))
    with pytest.raises(BadClip, match=r"2\.jpg: image: one colour all over, .* render\.cameras="):
        load_sensors(block_of(clip), clip.cameras, 48, 32)
    dark = (smooth_image(0) // 16).astype(np.uint8)  # a night: 3 to 12 of 255
    Path(clip.images[2].uri).write_bytes(encode_jpeg(dark, 90))
    assert len(load_sensors(block_of(clip), clip.cameras, 48, 32).photos) == 3


def test_a_sweep_that_sees_nothing_but_the_ego_is_a_bad_clip(clip: Clip) -> None:
    inside = {name: np.full(5, value, np.float32) for name, value in (("x", 1.0), ("y", 0.0), ("z", 1.0))}
    pyarrow.feather.write_feather(pa.table(inside), clip.sweeps[1].uri)
    with pytest.raises(BadClip, match=r"1\.feather: x y z: none of the 5 returns lies outside"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)


def test_a_broken_sweep_is_a_bad_clip_that_names_file_and_column(clip: Clip) -> None:
    path = Path(clip.sweeps[1].uri)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(BadClip, match=r"1\.feather"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)
    pyarrow.feather.write_feather(pa.table({"x": [1.0], "y": [1.0]}), str(path))
    with pytest.raises(BadClip, match=r"1\.feather: z"):
        load_sensors(block_of(clip), clip.cameras, 48, 32)


def test_a_block_is_built_once_and_read_back_the_same(clip: Clip, tmp_path: Path) -> None:
    first = load_or_build_scene(clip, SETTINGS, tmp_path / "cache")
    assert first is not None and len(first.background) > 100 and len(first.digest) == 16
    for file in clip.images:
        Path(file.uri).write_bytes(bytes(Path(file.uri).stat().st_size))  # a second build would fail
    again = load_or_build_scene(clip, SETTINGS, tmp_path / "cache")
    assert again is not None and again.digest == first.digest
    assert again.background.colours.tobytes() == first.background.colours.tobytes()


def test_a_block_in_16_bits_is_kept_apart_and_drawn_the_same_when_it_is_built_and_when_it_is_read(
    clip: Clip, tmp_path: Path
) -> None:
    half, in_32 = (replace(SETTINGS, scene_dtype=dtype) for dtype in (SceneDtype.FLOAT16, SceneDtype.FLOAT32))
    assert block_id(clip, half) != block_id(clip, in_32)
    built, whole = load_or_build_scene(clip, half, tmp_path), load_or_build_scene(clip, in_32, tmp_path)
    read = load_or_build_scene(clip, half, tmp_path)
    assert built is not None and whole is not None and read is not None
    assert read.background.colours.tobytes() == built.background.colours.tobytes()
    assert read.background.colours.tobytes() != whole.background.colours.tobytes()
    assert read_dtype(tmp_path / f"block-{block_id(clip, half)}.safetensors") is SceneDtype.FLOAT16


def test_a_photo_of_another_size_makes_another_block(clip: Clip, tmp_path: Path) -> None:
    before = block_id(clip, SETTINGS)
    Path(clip.images[0].uri).write_bytes(b"junk")
    assert block_id(clip, SETTINGS) != before
    with pytest.raises(BadClip, match=re.escape(clip.images[0].uri)):
        load_or_build_scene(clip, SETTINGS, tmp_path)


def test_a_scene_fitted_by_another_backend_is_kept_apart(
    clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is built in one go is the same with any; one that is fitted needs what its backend needs."""
    fit = replace(SETTINGS, scene=SceneFrom.FIT)
    on_gpu = replace(fit, backend=Backend.GSPLAT)
    assert block_id(clip, on_gpu) != block_id(clip, fit)
    assert block_id(clip, replace(SETTINGS, backend=Backend.GSPLAT)) == block_id(clip, SETTINGS)
    assert block_id(clip, replace(fit, backend=Backend.GSPLAT_DENSE)) == block_id(clip, on_gpu)  # the same fit
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(BackendMissing, match="needs torch and gsplat"):
        load_or_build_scene(clip, on_gpu, tmp_path)


def test_a_scene_says_which_stretch_of_driving_it_stands_for(clip: Clip, tmp_path: Path) -> None:
    asset = load_or_build_scene(clip, SETTINGS, tmp_path)
    assert asset is not None and asset.block is not None
    assert (asset.block.dataset, asset.block.log_id) == ("test", "log")
    assert (asset.block.start_s, asset.block.end_s) == (0.0, 1.0)
    assert (asset.block.low.tolist(), asset.block.high.tolist()) == ([0.0, 0.0], [4.0, 0.0])


def test_a_clip_without_lidar_or_without_a_rig_has_no_scene(clip: Clip, tmp_path: Path) -> None:
    assert load_or_build_scene(replace(clip, images=(), sweeps=()), SETTINGS, tmp_path) is None
    assert load_or_build_scene(replace(clip, cameras=(), images=()), SETTINGS, tmp_path) is None


def test_photos_without_lidar_are_a_scene_where_they_lie_close_enough_for_parallax(clip: Clip) -> None:
    def spaced(metres: float) -> Clip:
        poses = [np.eye(4) for _ in clip.images]
        for k, pose in enumerate(poses):
            pose[0, 3] = metres * k
        images = tuple(replace(file, world_from_ego=pose) for file, pose in zip(clip.images, poses))
        return replace(clip, images=images, sweeps=())

    made_of = {metres: block_sensing(spaced(metres), SETTINGS) for metres in (0.0, 2.0, 7.0)}
    assert made_of == {0.0: Sensing.NOTHING, 2.0: Sensing.PHOTOS_ONLY, 7.0: Sensing.NOTHING}


def test_a_clip_with_photos_alone_has_a_scene(clip: Clip, tmp_path: Path) -> None:
    asset = load_or_build_scene(
        replace(clip, sweeps=()), replace(SETTINGS, asset=AssetSettings(hold_out_every=3)), tmp_path
    )
    assert asset is not None and asset.n_held_out == 1 and np.isfinite(asset.psnr_db) and len(asset.digest) == 16


def test_a_clip_with_lidar_alone_has_no_scene(clip: Clip, tmp_path: Path) -> None:
    unseen = replace(clip, images=())
    assert block_sensing(unseen, SETTINGS) is Sensing.NOTHING and block_sensing(clip, SETTINGS) is Sensing.PHOTOS
    assert load_or_build_scene(unseen, SETTINGS, tmp_path) is None


def test_another_size_or_window_is_another_block(clip: Clip) -> None:
    ids = {
        block_id(clip, SETTINGS),
        block_id(clip, replace(SETTINGS, width=96)),
        block_id(replace(clip, start_s=1.0), SETTINGS),
        block_id(replace(clip, sweeps=clip.sweeps[:1]), SETTINGS),
    }
    assert len(ids) == 4
    assert block_id(clip, replace(SETTINGS, jpeg_quality=50)) == block_id(clip, SETTINGS)


FIT = FitSettings(iterations=20, hold_out_every=3, start_gaussians=400, most_gaussians=500, stereo_photos=2)
FITTED = RenderSettings(width=48, height=32, scene=SceneFrom.FIT, fit=FIT)


def test_a_killed_fit_goes_on_to_the_same_bytes(clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed = load_or_build_scene(clip, FITTED, tmp_path / "one")
    assert undisturbed is not None and np.isfinite(undisturbed.psnr_db) and undisturbed.n_held_out > 0

    monkeypatch.setattr(assets, "STRETCH", 8)
    monkeypatch.setattr(reconstruct, "REPORT_EVERY", 10)
    advance, starts, said = assets.run_iterations, [], []  # type: ignore[var-annotated]

    def killed_at_16(problem, state, *rest):  # type: ignore[no-untyped-def]
        starts.append(state.iteration)
        if starts == [0, 8, 16]:
            said.extend(assets.running_fits(tmp_path / "two"))
            raise KeyboardInterrupt
        advance(problem, state, *rest)

    monkeypatch.setattr(assets, "run_iterations", killed_at_16)
    with pytest.raises(KeyboardInterrupt):
        load_or_build_scene(clip, FITTED, tmp_path / "two")
    begun = tmp_path / "two" / f"block-{block_id(clip, FITTED)}.fit.npz"
    assert begun.exists()
    again = load_or_build_scene(clip, FITTED, tmp_path / "two")
    assert again is not None and again.digest == undisturbed.digest
    assert starts == [0, 8, 16, 16] and not begun.exists()
    assert len(said) == 1 and said[0].startswith("fit 10/20, "), "how far it is can be asked from outside"
    assert assets.running_fits(tmp_path / "two") == [], "what has ended is not going on"


def test_a_fit_that_is_asked_to_stop_keeps_every_iteration_and_goes_on_to_the_same_bytes(
    clip: Clip, tmp_path: Path
) -> None:
    undisturbed = load_or_build_scene(clip, FITTED, tmp_path / "one")
    begun = tmp_path / "two" / f"block-{block_id(clip, FITTED)}.fit.npz"

    def after(n: int) -> StopCheck:
        """Says no so often."""
        asked = count()
        return lambda: next(asked) >= n

    for n, done in ((7, 7), (5, 12)):
        with pytest.raises(TaskStopped, match=f"{done} of 20 iterations are done"):
            load_or_build_scene(clip, FITTED, tmp_path / "two", stopped=after(n))
        with np.load(begun) as arrays:
            assert arrays["iteration"] == done
        assert assets.running_fits(tmp_path / "two") == []
    again = load_or_build_scene(
        clip, FITTED, tmp_path / "two", stopped=after(8)
    )  # the last iteration is done: nothing to leave
    assert undisturbed is not None and again is not None and again.digest == undisturbed.digest
    assert not begun.exists()


def test_only_the_settings_that_make_the_scene_are_in_its_name(clip: Clip) -> None:
    discs = replace(FITTED, scene=SceneFrom.DISCS)
    longer = replace(FITTED, fit=replace(FIT, iterations=30))
    assert len({block_id(clip, each) for each in (discs, FITTED, longer)}) == 3
    assert block_id(clip, replace(longer, scene=SceneFrom.DISCS)) == block_id(clip, discs)
