"""Several logs of one place: which drives are taken, and what a block of several holds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import log_name, plan_log, write_log
from factory.readers.logs import DrivenPath, OtherDrive, Traversal, path_of, traversals, with_other_drives
from factory.readers.settings import LogClips
from factory.stages.assets import block_id, load_or_build_scene
from factory.stages.sensors import block_cameras, block_of, choose_cameras, load_photos
from tasks.render.scene.build import held_out_rows
from tasks.render.settings import RenderSettings, SceneFrom
from tasks.world.clip import (
    DRIVES_APART_S,
    STEP_S,
    AgentKind,
    AgentTracks,
    Block,
    Camera,
    SensorFile,
    is_of_other_log,
    own_name,
)

LOG, OTHER, STRANGER = 2, 16, 0  # of the town: the first two share a street, the third drives elsewhere


def along(x_m: np.ndarray, y_m: float = 0.0, world: str = "here") -> DrivenPath:
    return path_of(world, np.stack([x_m, np.full(len(x_m), y_m)], axis=1))


MINE = along(1.0 * np.arange(400))  # 1 m a step


def test_a_drive_the_other_way_is_taken_where_it_passes_the_block() -> None:
    back = along(350.0 - 2.0 * np.arange(200), y_m=5.0)
    (found,) = traversals({"me": MINE, "back": back}, "me", 100, 201, 3)
    # The block leads from 100 to 200 m; 12 m away at most is 10.9 m along beyond its ends, kept every 5 steps: 10 m.
    assert found == Traversal("back", 70, 131)


def test_nobody_is_taken_of_another_world_another_street_or_for_a_few_metres() -> None:
    others = {
        "elsewhere": along(1.0 * np.arange(400), world="there"),
        "parallel": along(1.0 * np.arange(400), y_m=12.5),
        "crossing": path_of("here", np.stack([np.full(100, 150.0), 2.0 * np.arange(100) - 100.0], axis=1)),
        "nowhere": path_of("here", np.full((50, 2), np.nan)),
    }
    assert others["crossing"].places[:, 1].min() < 0.0 < others["crossing"].places[:, 1].max()
    found = traversals({"me": MINE, **others}, "me", 100, 301, 9)
    # 24 m of the crossing street lie within 12 m, of which samples 10 m apart show 20.
    assert [other.log_id for other in found] == ["crossing"]
    assert traversals({"me": MINE, **others}, "me", 300, 401, 9) == ()


def test_the_farthest_along_come_first_and_no_more_than_asked_for() -> None:
    some = {name: along(1.0 * np.arange(length)) for name, length in (("a", 130), ("c", 180), ("b", 180))}
    paths = {"me": MINE, **some}
    assert [other.log_id for other in traversals(paths, "me", 100, 301, 9)] == ["b", "c", "a"]
    assert [other.log_id for other in traversals(paths, "me", 100, 301, 2)] == ["b", "c"]
    assert traversals(paths, "me", 100, 301, 0) == ()


def test_of_a_log_that_comes_twice_the_longer_stretch_is_taken_and_20_s_of_it_at_most() -> None:
    first = np.concatenate([np.linspace(160.0, 200.0, 41), np.full(60, 5000.0), 0.1 * np.arange(3000) + 100.0])
    (found,) = traversals({"me": MINE, "twice": along(first)}, "me", 100, 201, 1)
    assert found.start == 105  # the first kept step of the second time: from 101 on, every fifth
    assert found.stop - found.start == 200


def tracks(track_id: str, n_steps: int, x_m: float) -> AgentTracks:
    boxes = np.zeros((n_steps, 1, 5))
    boxes[..., 0], boxes[..., 3:] = x_m, (4.0, 2.0)
    there = np.ones((n_steps, 1), bool)
    return AgentTracks(
        (track_id,), (AgentKind.VEHICLE,), boxes, np.zeros((n_steps, 1, 2)), there, np.ones((n_steps, 1)), np.ones(1)
    )


def photo(time_s: float) -> SensorFile:
    return SensorFile("front", f"{time_s}.jpg", time_s, np.eye(4))


def test_drives_lie_one_after_the_other_on_the_clock_of_the_block_and_keep_their_own_traffic() -> None:
    lens = np.array([[50.0, 0.0, 32.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]])
    camera = Camera("front", 64, 36, lens, np.zeros(5), np.eye(4))
    mine = Block(7.0, tracks("car", 50, 1.0), (photo(0.0), photo(4.9)), ())
    others = [
        OtherDrive("a", tracks("car", 20, 2.0), (camera,), (photo(0.0), photo(1.9)), (photo(1.0),)),
        OtherDrive("b", tracks("van", 30, 3.0), (camera,), (photo(2.9),), ()),
    ]
    block = with_other_drives(mine, others)
    apart = round(DRIVES_APART_S / STEP_S)
    starts = [0, 50 + apart, 50 + apart + 20 + apart]
    assert [(f.sensor, round(f.time_s, 3)) for f in block.images] == [
        ("front", 0.0), ("front", 4.9), ("a/front", 15.0), ("a/front", 16.9), ("b/front", 29.9),
    ]  # fmt: skip
    assert [(f.sensor, round(f.time_s, 3)) for f in block.sweeps] == [("a/front", 16.0)]
    assert block.agents.track_ids == ("car", "a/car", "b/van")
    for column, (start, length, x_m) in enumerate(zip(starts, (50, 20, 30), (1.0, 2.0, 3.0), strict=True)):
        there = np.zeros(starts[-1] + 30, bool)
        there[start : start + length] = True
        assert np.array_equal(block.agents.valid[:, column], there)
        assert (block.agents.boxes[there, column, 0] == x_m).all() and np.isnan(
            block.agents.boxes[~there, column]
        ).all()
    assert 4.9 < block.own_s < 15.0 and block.start_s == 7.0
    assert [camera.name for camera in block.other_cameras] == ["a/front", "b/front"]
    assert [own_name(camera.name) for camera in block.other_cameras] == ["front", "front"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three logs of the town, small; two of them share a street."""
    root = tmp_path_factory.mktemp("town")
    sensors = TownSettings(cameras=("ring_front_center",), width=64, height=36, lidar_beams=16, lidar_azimuths=120)
    for index in (LOG, OTHER, STRANGER):
        write_log(root / log_name(0, index), *plan_log(0, index), sensors, index)
    return root


