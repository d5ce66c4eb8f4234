"""Photos beside ScenarioNet's logs: what a sidecar may say, what becomes of it, and how a bad one is refused."""

import json
import math
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from factory.datasets.scenarionet.photos import read_photographs
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip
from factory.readers.pictures import file_and_frame, frame_uri, video_frames
from factory.stages.assets import Sensing, block_id, block_sensing
from factory.stages.scene_file import read_scene, write_scene
from factory.stages.sensors import block_of, load_photos, load_sensors
from factory.store.location import ClipCache, Location
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import encode_jpeg
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.settings import RenderSettings
from tasks.render.splatting.gaussians import EMPTY
from tasks.world.clip import Clip
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town

SIZE = (64, 48)
LEVELS = np.array([40, 90, 140, 190, 240])  # grey of the left half of photo k, by k modulo 5
K = [[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]]
MOUNT = [[0.0, 0.0, 1.0, 1.7], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
Sidecar = dict[str, Any]


def photo(k: int) -> np.ndarray:
    image = np.full((SIZE[1], SIZE[0], 3), LEVELS[k % 5], np.uint8)
    image[:, 32:] = (200, 30, 60)
    return image


def pose_at(time_s: float) -> list[list[float]]:
    """Where the log's ego is, and 0.2 m above."""
    pose = np.eye(4)
    pose[:3, 3] = town.EGO_START + town.EGO_SPEED * time_s, town.EGO_Y, 0.2
    return pose.tolist()


def sidecar(n: int = 24, **more: Any) -> Sidecar:
    """Two cameras at 2 Hz, the second 20 ms later."""
    camera = {"K": K, "width": SIZE[0], "height": SIZE[1], "cam_to_ego": MOUNT}
    frames = [
        {"camera": name, "t_s": 0.5 * k + late, "file": f"{name}/{k:03d}.jpg", "ego_to_world": pose_at(0.5 * k + late)}
        for k in range(n)
        for name, late in (("front", -0.03), ("left", -0.01))
    ]
    return {"version": 1, "cameras": {"front": camera, "left": camera}, "frames": frames, **more}


def write(folder: Path, content: Sidecar, pictures: bool = True) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.json").write_text(json.dumps(content))
    for entry in content["frames"] if pictures else ():
        path = folder / entry["file"]
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encode_jpeg(photo(int(path.stem)), 95))
    return folder


def film(path: Path, n: int, size: tuple[int, int] = SIZE) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=2, options={"crf": "4"})
        stream.width, stream.height = size
        for k in range(n):
            shown = av.VideoFrame.from_ndarray(np.resize(photo(k), (size[1], size[0], 3)), format="rgb24")
            container.mux(stream.encode(shown))
        container.mux(stream.encode(None))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return town.save(town.nuscenes(), tmp_path / "logs", "sd_nuscenes_v1.0-mini_scene-0001.pkl")


def test_a_clip_has_the_photos_of_its_window_where_and_when_its_sidecar_says(log: Path, tmp_path: Path) -> None:
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", sidecar()))
    ref = reader.index().refs[1]
    clip = reader.read(ref)
    assert ref.start_ms == 1000 and [camera.name for camera in clip.cameras] == ["front", "left"]
    front = [image for image in clip.images if image.sensor == "front"]
    assert [image.time_s for image in front] == pytest.approx(0.5 * np.arange(20) - 0.03)
    assert [Path(image.uri).stem for image in front] == [f"{k:03d}" for k in range(2, 22)]
    for image in front:
        np.testing.assert_allclose(image.world_from_ego, pose_at(1.0 + image.time_s))
    assert block_sensing(clip, RenderSettings()) is Sensing.PHOTOS_ONLY
    # Where the ego drove, 0.2 m up as its poses say.
    road = load_sensors(block_of(clip), clip.cameras, *SIZE).known.road
    assert road is not None and np.abs(road[:, 2] - 0.2).max() < 1e-9
    assert [road[:, 1].min(), road[:, 1].max()] == pytest.approx([town.EGO_Y - 3.0, town.EGO_Y + 3.0])
    photos = load_photos(front[:3], clip.cameras, *SIZE)
    assert [int(p.rgb[20, 10].mean()) for p in photos] == pytest.approx(LEVELS[2:5], abs=3)


