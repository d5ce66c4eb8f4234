"""The Argoverse 2 reader on small logs written here: what it reads, what it drops, what it refuses and how."""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from factory.datasets.av2.reader import AV2Reader, read_cameras
from factory.readers.base import BadClip, ClipRef
from factory.stages.sensors import load_photos
from tasks.render.scene.engine import encode_jpeg
from tasks.world.clip import CLIP_STEPS, NOW, AgentKind
from tasks.world.frames import AX, AY, HEADING, VX, X
from tasks.world.road_map import LightState

START_NS = 315_966_253_000_000_000
YAW = 0.5  # the road's direction in the city frame
SPEED = 8.0


def road(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Road coordinates to the city frame, (..., 2)."""
    c, s = np.cos(YAW), np.sin(YAW)
    return np.stack([1000.0 + c * x - s * y, 500.0 + s * x + c * y], axis=-1)


def write_table(path: Path, columns: dict[str, object]) -> None:
    pyarrow.feather.write_feather(pa.table(columns), str(path))


def edit(path: Path, change: Callable[[dict[str, list]], object]) -> None:
    """Rewrite a feather file with its columns changed in place."""
    columns = pyarrow.feather.read_table(path).to_pydict()
    change(columns)
    write_table(path, columns)


def pose_columns(n: int, yaw: float, position: np.ndarray) -> dict[str, np.ndarray]:
    quaternion = {"qw": np.cos(yaw / 2), "qx": 0.0, "qy": 0.0, "qz": np.sin(yaw / 2)}
    return {name: np.full(n, value) for name, value in quaternion.items()} | {
        name: np.broadcast_to(position[..., i], (n,)).copy() for i, name in enumerate(("tx_m", "ty_m", "tz_m"))
    }


def boundary(start: float, stop: float, y: float) -> list[dict[str, float]]:
    return [{"x": float(x), "y": float(v), "z": 2.0} for x, v in road(np.array([start, stop]), np.array([y, y]))]


def write_log(folder: Path, seconds: float = 11.6, speed: float = SPEED) -> Path:
    """An ego at constant speed on a straight two-piece lane; a car 20 m ahead, as fast; a cone at the roadside."""
    (folder / "map").mkdir(parents=True)
    n_frames = round(seconds * 10) + 1
    frame_ns = START_NS + np.arange(n_frames) * 100_000_000
    pose_ns = START_NS + np.arange((n_frames + 5) * 10) * 10_000_000
    ego_x = speed * (pose_ns - START_NS) * 1e-9
    position = np.column_stack([road(ego_x, np.zeros_like(ego_x)), np.full(len(ego_x), 1.5)])
    write_table(
        folder / "city_SE3_egovehicle.feather", {"timestamp_ns": pose_ns, **pose_columns(len(pose_ns), YAW, position)}
    )

    cone_x = 60.0 - speed * (frame_ns - START_NS) * 1e-9
    car = np.column_stack([np.full(n_frames, 20.0), np.zeros((n_frames, 2))])
    cone = np.column_stack([cone_x, np.full(n_frames, -3.0), np.zeros(n_frames)])
    tables = []
    for track, category, size, where in (
        ("car", "REGULAR_VEHICLE", (4.5, 1.9, 1.6), car),
        ("cone", "CONSTRUCTION_CONE", (0.4, 0.4, 0.7), cone),
    ):
        sizes = {name: np.full(n_frames, value) for name, value in zip(("length_m", "width_m", "height_m"), size)}
        names = {"track_uuid": [track] * n_frames, "category": [category] * n_frames}
        tables.append(pa.table({"timestamp_ns": frame_ns, **names, **sizes, **pose_columns(n_frames, 0.0, where)}))
    pyarrow.feather.write_feather(pa.concat_tables(tables), str(folder / "annotations.feather"))

    def lane(start: float, stop: float, **graph: object) -> dict[str, object]:
        return {
            "is_intersection": False,
            "lane_type": "VEHICLE",
            "left_lane_boundary": boundary(start, stop, 2.0),
            "right_lane_boundary": boundary(start, stop, -2.0),
            "left_lane_mark_type": "DASHED_WHITE",
            "right_lane_mark_type": "SOLID_WHITE",
            "successors": [],
            "predecessors": [],
            "left_neighbor_id": None,
            "right_neighbor_id": None,
            **graph,
        }

    content = {
        "lane_segments": {
            "1": lane(-20, 60, successors=[2]),
            "2": lane(60, 300, predecessors=[1], is_intersection=True),
        },
        "drivable_areas": {"9": {"area_boundary": boundary(-20, 300, 4.0) + boundary(300, -20, -4.0), "id": 9}},
        "pedestrian_crossings": {"5": {"edge1": boundary(50, 53, 2.0), "edge2": boundary(50, 53, -2.0), "id": 5}},
    }
    (folder / "map" / f"log_map_archive_{folder.name}____TWN_city_1.json").write_text(json.dumps(content))
    return folder


def the_map(log: Path) -> Path:
    return next((log / "map").glob("*.json"))


def edit_map(log: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(the_map(log).read_text())
    change(content)
    the_map(log).write_text(json.dumps(content))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "sensor" / "val" / "log-a")


def test_windows_start_every_stride_and_fit_the_log(log: Path) -> None:
    index = AV2Reader(log).index()
    assert [ref.start_ms for ref in index.refs] == [0, 1000, 2000]
    assert [ref.start_ms for ref in AV2Reader(log, stride_s=0.5).index().refs] == [0, 500, 1000, 1500, 2000]
    with pytest.raises(ValueError, match="stride_s"):
        AV2Reader(log, stride_s=0.25)


@pytest.mark.parametrize("root", [".", "sensor/..", "sensor", "sensor/val", "sensor/val/log-a"])
def test_a_root_may_be_the_data_set_a_split_or_one_log(log: Path, tmp_path: Path, root: str) -> None:
    if root in (".", "sensor/.."):
        with pytest.raises(ValueError, match="no Argoverse 2 sensor log"):
            AV2Reader(tmp_path / root).index()
    else:
        assert [ref.log_id for ref in AV2Reader(tmp_path / root).index().refs] == ["log-a"] * 3


def test_who_gets_the_reader_looks_at_no_log_but_the_clip_s(log: Path, tmp_path: Path) -> None:
    reader = AV2Reader(tmp_path / "sensor")
    ref = reader.index().refs[0]
    worker = pickle.loads(pickle.dumps(reader))
    shutil.copytree(log, tmp_path / "sensor" / "test" / log.name)  # who lists the logs again is refused
    assert worker.read(ref).content_digest == worker.digest(ref) and worker.block(ref) == reader.block(ref)
    with pytest.raises(ValueError, match="stands twice"):
        AV2Reader(tmp_path / "sensor").index()


def test_states_of_a_straight_drive_are_its_closed_form(log: Path) -> None:
    reader = AV2Reader(log)
    clip = reader.read(reader.index().refs[1])
    assert clip.ego_states.shape == (CLIP_STEPS, 11)
    expected = road(SPEED * (1.0 + 0.1 * np.arange(CLIP_STEPS)), np.zeros(CLIP_STEPS))
    assert np.abs(clip.ego_states[:, [X, X + 1]] - expected).max() < 1e-8
    assert np.abs(clip.ego_states[:, HEADING] - YAW).max() < 1e-9
    assert np.abs(clip.ego_states[:, VX] - SPEED).max() < 1e-7
    assert np.abs(clip.ego_states[:, AX:]).max() < 1e-4
    assert np.abs(clip.world_from_ego[:, :2, 3] - expected).max() < 1e-8
    assert np.allclose(clip.world_from_ego[:, 2, 3], 1.5)

    car, cone = (clip.agents.track_ids.index(name) for name in ("car", "cone"))
    assert clip.agents.kinds[car] is AgentKind.VEHICLE and clip.agents.kinds[cone] is AgentKind.TRAFFIC_CONE
    assert clip.agents.valid.all()
    ahead = clip.agents.boxes[:, car, :2] - clip.ego_states[:, [X, X + 1]]
    assert np.abs(np.hypot(*ahead.T) - 20.0).max() < 1e-8
    assert np.abs(np.hypot(*clip.agents.velocities[:, car].T) - SPEED).max() < 1e-6
    assert np.ptp(clip.agents.boxes[:, cone, :2], axis=0).max() < 1e-8
    assert (clip.agents.velocities[:, cone] == 0.0).all()
    assert np.allclose(clip.agents.center_z, 1.5) and clip.agents.heights[car] == 1.6


def test_an_ego_that_speeds_up_has_its_acceleration_along_its_heading(log: Path) -> None:
    """x = 4 t + 0.6 t^2 along the road."""

    def speed_up(columns: dict[str, list]) -> None:
        time = (np.array(columns["timestamp_ns"]) - START_NS) * 1e-9
        way = 4.0 * time + 0.6 * time**2
        columns["tx_m"], columns["ty_m"] = road(way, np.zeros_like(way)).T.tolist()

    edit(log / "city_SE3_egovehicle.feather", speed_up)
    reader = AV2Reader(log)
    states = reader.read(reader.index().refs[1]).ego_states
    np.testing.assert_allclose(states[:, VX], 4.0 + 1.2 * (1.0 + 0.1 * np.arange(CLIP_STEPS)), atol=1e-6)
    np.testing.assert_allclose(states[:, AX], 1.2, atol=1e-6)
    np.testing.assert_allclose(states[:, AY], 0.0, atol=1e-6)


def test_map_route_and_marks_come_from_the_vector_map(log: Path) -> None:
    reader = AV2Reader(log)
    clip = reader.read(reader.index().refs[0])
    assert clip.route.lane_path == ("1", "2")
    assert clip.road_map.lanes["2"].is_intersection and clip.road_map.location == "TWN_city_1"
    assert clip.road_map.lanes["1"].left_mark == "DASHED_WHITE"
    assert np.allclose(clip.road_map.lanes["1"].left_boundary[:, 2], 2.0)
    assert len(clip.road_map.crossings) == 1 and clip.road_map.drivable_areas[0].token == "da_9"
    assert np.allclose(clip.centerline[0, :2], road(np.array(-20.0), np.array(0.0)))
    assert clip.ego_states[NOW, X] == pytest.approx(road(np.array(SPEED * 1.5), np.array(0.0))[0])


def without_frames(*numbers: int) -> Callable[[dict[str, list]], None]:
    def change(columns: dict[str, list]) -> None:
        gone = {START_NS + k * 100_000_000 for k in numbers}
        keep = [i for i, stamp in enumerate(columns["timestamp_ns"]) if stamp not in gone]
        for name in columns:
            columns[name] = [columns[name][i] for i in keep]

    return change


@pytest.mark.parametrize("missing", [(100,), (100, 101, 102, 103)])
def test_frames_that_are_missing_for_half_a_second_are_filled_in(log: Path, tmp_path: Path, missing: tuple) -> None:
    """Everything goes straight here: on the line between its neighbours it is where it was."""
    whole = AV2Reader(write_log(tmp_path / "whole" / "log-a"))
    edit(log / "annotations.feather", without_frames(*missing))
    reader = AV2Reader(log)
    index = reader.index()
    assert [ref.start_ms for ref in index.refs] == [0, 1000, 2000] and not index.dropped
    for ref in index.refs:
        found, expected = reader.read(ref), whole.read(ref)
        assert found.agents.valid.all()
        np.testing.assert_allclose(found.agents.boxes, expected.agents.boxes, atol=1e-9)
        np.testing.assert_allclose(found.agents.velocities, expected.agents.velocities, atol=1e-9)
        assert [(r.what, r.time_s, r.now) for r in found.repairs] == [("gap", 9.9, "filled in")]  # of velocities too


def ego_elsewhere_from_then_on(columns: dict[str, list]) -> None:
    columns["tx_m"][1050:] = [x + 30.0 for x in columns["tx_m"][1050:]]


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("annotations.feather", without_frames(100, 101, 102, 103, 104)),
        ("city_SE3_egovehicle.feather", ego_elsewhere_from_then_on),
    ],
    ids=["a longer gap of frames", "a jump of the ego"],
)
def test_windows_across_what_cannot_be_filled_in_are_dropped_and_counted(
    log: Path, file: str, change: Callable[[dict[str, list]], None]
) -> None:
    edit(log / file, change)
    index = AV2Reader(log).index()
    assert [ref.start_ms for ref in index.refs] == [0] and index.dropped == {"broken_tracks": 2}


def test_a_car_that_its_frames_do_not_show_is_absent_there(log: Path) -> None:
    def without_the_car(columns: dict[str, list]) -> None:
        for values in columns.values():
            del values[50:53]

    edit(log / "annotations.feather", without_the_car)
    reader = AV2Reader(log)
    clip = reader.read(reader.index().refs[0])
    car = clip.agents.track_ids.index("car")
    assert np.flatnonzero(~clip.agents.valid[:, car]).tolist() == [50, 51, 52]
    assert not clip.repairs


def test_a_log_without_annotations_is_skipped_with_its_reason(log: Path) -> None:
    (log / "annotations.feather").unlink()
    index = AV2Reader(log).index()
    assert index.skipped_logs == {"log-a": "no annotations.feather"} and not index.broken


def test_light_phases_hold_until_the_next_row(log: Path) -> None:
    rows = {"timestamp_ns": [START_NS, START_NS + 2_000_000_000], "lane_id": [2, 2], "state": ["GREEN", "RED"]}
    write_table(log / "traffic_lights.feather", rows)
    reader = AV2Reader(log)
    lights = reader.read(reader.index().refs[1]).lights
    assert lights.lane_ids == ("2",)
    assert (lights.states[:10, 0] == LightState.GREEN).all() and (lights.states[10:, 0] == LightState.RED).all()


def calibrate(log: Path, **changed: float) -> None:
    """One camera, its intrinsics or mount changed."""
    (log / "calibration").mkdir(exist_ok=True)
    numbers = {"fx_px": 500.0, "fy_px": 510.0, "cx_px": 320.0, "cy_px": 240.0, "k1": 0.0, "k2": 0.0, "k3": 0.0}
    shape = {"height_px": 480, "width_px": 640}
    intrinsics = {name: changed.get(name, value) for name, value in (numbers | shape).items()}
    write_table(
        log / "calibration" / "intrinsics.feather",
        {"sensor_name": ["front"], **{k: [v] for k, v in intrinsics.items()}},
    )
    mount = pose_columns(1, 0.0, np.array([1.0, 0.0, 1.4]))
    mount |= {"qw": np.array([0.5]), "qx": np.array([-0.5]), "qy": np.array([0.5]), "qz": np.array([-0.5])}  # ahead
    mount |= {name: np.array([value]) for name, value in changed.items() if name in mount}
    write_table(log / "calibration" / "egovehicle_SE3_sensor.feather", {"sensor_name": ["front"], **mount})


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"width_px": 0}, r"intrinsics\.feather: calibration: camera front: size: 0x480"),
        ({"fx_px": -500.0}, "camera front: intrinsics: focal lengths must be positive"),
        ({"cx_px": float("nan")}, r"intrinsics\.feather: cx_px: holds NaN"),
        ({"qw": 0.9}, r"SE3_sensor\.feather: qw qx qy qz: a quaternion is not of unit length"),
    ],
)
def test_a_calibration_that_is_none_is_named(log: Path, changed: dict[str, float], said: str) -> None:
    calibrate(log, **changed)
    with pytest.raises(BadClip, match=said):
        read_cameras(log)


def test_images_and_sweeps_carry_the_pose_of_their_stamp(log: Path) -> None:
    camera_ns, lidar_ns = START_NS + 1_030_000_000, START_NS + 2_500_000_000
    (log / "sensors" / "cameras" / "front").mkdir(parents=True)
    (log / "sensors" / "lidar").mkdir()
    (log / "sensors" / "cameras" / "front" / f"{camera_ns}.jpg").touch()
    (log / "sensors" / "lidar" / f"{lidar_ns}.feather").touch()
    calibrate(log)
    reader = AV2Reader(log)
    first, second, third = (reader.read(ref) for ref in reader.index().refs)
    camera = first.cameras[0]
    assert camera.intrinsics[1, 1] == 510.0 and (camera.width, camera.height) == (640, 480)
    assert [round(image.time_s, 9) for image in second.images] == [0.03] and not third.images
    assert np.allclose(second.images[0].world_from_ego[:2, 3], road(np.array(SPEED * 1.03), np.array(0.0)))
    assert [round(clip.sweeps[0].time_s, 9) for clip in (first, second, third)] == [2.5, 1.5, 0.5]


def test_ring_photos_are_taken_as_released_at_full_size_and_each_with_its_own_stamp(log: Path) -> None:
    """Argoverse took the distortion out before it released them; k1..k3 tell of the lens (av2-api projects without)."""
    calibrate(log, k1=-0.240732, k2=-0.212243, k3=0.325902, width_px=1550, height_px=2048, cx_px=778.0, cy_px=1013.5)
    folder = log / "sensors" / "cameras" / "front"
    folder.mkdir(parents=True)
    photo = np.kron(np.random.default_rng(0).integers(40, 215, (64, 50, 3)), np.ones((32, 31, 1))).astype(np.uint8)
    stamps_ns = START_NS + 1_000_000_000 + 49_950_000 * np.arange(60) + 1_234_567  # 20 Hz, between the poses' stamps
    for stamp in stamps_ns:
        (folder / f"{stamp}.jpg").touch()
    (folder / f"{stamps_ns[0]}.jpg").write_bytes(encode_jpeg(photo, 95))
    reader = AV2Reader(log)
    clip = reader.read(reader.index().refs[0])
    assert not clip.cameras[0].distortion.any()
    assert [image.time_s for image in clip.images] == pytest.approx((stamps_ns - START_NS) / 1e9, abs=1e-9)
    expected = road(SPEED * (stamps_ns - START_NS) / 1e9, np.zeros(60))
    assert np.abs(np.stack([image.world_from_ego[:2, 3] for image in clip.images]) - expected).max() < 1e-7
    (loaded,) = load_photos(clip.images[:1], clip.cameras, 1550, 2048)
    assert loaded.rgb.shape == (2048, 1550, 3)
    assert np.abs(loaded.rgb.astype(int) - photo).mean() < 3.0  # a JPEG away from it: nothing was bent
    assert loaded.intrinsics.tolist() == clip.cameras[0].intrinsics.tolist()


def test_clip_ids_and_digest_know_the_content_but_not_the_place(log: Path, tmp_path: Path) -> None:
    copy = write_log(tmp_path / "elsewhere" / "log-a")
    here, there = (AV2Reader(folder) for folder in (log, copy))
    one, other = here.read(here.index().refs[0]), there.read(there.index().refs[0])
    assert (one.clip_id, one.content_digest) == (other.clip_id, other.content_digest)
    edit_map(copy, lambda content: content["lane_segments"]["1"].update(left_lane_mark_type="NONE"))
    changed = AV2Reader(copy).read(here.index().refs[0])
    assert changed.clip_id == one.clip_id and changed.content_digest != one.content_digest


def test_a_log_is_read_as_it_is_now_and_not_as_the_index_met_it(log: Path) -> None:
    reader = AV2Reader(log)
    first = reader.index().refs[0]
    as_indexed, sent = pickle.loads(pickle.dumps(reader)).read(first), len(pickle.dumps(reader))
    assert sent < 5_000, "what the index read does not travel to workers"

    edit(log / "annotations.feather", lambda columns: columns.update(length_m=[9.0] * len(columns["length_m"])))
    clip = reader.read(first)
    assert clip.content_digest != as_indexed.content_digest
    assert (clip.agents.boxes[NOW, :, 3] == 9.0).all() and not (as_indexed.agents.boxes[NOW, :, 3] == 9.0).any()


def test_name_and_licence_are_the_log_s_own(log: Path) -> None:
    reader = AV2Reader(log, name="synthetic")
    assert "Argoverse" in reader.read(reader.index().refs[0]).licence
    (log / "LICENSE").write_text("Apache-2.0 (synthetic)\nmore\n")
    reader = AV2Reader(log, name="synthetic")
    clip = reader.read(reader.index().refs[0])
    assert (clip.dataset, clip.licence) == ("synthetic", "Apache-2.0 (synthetic)")


def test_a_clip_s_block_is_named_without_reading_it_where_its_log_has_photos(tmp_path: Path) -> None:
    for name in ("log-a", "log-b"):
        write_log(tmp_path / name)
    (tmp_path / "log-a" / "sensors" / "cameras" / "front").mkdir(parents=True)
    reader = AV2Reader(tmp_path)
    blocks = {start: reader.block(ClipRef("av2", "log-a", start)) for start in (0, 9900, 10_000)}
    assert blocks == {0: "log-a@0s", 9900: "log-a@0s", 10_000: "log-a@10s"}
    assert reader.block(ClipRef("av2", "log-b", 0)) is None and reader.block(ClipRef("av2", "gone", 0)) is None
