"""What 123D packs into its tables, or leaves in a data set's own files: photos and sweeps are read as it reads them."""

import base64
import logging
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.py123d.reader import Py123dReader
from factory.readers.base import BadClip
from factory.stages.sensors import load_sweeps, opened_photos
from tasks.world.clip import Clip
from tests.factory.datasets.av2.test_av2 import START_NS, write_log
from tests.factory.datasets.py123d.py123d_logs import convert, write_camera, write_lidar
from tests.factory.datasets.py123d.test_py123d import NUPLAN, WAYMO

NUSCENES = replace(NUPLAN, dataset="nuscenes", split="nuscenes_val", labels="NuScenesBoxDetectionLabel")
NUSCENES = replace(NUSCENES, label_of={"REGULAR_VEHICLE": 0, "CONSTRUCTION_CONE": 17})
STAMPS_US = [START_NS // 1000 + 100_000 * k for k in range(116)]
CUBE = np.array([[x, y, z] for x in (-20.0, 30.25) for y in (-3.5, 4.0) for z in (0.0, 1.75)], np.float32)
# CUBE by encode_point_cloud_as_laz_binary of py123d 0.7.0, with a column of intensities beside it.
LAZ = zlib.decompress(
    base64.b85decode(
        "c-r%E40dC{0vK8RLp)rA7;uA}#NvWV1tUFkJp-)rzKpNf%Ng%7F)#oTL$fkYgQ`W=xj(FGu}7yF@Bs%q2MELD0E8BR@_C^AKX~<XFbp*C0S0`0"
        "a6xJ^l+VI&fWft*q$p9rsj?)sSRp7iIlm|cBU;!}L2BYN^GZ_liZe?p8HN@BCYq|u0)^DP<ouLWpzrpCSutdkloVL$>qDgU@{7{Z^nj8N6BC3TaF~J"
        "NKN?_RU}F#gs$vJmDiaX1fpstfNo!_^E`uNc|1bLY|36-*@t>SqFk72<&sK>)`eIDaV?||lOBu{Q^F1=EYXwJd>HQFigVn9~9kuFN;?jzz!{P&ot&"
        "4#K0Cp>5G5"
    )
)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("source") / "train" / "log-a")


def picture(k: int) -> NDArray[np.uint8]:
    """(36, 64, 3) rgb, smooth, each another."""
    coarse = np.random.default_rng(k).integers(0, 255, (4, 6, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (64, 36), interpolation=cv2.INTER_LINEAR), np.uint8)


def encoded(suffix: str) -> list[bytes]:
    return [cv2.imencode(suffix, picture(k)[..., ::-1])[1].tobytes() for k in range(len(STAMPS_US))]


