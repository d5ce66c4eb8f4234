"""The eight cameras and the blobs of a clip: what is read, what may be absent, and what is told as damage."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.datasets.navsim.log import CAMERA_NAMES, read_frames
from factory.datasets.navsim.reader import NavsimReader
from factory.readers.base import BadClip
from factory.readers.pictures import BadPicture, jpeg_size
from factory.stages.sensors import block_of, load_sweeps
from tasks.world.clip import Clip
from tests.factory.datasets.navsim.geopackage_writer import ORIGIN
from tests.factory.datasets.navsim.logs import NAME, SPEED_MPS
from tests.factory.datasets.navsim.small import (
    FRAMES,
    HEIGHT,
    WIDTH,
    blob,
    picture,
    reader_of,
    road_frames,
    write_blobs,
    write_city,
    write_log,
)

OTHER = "2021.06.14.18.00.00_veh-51_00100_00200"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs of one window each, with all their blobs; read only."""
    root = tmp_path_factory.mktemp("rig")
    write_city(root)
    for name in (NAME, OTHER):
        write_log(root, road_frames(name))
        write_blobs(root, road_frames(name))
    return root


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """The same, to damage; the map is one file for all."""
    for folder in ("navsim_logs", "sensor_blobs"):
        shutil.copytree(written / folder, tmp_path / folder)
    (tmp_path / "maps").symlink_to(written / "maps")
    return tmp_path


def read(reader: NavsimReader, name: str = NAME) -> Clip:
    (ref,) = (ref for ref in reader.index().refs if ref.log_id == name)
    return reader.read(ref)


def test_a_clip_has_the_cameras_photos_and_sweeps_of_its_frames(written: Path) -> None:
    clip, frames = read(reader_of(written)), road_frames()
    assert [(c.name, c.width, c.height) for c in clip.cameras] == [(name, WIDTH, HEIGHT) for name in CAMERA_NAMES]
    one = frames[0]["cams"]["CAM_F0"]
    for camera in clip.cameras:
        assert (camera.intrinsics == one["cam_intrinsic"]).all() and (camera.distortion == one["distortion"]).all()
        assert (camera.ego_from_camera[:3, :3] == one["sensor2lidar_rotation"]).all()
        assert (camera.ego_from_camera[:3, 3] == one["sensor2lidar_translation"]).all()
    expected = [(n, str(blob(written, f["cams"][n]["data_path"]))) for f in frames for n in CAMERA_NAMES]
    assert [(image.sensor, image.uri) for image in clip.images] == expected
    assert [sweep.uri for sweep in clip.sweeps] == [str(blob(written, f["lidar_path"])) for f in frames]
    assert [sweep.time_s for sweep in clip.sweeps] == [0.5 * k for k in range(FRAMES)]
    for k, sweep in enumerate(clip.sweeps):
        assert (sweep.world_from_ego[:3, 3] == frames[k]["ego2global_translation"]).all()
    assert block_of(clip).images == clip.images and len(load_sweeps(clip.sweeps)) == FRAMES


def test_a_camera_with_a_stamp_of_its_own_took_its_photo_then_and_there(root: Path) -> None:
    """On a curve the pose is that of the circle, to a centimetre and 0.02 degrees."""
    frames, rate, late_s = road_frames(), 0.02, {"CAM_L1": 0.035, "CAM_R0": -0.008}
    for k, frame in enumerate(frames):
        frame["ego2global_translation"], frame["ego2global_rotation"] = _on_circle(0.5 * k, rate)
        for name, late in late_s.items():
            frame["cams"][name]["timestamp"] = frame["timestamp"] + round(1e6 * late)
    write_log(root, frames)
    clip = read(reader_of(root))
    for image in clip.images:
        late = late_s.get(image.sensor, 0.0)
        k = round((image.time_s - late) / 0.5)
        assert image.time_s == pytest.approx(0.5 * k + late, abs=1e-9)
        place, (w, *_, z) = _on_circle(image.time_s, rate)
        assert image.world_from_ego[:3, 3] == pytest.approx(place, abs=0.01)
        turned = np.arctan2(image.world_from_ego[1, 0], image.world_from_ego[0, 0])
        assert turned == pytest.approx(2.0 * np.arctan2(z, w), abs=3e-4)
    frames[3]["cams"]["CAM_L1"]["timestamp"] += 500_000
    write_log(root, frames)
    with pytest.raises(BadClip, match=r"frames\[3\]\.cams\.CAM_L1\.timestamp: 0.535 s from its frame's"):
        read_frames(root / "navsim_logs" / "mini" / f"{NAME}.pkl")


