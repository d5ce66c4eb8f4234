"""Broken and foreign files of 123D: each names its file, what is wrong and how to mend it, and hurts no other log."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from factory.datasets.py123d.arrow import WITHOUT_LANES
from factory.datasets.py123d.reader import Py123dReader
from factory.readers.base import BadClip, ClipRef
from tests.factory.datasets.av2.test_av2 import write_log
from tests.factory.datasets.py123d.py123d_logs import Made, convert, fixed, rewrite, write, write_camera
from tests.factory.datasets.py123d.test_py123d import NUPLAN

EGO, BOXES, MAP = "ego_state_se3.arrow", "box_detections_se3.arrow", "map.arrow"
LIGHTS, CAMERA = "traffic_light_detections.arrow", "camera.pcam_0.arrow"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("source") / "log-a")


def column(name: str, change: Callable[[list[Any]], object]) -> Callable[[Path], None]:
    """A column of a file with its values changed in place."""

    def edit(log: Path) -> None:
        file, _, field = name.partition(":")
        path = log / file
        with pa.OSFile(str(path)) as stream:
            table = pa.ipc.open_file(stream).read_all()
        full = field if field in table.column_names else f"{path.stem}.{field}"
        values = table[full].to_pylist()
        change(values)
        rewrite(path, {full: pa.array(values, table[full].type)})

    return edit


def set_first(value: object) -> Callable[[list[Any]], object]:
    return lambda values: values.__setitem__(0, value)


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


def told(name: str, **metadata: Any) -> Callable[[Path], None]:
    return lambda log: rewrite(log / name, **metadata)


def lights(log: Path, status: int, lanes: int = 1, lane_id: int = 2) -> None:
    key = "traffic_light_detections"
    columns = {
        f"{key}.timestamp_us": pa.array([0]),
        f"{key}.lane_id": pa.array([[lane_id] * lanes], pa.list_(pa.int32())),
        f"{key}.status": pa.array([[status]], pa.list_(pa.uint8())),
    }
    write(log / LIGHTS, columns, {})


def camera(log: Path, data: str = "a.jpg", **changes: Any) -> None:
    write_camera(log, 0, [0], [data], **changes)


WHEN_LISTED = {  # what the choice of windows meets
    "truncated poses": (lambda log: cut_short(log / EGO), f"{EGO}: file: cannot be read as an Arrow file, truncated"),
    "truncated boxes": (lambda log: cut_short(log / BOXES), f"{BOXES}: file: cannot be read"),
    "empty header": (lambda log: (log / "sync.arrow").write_bytes(b""), "sync.arrow: file: cannot be read"),
    "newer": (told("sync.arrow", version="0.8.1"), "written by py123d 0.8.1, 0.6 and 0.7 are read"),
    "no version": (told("sync.arrow", version=None), "sync.arrow: metadata.version: is None"),
    "another data set": (told("sync.arrow", dataset="mine"), "'mine' is not read; av2-sensor, nuplan"),
    "no map file": (lambda log: (log / MAP).unlink(), "log-a: map: missing, looked for "),
    "no rows": (
        lambda log: rewrite(
            log / EGO,
            {
                "ego_state_se3.timestamp_us": pa.array([], pa.int64()),
                "ego_state_se3.imu_se3": fixed(np.zeros((0, 7))),
                "ego_state_se3.dynamic_state_se3": None,
            },
        ),
        f"{EGO}: timestamp_us: holds no rows",
    ),
    "missing column": (
        lambda log: rewrite(log / EGO, {"ego_state_se3.imu_se3": None}),
        f"{EGO}: ego_state_se3.imu_se3: column is missing",
    ),
    "a pose is null": (column(f"{EGO}:imu_se3", set_first(None)), "imu_se3: holds nulls"),
    "no mount": (told(EGO, rear_axle_to_imu_se3=None), f"{EGO}: metadata.rear_axle_to_imu_se3"),
    "poses of six numbers": (
        lambda log: rewrite(log / EGO, {"ego_state_se3.imu_se3": fixed(np.zeros((len(stamps(log)), 6)))}),
        "expected lists of 7 numbers",
    ),
    "unknown labels": (told(BOXES, box_detection_label_class="mine.Label"), "unknown labels Label; known: AV2Sensor"),
    "most poses NaN": (
        column(f"{EGO}:imu_se3", lambda values: values.__setitem__(slice(0, 700), [[float("nan")] * 7] * 700)),
        f"{EGO}: qw qx qy qz tx_m ty_m tz_m: most of ",
    ),
    "most labels beyond": (
        column(f"{BOXES}:label", lambda values: values.__setitem__(slice(0, 70), [[99, 99]] * 70)),
        "label: most are none of AV2SensorBoxDetectionLabel, which ends at 29",
    ),
    "labels of no box": (column(f"{BOXES}:label", set_first([18])), "track_token label: not one of each"),
    "no boxes": (
        lambda log: [
            column(f"{BOXES}:{name}", lambda values: values.__setitem__(slice(None), [[] for _ in values]))(log)
            for name in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points")
        ],
        "no box in any frame",
    ),
    "no metadata": (
        lambda log: (log / BOXES).write_bytes(bare(log / EGO)),
        f"{BOXES}: metadata: missing from the schema",
    ),
}


def set_one(number: int, change: Callable[[Any], Any]) -> Callable[[list[Any]], object]:
    return lambda values: values.__setitem__(number, change(values[number]))


def first_box(*changed: tuple[int, float]) -> Callable[[list[Any]], list[Any]]:
    """Values of a frame's first box, the car's, by their place."""

    def change(boxes: list[Any]) -> list[Any]:
        values = list(boxes[0])
        for i, value in changed:
            values[i] = value
        return [values, *boxes[1:]]

    return change


def swap_two(values: list[Any]) -> None:
    values[30], values[31], values[300:302] = values[31], values[30], values[300:302][::-1]


# what is wrong -> what is changed, and (pass, thing, time or None) of what is told; pose 300 and frame 30 are at 3.0 s
REPAIRED = {
    "a pose is NaN": (
        column(f"{EGO}:imu_se3", set_one(300, lambda _: [float("nan")] * 7)),
        [("impossible", "ego", 3.0)],
    ),
    "no rotation": (column(f"{EGO}:imu_se3", set_one(300, lambda _: [0.0] * 7)), [("impossible", "ego", 3.0)]),
    "a pose elsewhere": (
        column(f"{EGO}:imu_se3", set_one(300, lambda pose: [pose[0] + 50.0, *pose[1:]])),
        [("jump", "ego", 3.0)],
    ),
    "label beyond": (
        column(f"{BOXES}:label", set_one(30, lambda _: [99, 99])),
        [("class", "car", 3.0), ("class", "cone", 3.0)],
    ),
    "a label is null": (column(f"{BOXES}:label", set_one(30, lambda v: [None, v[1]])), [("class", "car", 3.0)]),
    "a track without a token": (
        column(f"{BOXES}:track_token", set_one(30, lambda _: ["", "cone"])),
        [("token", "box 60", 3.0), ("gap", "car", 3.0)],
    ),
    "twice in a frame": (
        column(f"{BOXES}:track_token", set_one(30, lambda _: ["car", "car"])),
        [("twice", "car", 3.0), ("gap", "cone", 3.0)],
    ),
    "a box is NaN": (
        column(f"{BOXES}:bounding_box_se3", set_one(30, first_box((0, float("nan"))))),
        [("impossible", "car", 3.0), ("gap", "car", 3.0)],
    ),
    "a box without height": (
        column(f"{BOXES}:bounding_box_se3", set_one(30, first_box((9, -1.0)))),
        [("impossible", "car", 3.0), ("gap", "car", 3.0)],
    ),
    "a box elsewhere": (
        column(f"{BOXES}:bounding_box_se3", set_one(30, first_box((1, 0.0)))),
        [("jump", "car", 3.0), ("gap", "car", 3.0)],
    ),
    "poses in another order": (
        lambda log: [column(f"{EGO}:{name}", swap_two)(log) for name in ("timestamp_us", "imu_se3")],
        [("clock", "ego", 0.3)],
    ),
    "a pose of long ago": (column(f"{EGO}:timestamp_us", set_one(300, lambda _: 0)), [("clock", "ego", None)]),
    "frames in another order": (
        lambda log: [
            column(f"{BOXES}:{name}", swap_two)(log)
            for name in ("timestamp_us", "bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points")
        ],
        [],
    ),
    "a frame of long ago": (
        column(f"{BOXES}:timestamp_us", set_one(30, lambda _: 0)),
        [("gap", "", 2.9), ("clock", "", None)],
    ),
    "a frame of the far future": (
        column(f"{BOXES}:timestamp_us", set_one(30, lambda stamp: stamp + 10**13)),
        [("gap", "", 2.9), ("clock", "", None)],
    ),
}


@pytest.mark.parametrize("fault", REPAIRED)
def test_a_fault_of_one_thing_is_put_right_or_left_out_and_told_and_nothing_else_changes(
    source: Path, tmp_path: Path, fault: str
) -> None:
    """Everything drives straight here: between two frames it is where it was."""
    spoil, told = REPAIRED[fault]
    spoil(convert(source, tmp_path / "spoiled"))
    convert(source, tmp_path / "sound")
    reader, whole = (Py123dReader(tmp_path / name) for name in ("spoiled", "sound"))
    index = reader.index()
    assert index.refs == whole.index().refs and not index.dropped and not index.broken
    found, sound = reader.read(index.refs[1]), whole.read(index.refs[1])
    at = (None if np.isnan(r.time_s) else round(r.time_s, 9) for r in found.repairs)
    assert [(r.what, r.thing, t) for r, t in zip(found.repairs, at)] == told
    assert found.agents.track_ids == sound.agents.track_ids and found.agents.kinds == sound.agents.kinds
    assert np.array_equal(found.agents.valid, sound.agents.valid)
    np.testing.assert_allclose(found.agents.boxes, sound.agents.boxes, atol=1e-9)
    np.testing.assert_allclose(found.agents.velocities, sound.agents.velocities, atol=1e-9)
    np.testing.assert_allclose(found.ego_states, sound.ego_states, atol=1e-8)


def test_a_log_whose_first_pose_cannot_be_begins_a_step_later(source: Path, tmp_path: Path) -> None:
    column(f"{EGO}:imu_se3", set_first([float("nan")] * 7))(convert(source, tmp_path))
    index = Py123dReader(tmp_path).index()
    assert [ref.start_ms for ref in index.refs] == [100, 1100, 2100] and not index.dropped


WHEN_READ = {  # what only a clip's own log meets
    "truncated map": (lambda log: cut_short(log / MAP), f"{MAP}: file: cannot be read"),
    "map of another version": (told(MAP, version="0.5.0"), f"{MAP}: metadata.version: written by py123d 0.5.0"),
    "shapes of nothing": (column(f"{MAP}:wkb", set_first(b"\x01\x02")), f"{MAP}: wkb"),
    "features that are code": (column(f"{MAP}:features", set_first(b"\x80\x04.")), "features of object 1 of layer 0"),
    "no map objects": (column(f"{MAP}:map_layer", lambda v: v.__setitem__(slice(None), [9] * len(v))), "no lane for"),
    "unknown light": (lambda log: lights(log, 7), f"{LIGHTS}: status: unknown status 7"),
    "lights without lanes": (lambda log: lights(log, 1, 2), f"{LIGHTS}: lane_id status"),
    "skewed camera": (lambda log: camera(log, intrinsics=[50.0, 50.0, 32.0, 18.0, 1.0]), "skew of 1.0"),
    "camera without a size": (lambda log: camera(log, width="wide"), f"{CAMERA}: metadata.width: is 'wide'"),
    "photo outside": (lambda log: camera(log, "../../etc/passwd"), "is no path under the sensor root"),
}


def stamps(log: Path) -> pa.Array:
    with pa.OSFile(str(log / EGO)) as stream:
        return pa.ipc.open_file(stream).read_all()["ego_state_se3.timestamp_us"]


def bare(path: Path) -> bytes:
    """The file without its metadata."""
    with pa.OSFile(str(path)) as stream:
        table = pa.ipc.open_file(stream).read_all().replace_schema_metadata(None)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue())


@pytest.mark.parametrize("fault", WHEN_LISTED)
def test_a_broken_log_is_named_and_hurts_no_other(source: Path, tmp_path: Path, fault: str) -> None:
    spoil, message = WHEN_LISTED[fault]
    spoil(convert(source, tmp_path))
    whole = source.parent / "log-b"
    if not whole.exists():
        write_log(whole)
    convert(whole, tmp_path)
    index = Py123dReader(tmp_path).index()
    assert {ref.log_id for ref in index.refs} == {"log-b"}
    (broken,) = index.broken.values()
    assert message in broken


@pytest.mark.parametrize("fault", WHEN_READ)
def test_a_broken_map_light_or_camera_is_named(source: Path, tmp_path: Path, fault: str) -> None:
    spoil, message = WHEN_READ[fault]
    log = convert(source, tmp_path)
    spoil(log)
    reader = Py123dReader(log, sensor_root=tmp_path)
    with pytest.raises(BadClip) as error:
        reader.read(reader.index().refs[0])
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda log: (log / EGO).unlink(), f"no {EGO}"),
        (lambda log: (log / BOXES).unlink(), f"no {BOXES}"),
        *((told("sync.arrow", dataset=name), f"of {name}, and drives need lanes: ") for name in WITHOUT_LANES),
    ],
)
def test_a_log_that_lacks_something_is_skipped_and_says_what(
    source: Path, tmp_path: Path, change: Callable[[Path], object], reason: str
) -> None:
    change(convert(source, tmp_path))
    index = Py123dReader(tmp_path).index()
    assert not index.refs
    assert reason in index.skipped_logs["log-a"]


def test_frames_too_far_apart_for_10_hz_are_refused(source: Path, tmp_path: Path) -> None:
    convert(source, tmp_path, Made(every=10))
    (broken,) = Py123dReader(tmp_path).index().broken.values()
    assert "frames 1.00 s apart; over 0.55 s is too few for 10 Hz" in broken


def test_a_folder_that_is_none_of_123d_s_is_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no log of 123D here"):
        Py123dReader(source.parent).index()
    with pytest.raises(ValueError, match="no such folder"):
        Py123dReader(tmp_path / "gone").index()
    with pytest.raises(ValueError, match=r"clips\.sensor_root=.*no such folder"):
        Py123dReader(tmp_path, sensor_root=tmp_path / "gone")
    with pytest.raises(BadClip, match="no log gone"):
        Py123dReader(convert(source, tmp_path)).read(ClipRef("py123d", "gone", 0))


def test_one_name_in_two_splits_is_refused_by_name(source: Path, tmp_path: Path) -> None:
    for split in ("av2-sensor_train", "av2-sensor_val"):
        convert(source, tmp_path, Made(split=split))
    with pytest.raises(ValueError, match=r"log-a stands twice, .*/av2-sensor_train/log-a and .*/av2-sensor_val/log-a"):
        Py123dReader(tmp_path).index()
    reader = Py123dReader(tmp_path / "logs" / "av2-sensor_val")
    assert reader.read(reader.index().refs[0]).split == "val"


def test_a_city_s_map_is_found_beside_the_logs_or_where_it_is_said_to_be(source: Path, tmp_path: Path) -> None:
    made = replace(NUPLAN, dataset="nuscenes", label_of={"REGULAR_VEHICLE": 0, "CONSTRUCTION_CONE": 17})
    convert(source, tmp_path, replace(made, labels="NuScenesBoxDetectionLabel"))
    assert Py123dReader(tmp_path / "logs" / "nuplan_val" / "log-a").index().refs
    (tmp_path / "maps").rename(tmp_path / "elsewhere")
    (broken,) = Py123dReader(tmp_path).index().broken.values()
    assert "maps/nuscenes/nuscenes_us-ma-boston.arrow: convert it too, or give clips.maps_root" in broken
    reader = Py123dReader(tmp_path, maps_root=tmp_path / "elsewhere")
    assert reader.read(reader.index().refs[0]).road_map.location == "us-ma-boston"