def test_all_clips_of_a_scene_of_twenty_seconds_are_rendered_from_one_block(tmp_path: Path) -> None:
    log = town.save(town.nuscenes(201), tmp_path / "logs")
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", sidecar(40), pictures=False))
    refs = reader.index().refs
    assert len(refs) == 11 and {reader.block(ref) for ref in refs} == {f"{log.stem}@0s"}
    first, last = reader.read(refs[0]), reader.read(refs[-1])
    assert block_id(first, RenderSettings()) == block_id(last, RenderSettings())
    assert len(block_of(first).images) == 80


def test_windows_begin_where_photos_are(log: Path, tmp_path: Path) -> None:
    """Samples show instants every half second: photos at 0.27 s, 0.77 s, ... ask for windows from 0.3 s on."""
    content = sidecar()
    for entry in content["frames"]:
        entry["t_s"] += 0.3
        entry["ego_to_world"] = pose_at(entry["t_s"])
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", content, pictures=False))
    assert [ref.start_ms for ref in reader.index().refs] == [300, 1300, 2300]
    assert [ref.start_ms for ref in ScenarioNetReader(log).index().refs] == [0, 1000, 2000]


def test_a_photo_without_a_pose_is_where_the_log_s_ego_was(log: Path, tmp_path: Path) -> None:
    content = sidecar()
    for entry in content["frames"]:
        del entry["ego_to_world"]
    del content["frames"][:2]  # 30 ms before the log's first instant is within half a step; the drive begins there
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", content, pictures=False))
    clip = reader.read(reader.index().refs[0])
    for image in clip.images:
        assert image.world_from_ego[:2, 3] == pytest.approx(np.array(pose_at(image.time_s))[:2, 3], abs=0.02)


def test_a_camera_s_own_pose_stands_for_the_ego_s(log: Path, tmp_path: Path) -> None:
    content = sidecar()
    for entry in content["frames"]:
        entry["cam_to_world"] = (np.array(entry.pop("ego_to_world")) @ MOUNT).tolist()
    ours, theirs = (
        ScenarioNetReader(log, cameras=write(tmp_path / name, one, pictures=False)).load(log).photographs.images
        for name, one in (("a", sidecar()), ("b", content))
    )
    for one, other in zip(ours, theirs):
        np.testing.assert_allclose(one.world_from_ego, other.world_from_ego, atol=1e-12)


def test_a_camera_may_say_how_long_it_reads_its_rows(log: Path, tmp_path: Path) -> None:
    """And the cache and the scene's file keep it."""
    content = sidecar()
    content["cameras"]["left"] = content["cameras"]["left"] | {"readout_s": -0.016}
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", content, pictures=False))
    clip = reader.read(reader.index().refs[0])
    assert [one.readout_s for one in clip.cameras] == [0.0, -0.016]
    cache = ClipCache(Location.parse(tmp_path / "cache"))
    cache.store("clip", clip)
    kept = cache.load("clip")
    assert isinstance(kept, Clip) and [one.readout_s for one in kept.cameras] == [0.0, -0.016]
    sky = SkyMap(np.zeros((ROWS, COLUMNS, 3), np.float32))
    write_scene(tmp_path / "scene.safetensors", RenderAsset(np.zeros(3), EMPTY, {}, sky, 30.0, rig=clip.cameras))
    assert [one.readout_s for one in read_scene(tmp_path / "scene.safetensors").rig] == [0.0, -0.016]