def _on_circle(time_s: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Place and quaternion of an ego at SPEED_MPS that turns at `rate` rad/s."""
    angle, radius = rate * time_s, SPEED_MPS / rate
    place = [ORIGIN[0] + 10.0 + radius * np.sin(angle), ORIGIN[1] + radius * (1.0 - np.cos(angle)), 12.0]
    return np.array(place), np.array([np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)])


def test_without_a_folder_of_sensors_a_clip_has_none(written: Path) -> None:
    clip = read(reader_of(written, sensors=None))
    assert (clip.cameras, clip.images, clip.sweeps, clip.block) == ((), (), (), None)


def test_frames_whose_blobs_were_not_downloaded_have_none(root: Path) -> None:
    frames = road_frames()
    for made in frames[4:]:
        for path in [made["lidar_path"], *(c["data_path"] for c in made["cams"].values())]:
            blob(root, path).unlink()
    clip = read(reader_of(root))
    assert len(clip.images) == 4 * 8 and len(clip.sweeps) == 4 and len(clip.cameras) == 8


def test_photos_without_sweeps_are_a_clip_and_so_are_sweeps_without_photos(root: Path) -> None:
    shutil.rmtree(blob(root, NAME) / "MergedPointCloud")
    clip = read(reader_of(root))
    assert clip.sweeps == () and len(clip.images) == FRAMES * 8
    for name in CAMERA_NAMES:
        shutil.rmtree(blob(root, OTHER) / name)
    clip = read(reader_of(root), OTHER)
    assert (clip.cameras, clip.images) == ((), ()) and len(clip.sweeps) == FRAMES


def test_a_photo_that_is_missing_beside_others_is_named_and_hurts_no_other_log(root: Path) -> None:
    lost = blob(root, road_frames()[7]["cams"]["CAM_L1"]["data_path"])
    lost.unlink()
    with pytest.raises(BadClip, match=r"missing, though 7 of the frame's 8 pictures are there: restore it") as refused:
        read(reader_of(root))
    assert (refused.value.file, refused.value.field) == (str(lost), "image")
    assert len(read(reader_of(root), OTHER).images) == FRAMES * 8


def test_a_log_without_any_blob_says_how_to_read_it_without(root: Path) -> None:
    shutil.rmtree(blob(root, NAME))
    with pytest.raises(BadClip, match=rf"no picture of the frames 0 to 19 of {NAME} is here; clips\.sensors=null"):
        read(reader_of(root))
    assert len(read(reader_of(root), OTHER).cameras) == 8


def test_a_camera_that_the_log_gives_no_picture_of_is_not_in_the_rig(root: Path) -> None:
    frames = road_frames()
    for made in frames:
        made["cams"]["CAM_B0"] = {"data_path": None}
    write_log(root, frames)
    clip = read(reader_of(root))
    assert [camera.name for camera in clip.cameras] == [name for name in CAMERA_NAMES if name != "CAM_B0"]


@pytest.mark.parametrize("path", ["../../../secret.jpg", "/etc/secret.jpg"])
def test_a_log_s_paths_do_not_leave_the_folder_of_blobs(root: Path, path: str) -> None:
    frames = road_frames()
    frames[2]["cams"]["CAM_F0"]["data_path"] = path
    write_log(root, frames)
    with pytest.raises(BadClip, match="sensor paths lie below the folder of sensor blobs") as refused:
        read(reader_of(root))
    assert refused.value.field == path


def test_a_camera_that_can_be_none_is_named(root: Path) -> None:
    frames = road_frames()
    for made in frames:
        made["cams"]["CAM_L0"]["cam_intrinsic"] = np.zeros((3, 3))
    path = write_log(root, frames)
    with pytest.raises(BadClip, match="focal lengths must be positive") as refused:
        read(reader_of(root))
    assert (refused.value.file, refused.value.field) == (str(path), "cams.CAM_L0")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", picture(WIDTH, HEIGHT)[:100]])
def test_a_first_photo_whose_size_cannot_be_told_is_named(root: Path, content: bytes) -> None:
    bad = blob(root, road_frames()[0]["cams"]["CAM_R1"]["data_path"])
    bad.write_bytes(content)
    with pytest.raises(BadClip, match=r"image: (the file is empty|a (JPEG|PNG) that is cut off)") as refused:
        read(reader_of(root))
    assert refused.value.file == str(bad)


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_s_size_is_its_picture_s_and_a_cut_header_is_told(progressive: int) -> None:
    """Whatever stands before the header: padding, a comment, a preview."""
    _, encoded = cv2.imencode(".jpg", np.zeros((21, 34, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    whole = encoded.tobytes()
    preview = picture(WIDTH, HEIGHT)
    comment = b"\xff\xff\xff\xfe" + (len(preview) + 2).to_bytes(2) + preview
    data = whole[:2] + comment + whole[2:]
    frame_header = 2 + len(comment) + whole[2:].index(b"\xff\xc2" if progressive else b"\xff\xc0")
    for length in [*range(12), *range(len(comment) - 2, frame_header + 40, 3), len(data)]:
        if length >= frame_header + 19:
            assert jpeg_size(data[:length]) == (34, 21)
        else:
            with pytest.raises(BadPicture, match=r"cut off|empty|not a JPEG"):
                jpeg_size(data[:length])


@pytest.mark.parametrize("length", [0, 1])
def test_a_segment_shorter_than_its_own_length_is_no_jpeg(length: int) -> None:
    with pytest.raises(BadPicture, match="cut off"):
        jpeg_size(b"\xff\xd8\xff\xe0" + length.to_bytes(2) + bytes(50))


def test_a_block_takes_in_another_log_of_the_same_place(written: Path) -> None:
    alone, reader = read(reader_of(written)), reader_of(written, traversals=1)
    clip = read(reader)
    (ref,) = (ref for ref in reader.index().refs if ref.log_id == NAME)
    assert clip.content_digest == reader.digest(ref) != alone.content_digest
    block, own = block_of(clip), block_of(alone)
    assert [f.sensor for f in block.images[len(own.images) :]] == [f"{OTHER}/{f.sensor}" for f in own.images]
    assert {camera.name for camera in block.other_cameras} == {f"{OTHER}/{name}" for name in CAMERA_NAMES}
    assert [c.name for c in clip.cameras] == [c.name for c in alone.cameras]
    assert min(f.time_s for f in block.images[len(own.images) :]) > block.own_s