def filmed(log: Path) -> list[int]:
    """A video of all of them beside the table, as 123D makes it."""
    video = cv2.VideoWriter(str(log / "camera.pcam_0.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 36))
    for k in range(len(STAMPS_US)):
        video.write(picture(k)[..., ::-1])
    video.release()
    return list(range(len(STAMPS_US)))


def stream(points: NDArray[np.float32], codec: str | None, columns: str = "xyz") -> bytes:
    batch = pa.RecordBatch.from_pydict({**dict(zip(columns, points.T)), "intensity": np.zeros(len(points), np.uint8)})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema, options=pa.ipc.IpcWriteOptions(compression=codec)) as writer:
        writer.write_batch(batch)
    return sink.getvalue().to_pybytes()


def read(log: Path, sensor_root: Path | None = None) -> Clip:
    """Its second window."""
    reader = Py123dReader(log, sensor_root=sensor_root)
    return reader.read(reader.index().refs[1])


@pytest.mark.parametrize(("packed", "off"), [(".jpg", 2.0), (".png", 0.0), ("video", 6.0)])
def test_packed_photos_are_read_without_the_data_set(source: Path, tmp_path: Path, packed: str, off: float) -> None:
    log = convert(source, tmp_path, WAYMO)
    write_camera(log, 0, STAMPS_US, filmed(log) if packed == "video" else encoded(packed))
    clip = read(log)
    assert len(clip.images) == 96 and clip.block is not None and len(clip.block.images) == 116
    opened = dict(opened_photos(clip.images, clip.cameras))
    assert len(opened) == 96
    for row, image in opened.items():
        k = round((clip.start_s + clip.images[row].time_s) * 10)
        assert np.abs(image.astype(int) - picture(k)).mean() <= off < np.abs(image.astype(int) - picture(k + 1)).mean()
    assert Py123dReader(log).block(Py123dReader(log).index().refs[0]) == "log-a@0s"


@pytest.mark.parametrize("codec", ["zstd", "lz4", None, "laz"])
def test_packed_sweeps_are_in_the_imu_s_frame_and_put_into_the_ego_s(
    source: Path, tmp_path: Path, codec: str | None
) -> None:
    if codec == "laz":
        pytest.importorskip("lazrs")
    mount = (-1.2, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0)  # of the rear axle
    log = convert(source, tmp_path, replace(WAYMO, imu_to_rear=mount))
    write_camera(log, 0, STAMPS_US, encoded(".jpg"))
    write_lidar(log, STAMPS_US, [LAZ if codec == "laz" else stream(CUBE, codec) for _ in STAMPS_US])
    clip = read(log)
    assert clip.block is not None and len(clip.block.sweeps) == 116
    for sweep in load_sweeps(clip.sweeps):
        assert np.allclose(sweep.points, CUBE + np.array([1.2, 0.0, -0.5]), atol=1e-5)
    assert np.allclose(clip.sweeps[7].world_from_ego, clip.world_from_ego[7], atol=1e-9)


def test_a_row_without_a_sweep_is_none(source: Path, tmp_path: Path) -> None:
    log = convert(source, tmp_path, WAYMO)
    write_lidar(log, STAMPS_US, [stream(CUBE, None), *[None] * (len(STAMPS_US) - 1)])
    reader = Py123dReader(log)
    clip = reader.read(reader.index().refs[0])
    assert [sweep.time_s for sweep in clip.sweeps] == [0.0] and clip.block is None


def test_nuscenes_own_sweeps_are_in_the_lidar_s_frame_at_their_end(source: Path, tmp_path: Path) -> None:
    log = convert(source, tmp_path, NUSCENES)
    np.column_stack([CUBE, np.zeros((8, 2))]).astype("<f4").tofile(tmp_path / "a.pcd.bin")
    write_lidar(log, [stamp - 50_000 for stamp in STAMPS_US], ["a.pcd.bin"] * len(STAMPS_US), 50_000)
    clip = read(log, tmp_path)
    (first, *_) = load_sweeps(clip.sweeps)
    assert len(clip.sweeps) == 96 and first.time_s == 0.0
    assert np.allclose(first.points, CUBE + np.array([0.9, 0.0, 1.8]), atol=1e-6)
    assert read(log).sweeps == ()


def test_argoverse_s_own_sweeps_are_those_of_its_reader(tmp_path: Path) -> None:
    log = write_log(tmp_path / "av2" / "train" / "log-a")
    (log / "sensors" / "lidar").mkdir(parents=True)
    names = [f"train/log-a/sensors/lidar/{stamp * 1000}.feather" for stamp in STAMPS_US]
    for name in names:
        pa.feather.write_feather(pa.table(dict(zip("xyz", CUBE.T))), str(tmp_path / "av2" / name))
    folder = convert(log, tmp_path / "out")
    write_lidar(folder, STAMPS_US, names)
    native, through = AV2Reader(log), read(folder, tmp_path / "av2")
    mine = native.read(native.index().refs[1])
    assert [(s.uri, s.time_s) for s in mine.sweeps] == [(s.uri, s.time_s) for s in through.sweeps]
    for one, two in zip(load_sweeps(mine.sweeps), load_sweeps(through.sweeps), strict=True):
        assert np.allclose(one.world_from_ego, two.world_from_ego, rtol=0, atol=1e-9)
        assert np.array_equal(one.points, two.points)


def laz_with(*changed: tuple[int, int]) -> bytes:
    data = bytearray(LAZ)
    for at, value in changed:
        data[at] = value
    return bytes(data)


BROKEN: dict[str, tuple[bytes, str]] = {
    "Draco": (b"DRACO\x02\x03", "packed as Draco, LAZ and Arrow are read: convert again with dataset.log_writer"),
    "something": (b"hello world", "packed as bytes that begin with b'hello', LAZ"),
    "nothing": (b"", "packed as bytes that begin with b''"),
    "a cut stream": (stream(CUBE, "zstd")[:200], "cannot be unpacked, truncated?"),
    "no x": (stream(CUBE, "zstd", "abc"), "cannot be unpacked"),
    "no points": (stream(CUBE[:0], None), "holds no points"),
    "points of nothing": (stream(CUBE * np.float32("nan"), None), "holds NaN"),
    "LAZ that is cut": (LAZ[:-30], "cannot be unpacked, truncated?"),
    "LAZ without a header": (LAZ[:90], "cannot be unpacked, truncated?"),
    "LAZ of too many points": (laz_with((253, 1)), "cannot be unpacked, truncated? 281474976710664 points of"),
    "LAZ of too many settings": (laz_with((103, 255)), "records of settings"),
    "LAZ without settings": (laz_with((100, 0)), "LASzip's settings are missing"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_sweep_that_cannot_be_unpacked_is_named(source: Path, tmp_path: Path, fault: str) -> None:
    data, message = BROKEN[fault]
    if fault.startswith("LAZ"):
        pytest.importorskip("lazrs")
    log = convert(source, tmp_path, WAYMO)
    table = write_lidar(log, STAMPS_US, [data] * len(STAMPS_US))
    with pytest.raises(BadClip) as error:
        load_sweeps(read(log).sweeps)
    assert str(error.value).startswith(f"{table}#frame=10: ") and message in str(error.value)


def test_laz_says_what_is_to_be_installed(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "lazrs", None)
    log = convert(source, tmp_path, WAYMO)
    write_lidar(log, STAMPS_US, [LAZ] * len(STAMPS_US))
    with pytest.raises(BadClip, match=r"packed as LAZ: pip install 'driving-data-factory\[py123d\]', or convert again"):
        load_sweeps(read(log).sweeps)


def test_a_packed_photo_that_is_none_is_named(source: Path, tmp_path: Path) -> None:
    log = convert(source, tmp_path, WAYMO)
    table = write_camera(log, 0, STAMPS_US, [b"no picture"] * len(STAMPS_US))
    clip = read(log)
    with pytest.raises(BadClip) as error:
        list(opened_photos(clip.images, clip.cameras))
    assert str(error.value).startswith(f"{table}#frame=10: ")


def test_a_fisheye_is_left_out_and_told(source: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = convert(source, tmp_path, WAYMO)
    write_camera(log, 0, STAMPS_US, encoded(".jpg"), camera_model="ftheta")
    with caplog.at_level(logging.WARNING):
        assert read(log).cameras == ()
    assert f"{log}: left out, only pinhole cameras are read: camera.pcam_0 (ftheta)" in caplog.text


CAMERA = {
    "timestamp_us": "int64",
    "camera_to_global_se3": "fixed_size_list<item: double>[7]",
    "exposure_factor": "float",
}
LIDAR = {"timestamp_us": "int64", "end_timestamp_us": "int64"}
OF_LIDAR = {"lidar_name", "lidar_id", "lidar_to_imu_se3", "segmentation_label_class"}
OF_CAMERA = {"camera_model", "camera_name", "camera_id", "intrinsics", "distortion", "width", "height"}
OF_CAMERA |= {"camera_to_imu_se3", "is_undistorted"}
WRITTEN: dict[str, tuple[Callable[[Path], Path], dict[str, str]]] = {
    "camera, path": (lambda log: write_camera(log, 0, [0], ["a.jpg"]), CAMERA | {"data": "string"}),
    "camera, jpeg_binary": (lambda log: write_camera(log, 0, [0], [b"a"]), CAMERA | {"data": "binary"}),
    "camera, mp4": (lambda log: write_camera(log, 0, [0], [0]), CAMERA | {"data": "int32"}),
    "lidar, path": (lambda log: write_lidar(log, [0], ["a.bin"]), LIDAR | {"data": "string", "kwargs": "string"}),
    "lidar, binary": (lambda log: write_lidar(log, [0], [b"a"]), LIDAR | {"data": "binary"}),
}


@pytest.mark.parametrize("kind", WRITTEN)
def test_the_tables_of_these_tests_are_those_of_123d_s_writer(tmp_path: Path, kind: str) -> None:
    """Columns, types and metadata as ArrowLogWriter of py123d 0.7.0 wrote them, printed from its files."""
    write_table, columns = WRITTEN[kind]
    path = write_table(tmp_path)
    with pa.OSFile(str(path)) as source:
        schema = pa.ipc.open_file(source).schema
    assert {field.name.removeprefix(f"{path.stem}."): str(field.type) for field in schema} == columns
    told: dict[str, Any] = msgpack.unpackb(schema.metadata[b"metadata"])
    assert set(told) == OF_CAMERA if "camera" in kind else set(told["2"]) == OF_LIDAR


def test_a_motion_log_of_20_s_is_read_and_one_of_9_s_is_too_short(tmp_path: Path) -> None:
    made = replace(WAYMO, dataset="wod-motion", split="wod-motion-20s_train", labels="WODMotionBoxDetectionLabel")
    counts: Sequence[int] = [
        len(Py123dReader(convert(write_log(tmp_path / f"{s}" / "log-a", s), tmp_path / f"out-{s}", made)).index().refs)
        for s in (20.0, 9.0)
    ]
    assert counts == [11, 0]