def test_one_camera_may_stand_at_the_top_and_a_video_for_the_folder_of_its_pictures(log: Path, tmp_path: Path) -> None:
    """The layout of a front camera whose pictures were kept as `CAM_FRONT.mp4`."""
    mount = {"R": [row[:3] for row in MOUNT[:3]], "t": [row[3] for row in MOUNT[:3]]}
    frames = [{"file": f"CAM_FRONT/{k:03d}.png", "t_s": 0.5 * k, "ego_to_world": pose_at(0.5 * k)} for k in range(24)]
    content = {"K": K, "width": SIZE[0], "height": SIZE[1], "cam_to_ego": mount, "frames": frames}
    folder = write(tmp_path / "photos", content, pictures=False)
    film(folder / "CAM_FRONT.mp4", 24)
    reader = ScenarioNetReader(log, cameras=folder)
    clip = reader.read(reader.index().refs[1])
    assert [camera.name for camera in clip.cameras] == ["CAM_FRONT"]
    assert clip.images[3].uri == f"{folder}/CAM_FRONT.mp4#frame=5"
    data = load_sensors(block_of(clip), clip.cameras, *SIZE)
    assert [int(p.rgb[20, 10].mean()) for p in data.photos] == pytest.approx(LEVELS[np.arange(24) % 5], abs=4)
    assert data.photos[0].rgb[20, 50].tolist() == pytest.approx([200, 30, 60], abs=12)  # red, not blue
    before = block_id(clip, RenderSettings())
    film(folder / "CAM_FRONT.mp4", 25)
    assert block_id(clip, RenderSettings()) != before


def test_sweeps_lie_in_the_lidar_s_frame_and_come_out_in_the_ego_s(log: Path, tmp_path: Path) -> None:
    mount = [[0.0, -1.0, 0.0, 0.9], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.8], [0.0, 0.0, 0.0, 1.0]]
    sweeps = [{"t_s": 0.5 * k, "file": f"lidar/{k}.pcd.bin", "ego_to_world": pose_at(0.5 * k)} for k in range(3)]
    folder = write(tmp_path / "p", sidecar(lidar={"LIDAR_TOP": {"lidar_to_ego": mount}}, sweeps=sweeps), pictures=True)
    (folder / "lidar").mkdir()
    for k in range(3):
        rows = np.array([[0.0, -10.0 - k, -1.8, 12.0, 3.0], [5.0, -20.0, 0.2, 200.0, 30.0]], "<f4")
        (folder / f"lidar/{k}.pcd.bin").write_bytes(rows.tobytes())
    reader = ScenarioNetReader(log, cameras=folder)
    clip = reader.read(reader.index().refs[0])
    assert block_sensing(clip, RenderSettings()) is Sensing.PHOTOS
    swept = load_sensors(block_of(clip), clip.cameras, *SIZE).sweeps
    np.testing.assert_allclose(swept[1].points, [[11.9, 0.0, 0.0], [20.9, 5.0, 2.0]], atol=1e-5)
    assert swept[1].world_from_ego.tolist() == pose_at(0.5)
    assert load_sensors(block_of(clip), clip.cameras, *SIZE).known.road is None  # the lidar knows better
    (folder / "lidar/2.pcd.bin").write_bytes(b"\0" * 39)
    with pytest.raises(BadClip, match=r"2\.pcd\.bin: points: 39 bytes are not rows of 5 float32"):
        load_sensors(block_of(clip), clip.cameras, *SIZE)