def clip_and_ref(root: Path, traversals: int):  # type: ignore[no-untyped-def]
    reader = AV2Reader(root, traversals=traversals)
    ref = next(ref for ref in reader.index().refs if ref.log_id == log_name(0, LOG))
    return reader, ref, reader.read(ref)


@pytest.mark.slow
def test_a_block_takes_in_the_log_that_shares_its_street(logs: Path) -> None:
    _, _, alone = clip_and_ref(logs, 0)
    reader, ref, clip = clip_and_ref(logs, 5)
    block = block_of(clip)
    theirs = {f.sensor.partition("/")[0] for f in (*block.images, *block.sweeps) if is_of_other_log(f.sensor)}
    assert theirs == {log_name(0, OTHER)}
    own = tuple(f.uri for f in block.images if not is_of_other_log(f.sensor))
    assert own == tuple(f.uri for f in block_of(alone).images)
    # What the clip itself is stays: only its block knows more, and so its digest says.
    assert clip.agents.track_ids == alone.agents.track_ids and clip.images[0].uri == alone.images[0].uri
    assert clip.content_digest != alone.content_digest
    assert reader.digest(ref) == clip.content_digest
    assert block_id(clip, RenderSettings()) != block_id(alone, RenderSettings())


def test_another_log_that_changes_changes_the_digest(logs: Path, tmp_path: Path) -> None:
    copy = tmp_path / "logs"
    copy.mkdir()
    for folder in logs.iterdir():
        (copy / folder.name).symlink_to(folder)
    other = copy / log_name(0, OTHER)
    other.unlink()
    other.mkdir()
    for path in (logs / log_name(0, OTHER)).iterdir():
        (other / path.name).symlink_to(path)
    before = clip_and_ref(copy, 1)[2].content_digest
    annotations = other / "annotations.feather"
    data = annotations.read_bytes()
    annotations.unlink()
    annotations.write_bytes(data + b"\0")
    reader, ref = AV2Reader(copy, traversals=1), clip_and_ref(logs, 1)[1]
    assert reader.digest(ref) != before


@pytest.mark.slow
def test_a_scene_of_two_drives_keeps_what_is_of_the_street_and_of_its_own_log(logs: Path, tmp_path: Path) -> None:
    settings = RenderSettings(width=64, height=36, scene=SceneFrom.DISCS, psnr_min=0.0, camera_psnr_min=0.0)
    alone, both = (load_or_build_scene(clip_and_ref(logs, n)[2], settings, tmp_path / str(n)) for n in (0, 1))
    assert alone is not None and both is not None
    assert len(both.background) > len(alone.background)
    assert not [name for name in both.nodes if is_of_other_log(name)]
    assert {view.camera for view in both.views} == {"ring_front_center"}
    assert [(v.camera, v.time_s) for v in both.views] == [(v.camera, v.time_s) for v in alone.views]
    assert both.block is not None and alone.block is not None
    assert (both.block.start_s, both.block.end_s) == (alone.block.start_s, alone.block.end_s)
    assert np.array_equal(both.block.low, alone.block.low)


def test_photos_of_other_drives_are_never_held_out(logs: Path) -> None:
    clip = clip_and_ref(logs, 1)[2]
    block = block_of(clip)
    cameras = block_cameras(block, choose_cameras(clip.cameras, ()))
    photos = load_photos(block.images, cameras, 64, 36)
    assert sum(is_of_other_log(photo.camera) for photo in photos) > 8
    held_out = held_out_rows(photos, 4)
    assert held_out and not [i for i in held_out if is_of_other_log(photos[i].camera)]


def test_cameras_that_are_not_chosen_are_not_taken_of_other_drives(logs: Path) -> None:
    block = block_of(clip_and_ref(logs, 1)[2])
    assert block_cameras(block, ()) == ()
    (front,) = (camera for camera in block.other_cameras)
    mine = replace(front, name="ring_front_center")
    assert block_cameras(block, [mine]) == (mine, front)


def test_a_negative_number_is_refused_and_a_format_without_worlds_says_so(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"clips.traversals must be 0 or more, not -1"):
        LogClips("root", traversals=-1)
    from tests.factory.readers.test_logs import StreetReader

    (tmp_path / "a.txt").write_text("116 0 116")
    with pytest.raises(ValueError, match=r"clips.traversals=2: no log under .* says which world it shares"):
        StreetReader(tmp_path, traversals=2).index()