def test_each_log_finds_its_own_sidecar_and_one_without_has_no_photos(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        town.save(town.nuscenes(), tmp_path / "logs", f"sd_nuscenes_v1.0-mini_scene-000{number}.pkl")
    write(tmp_path / "photos" / "scene-0001", sidecar(), pictures=False)
    write(tmp_path / "photos" / "sd_nuscenes_v1.0-mini_scene-0003", sidecar(), pictures=False)
    reader = ScenarioNetReader(tmp_path / "logs", cameras=tmp_path / "photos")
    refs = reader.index().refs
    found = {ref.log_id[-1]: bool(reader.read(ref).images) for ref in refs}
    assert found == {"1": True, "2": False, "3": True}
    assert {ref.log_id[-1]: reader.block(ref) is not None for ref in refs} == found


def test_photos_may_lie_elsewhere_than_their_sidecar(log: Path, tmp_path: Path) -> None:
    write(tmp_path / "nuscenes", sidecar())
    (tmp_path / "nuscenes" / "cameras.json").rename(tmp_path / "cameras.json")
    reader = ScenarioNetReader(log, cameras=tmp_path / "cameras.json", sensor_root=tmp_path / "nuscenes")
    clip = reader.read(reader.index().refs[0])
    assert len(load_photos(clip.images, clip.cameras, *SIZE)) == len(clip.images) == 40


def test_the_digest_follows_the_sidecar(log: Path, tmp_path: Path) -> None:
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", sidecar(), pictures=False))
    ref = reader.index().refs[0]
    assert reader.digest(ref) == reader.read(ref).content_digest
    content = sidecar()
    content["cameras"]["left"] = content["cameras"]["left"] | {"width": 65}
    write(tmp_path / "photos", content, pictures=False)
    changed = ScenarioNetReader(log, cameras=tmp_path / "photos")
    assert len({reader.read(ref).content_digest, changed.digest(ref), ScenarioNetReader(log).digest(ref)}) == 3


def frame(key: str, value: object) -> Callable[[Sidecar], object]:
    return lambda content: content["frames"][2].update({key: value})


def camera(key: str, value: object) -> Callable[[Sidecar], object]:
    return lambda content: content["cameras"].update(left=content["cameras"]["left"] | {key: value})


BAD: list[tuple[Callable[[Sidecar], object], str]] = [
    (lambda c: c.update(version=2), "version: 2, this version reads 1"),
    (lambda c: c.update(cameras={}), "cameras: missing, or not an object of one object for each camera"),
    (lambda c: c.pop("frames"), "frames: missing, or not a list of objects"),
    (lambda c: c.update(frames=[]), "frames: is empty: no photo"),
    (lambda c: c.update(frames=[1]), "frames: missing, or not a list of objects"),
    (lambda c: c.update(cameras={f"c{i}": c["cameras"]["left"] for i in range(65)}), "cameras: 65 of them, at most 64"),
    (camera("width", 20_000), "cameras.left.width: 20000: expected a whole number of pixels, 1 to 16384"),
    (camera("height", True), "cameras.left.height: True: expected a whole number"),
    (camera("K", None), "cameras.left.K: missing, expected 3 x 3 numbers"),
    (camera("K", [[1, 0], [0, 1]]), r"cameras.left.K: shape \(2, 2\), expected 3 x 3 numbers"),
    (camera("K", [["a", 0, 0]] * 3), "cameras.left.K: is not numbers, expected 3 x 3 of them"),
    (camera("K", [[50, 1, 32], [0, 50, 24], [0, 0, 1]]), r"cameras.left.K: expected \[\[fx, 0, cx\]"),
    (camera("K", [[-50, 0, 32], [0, 50, 24], [0, 0, 1]]), "cameras.left: camera left: intrinsics: focal lengths"),
    (camera("distortion", [0.1] * 4), r"cameras.left.distortion: shape \(4,\), expected 5 numbers"),
    (camera("distortion", [math.nan] * 5), "cameras.left.distortion: holds NaN, infinity or numbers beyond 1e8"),
    (camera("fisheye", [0.1] * 5), r"cameras.left.fisheye: shape \(5,\), expected 4 numbers"),
    (lambda c: c["cameras"]["left"].update(fisheye=[0] * 4, distortion=[0.1] * 5), "cameras.front.fisheye: a lens"),
    (camera("readout_s", "30 ms"), "cameras.left.readout_s: '30 ms': expected seconds from the first row to the last"),
    (camera("readout_s", 30), "cameras.left: camera left: readout_s: 30.0, expected 0.2 s at most"),
    (camera("readout_s", math.nan), "cameras.left: camera left: readout_s: nan, expected 0.2 s at most"),
    (lambda c: c["cameras"]["left"].update(fisheye=[0] * 4, readout_s=0.03), "cameras.front: .* readout_s: not for"),
    (camera("cam_to_ego", {"R": K}), "cameras.left.cam_to_ego.t: missing, expected 3 numbers"),
    (camera("cam_to_ego", {"R": K, "t": [0, 0, 0]}), "cameras.left.cam_to_ego: is not a rotation and a shift"),
    (camera("cam_to_ego", np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "cameras.left.cam_to_ego: mirrors"),
    (frame("camera", "rear"), r"frames\[2\].camera: 'rear' is none of front, left"),
    (frame("t_s", "0.5"), r"frames\[2\].t_s: '0.5': expected seconds since the log's first instant"),
    (frame("t_s", math.inf), r"frames\[2\].t_s: inf: expected seconds"),
    (lambda c: c["frames"].append(c["frames"][0]), r"frames\[48\].t_s: front took two photos at -0.03 s"),
    (frame("file", None), r"frames\[2\].file: None is no path of a picture"),
    (frame("file", "/etc/passwd"), r"frames\[2\].file: '/etc/passwd': paths are relative"),
    (frame("file", "a/../../b.jpg"), r"frames\[2\].file: .*: paths are relative, below the folder of the photos"),
    (frame("ego_to_world", [[1e9, 0, 0, 0]] * 4), r"frames\[2\].ego_to_world: holds NaN, infinity or numbers beyond"),
    (frame("ego_to_world", pose_at(9.0)), r"frames\[2\].ego_to_world: 68 m from where the log's ego was at 0.47 s"),
    (lambda c: c["frames"].append({"camera": "left", "t_s": 99.0, "file": "left/9.jpg"}), "no drive at 99 s to take"),
    (lambda c: c.update(sweeps=[]), "lidar: missing, or not one lidar"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "said"), BAD, ids=range(len(BAD)))
def test_a_bad_sidecar_breaks_its_log_and_names_the_field(
    log: Path, tmp_path: Path, spoil: Callable[[Sidecar], object], said: str
) -> None:
    content = sidecar()
    spoil(content)
    reader = ScenarioNetReader(log, cameras=write(tmp_path / "photos", content, pictures=False))
    (problem,) = reader.index().broken.values()
    assert re.search(rf"photos/cameras\.json: {said}" if not said.startswith("no drive") else said, problem), problem


def test_the_documented_example_is_read_as_its_page_says(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[4] / "docs" / "photos.md").read_text()
    (example,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (tmp_path / "cameras.json").write_text(example)
    found = read_photographs(tmp_path / "cameras.json", tmp_path, np.full((5, 11), np.nan))
    assert (found.cameras[0].name, found.cameras[0].width, found.images[0].time_s) == ("CAM_FRONT", 1600, 0.0)
    assert found.sweeps[0].ego_from_sensor[:3, 3].tolist() == [0.94, 0.0, 1.84]
    assert found.images[0].uri.startswith(str(tmp_path / "samples" / "CAM_FRONT"))


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", "[" * 100_000])
def test_a_sidecar_that_is_no_object_is_refused(log: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "cameras.json").write_text(text)
    (problem,) = ScenarioNetReader(log, cameras=tmp_path).index().broken.values()
    assert re.search(r"cameras\.json: file: (is no JSON|holds a list, expected an object)", problem)


def test_where_no_sidecar_is_or_one_stands_for_several_logs_is_said_at_once(log: Path, tmp_path: Path) -> None:
    town.save(town.nuscenes(), log.parent, "sd_nuscenes_v1.0-mini_scene-0002.pkl")
    write(tmp_path / "photos", sidecar(), pictures=False)
    (tmp_path / "empty").mkdir()
    for settings, said in (
        ({"cameras": tmp_path / "photos"}, "one log's sidecar, and 2 logs are read: name it by clips.only="),
        ({"cameras": tmp_path / "gone"}, "gone: no such file or folder"),
        ({"cameras": tmp_path / "empty"}, r"no cameras\.json here, nor in <log id>/ of any log that is read: sd_nusc"),
    ):
        with pytest.raises(ValueError, match=said):
            ScenarioNetReader(log.parent, **settings).index()
    one = ScenarioNetReader(log.parent, cameras=tmp_path / "photos", only=[log.stem])
    assert one.read(one.index().refs[0]).images
    with pytest.raises(ValueError, match=r"clips\.sensor_root=.*gone: no such folder"):
        ScenarioNetReader(log, cameras=tmp_path / "photos", sensor_root=tmp_path / "gone")
    with pytest.raises(ValueError, match=r"goes with clips\.cameras"):
        ScenarioNetReader(log, sensor_root=tmp_path)


@pytest.mark.parametrize(
    ("size", "problem"),
    [
        ((128, 96), r"size: 128x96, but its camera takes 64x48"),
        ((9000, 8000), "video: cannot be decoded after 1 frame"),
    ],
)
def test_a_frame_that_is_larger_than_its_video_says_is_refused(
    tmp_path: Path, size: tuple[int, int], problem: str
) -> None:
    """Before it is decoded where it has more pixels than any picture may have."""
    frames = [cv2.imencode(".png", np.full((h, w), 90, np.uint8))[1].tobytes() for w, h in (SIZE, size, SIZE)]
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream = container.add_stream("png", rate=2)
        (stream.width, stream.height), stream.pix_fmt = SIZE, "gray"
        for k, frame in enumerate(frames):
            packet = av.Packet(frame)
            packet.stream, packet.pts, packet.dts, packet.time_base = stream, k, k, Fraction(1, 2)
            container.mux(packet)
    shown = video_frames(tmp_path / "a.avi", {0, 1, 2}, *SIZE)
    assert next(shown)[0] == 0
    with pytest.raises(BadClip, match=rf"a\.avi: {problem}"):
        next(shown)


def test_frames_are_named_by_their_place_in_the_video() -> None:
    assert file_and_frame(frame_uri(Path("/a/b.mp4"), 12)) == (Path("/a/b.mp4"), 12)
    assert file_and_frame("/a/frame=1.jpg") == (Path("/a/frame=1.jpg"), None)


def test_frames_come_in_order_and_none_beyond_those_asked_for_is_looked_at(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", 9)
    found = list(video_frames(tmp_path / "a.mp4", {7, 2}, *SIZE))
    assert [k for k, _ in found] == [2, 7]
    assert [int(image[20, 10].mean()) for _, image in found] == pytest.approx(LEVELS[[2, 2]], abs=4)


def test_a_video_that_is_short_broken_or_of_another_size_is_named(tmp_path: Path) -> None:
    video = tmp_path / "a.mp4"
    film(video, 4)
    with pytest.raises(BadClip, match=r"a\.mp4: video: holds 4 frames, frame 4 of it is asked for, counted from 0"):
        list(video_frames(video, {4}, *SIZE))
    with pytest.raises(BadClip, match=r"a\.mp4: size: 64x48, but its camera takes 32x48"):
        list(video_frames(video, {0}, 32, 48))
    video.write_bytes(b"junk" * 100)
    with pytest.raises(BadClip, match=r"a\.mp4: video: cannot be decoded after 0 frames"):
        list(video_frames(video, {0}, *SIZE))
    with pytest.raises(BadClip, match=r"b\.mp4: video: cannot be decoded after 0 frames: .*No such file"):
        list(video_frames(tmp_path / "b.mp4", {0}, *SIZE))
