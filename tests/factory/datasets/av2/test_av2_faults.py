"""Broken Argoverse 2 logs: each names its file and field, and hurts no other log."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.readers.base import BadClip, ClipRef
from tests.factory.datasets.av2.test_av2 import START_NS, edit, edit_map, the_map, write_log, write_table


def set_value(column: str, row: int, value: object) -> Callable[[dict[str, list]], None]:
    def change(columns: dict[str, list]) -> None:
        columns[column][row] = value

    return change


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def repeat_a_row(columns: dict[str, list]) -> None:
    for values in columns.values():
        values.append(values[3])


def move(lanes: Iterable[dict]) -> None:
    for lane in lanes:
        for point in lane["left_lane_boundary"] + lane["right_lane_boundary"]:
            point["y"] += 5000.0


def stretch(lanes: Iterable[dict], to: float = 4e7) -> None:
    for lane in lanes:
        lane["left_lane_boundary"][-1]["x"] = to


def years_later(columns: dict[str, list]) -> None:
    last = max(columns["timestamp_ns"])
    columns["timestamp_ns"] = [stamp + 10**17 * (stamp == last) for stamp in columns["timestamp_ns"]]


BROKEN = {
    "missing poses": (lambda log: (log / "city_SE3_egovehicle.feather").unlink(), "city_SE3_egovehicle.feather: file"),
    "truncated feather": (lambda log: cut_short(log / "annotations.feather"), "annotations.feather: file"),
    "NaN pose": (
        lambda log: edit(log / "city_SE3_egovehicle.feather", set_value("tx_m", 7, float("nan"))),
        "city_SE3_egovehicle.feather: tx_m",
    ),
    "time runs backwards": (
        lambda log: edit(log / "city_SE3_egovehicle.feather", set_value("timestamp_ns", 9, START_NS)),
        "city_SE3_egovehicle.feather: timestamp_ns",
    ),
    "poses end early": (
        lambda log: edit(
            log / "city_SE3_egovehicle.feather",
            lambda table: [column.__delitem__(slice(900, None)) for column in table.values()],
        ),
        "city_SE3_egovehicle.feather: timestamp_ns",
    ),
    "no rotation": (
        lambda log: edit(log / "city_SE3_egovehicle.feather", set_value("qw", 3, 0.0)),
        "city_SE3_egovehicle.feather: qw",
    ),
    "unknown class": (
        lambda log: edit(log / "annotations.feather", set_value("category", 5, "DRAGON")),
        "annotations.feather: category: unknown class ['DRAGON']",
    ),
    "track twice in a frame": (lambda log: edit(log / "annotations.feather", repeat_a_row), "track_uuid: track car"),
    "a track without a name": (
        lambda log: edit(log / "annotations.feather", set_value("track_uuid", 5, " ")),
        "annotations.feather: track_uuid: a box at ",
    ),
    "flat box": (
        lambda log: edit(log / "annotations.feather", set_value("width_m", 5, 0.0)),
        "annotations.feather: length_m width_m height_m",
    ),
    "missing column": (
        lambda log: edit(log / "annotations.feather", lambda table: table.pop("category")),
        "annotations.feather: category: column is missing",
    ),
    "text for numbers": (
        lambda log: edit(log / "annotations.feather", lambda table: table.update(tx_m=["x"] * len(table["tx_m"]))),
        "annotations.feather: tx_m: expected numbers",
    ),
    "no map": (lambda log: the_map(log).unlink(), "log_map_archive_*.json"),
    "truncated map": (lambda log: cut_short(the_map(log)), "json: cannot be read"),
    "a lane around the world": (  # at a point every 0.75 m fifty million
        lambda log: edit_map(log, lambda content: stretch(content["lane_segments"].values())),
        "lane_segments: the map has no VEHICLE or BUS lane; left out: 1 (2e+07 m long), 2 (",
    ),
    "a coordinate beyond floats": (
        lambda log: edit_map(log, lambda content: stretch(content["lane_segments"].values(), 10**400)),
        "left_lane_boundary: not a list of x, y, z points",
    ),
    "stamps of years": (
        lambda log: [edit(log / name, years_later) for name in ("annotations.feather", "city_SE3_egovehicle.feather")],
        "timestamps: a log of",
    ),
    "empty map": (lambda log: edit_map(log, lambda content: content["lane_segments"].clear()), "lane_segments"),
    "bicycle lanes only": (
        lambda log: edit_map(
            log, lambda content: [x.update(lane_type="BIKE") for x in content["lane_segments"].values()]
        ),
        "lane_segments: the map has no VEHICLE or BUS lane",
    ),
    "map of somewhere else": (
        lambda log: edit_map(log, lambda content: move(content["lane_segments"].values())),
        "lane_segments: the ego is never within",
    ),
    "lane without boundary": (
        lambda log: edit_map(log, lambda content: content["lane_segments"]["1"].pop("left_lane_boundary")),
        "lane_segments[1]",
    ),
    "unknown lane type": (
        lambda log: edit_map(log, lambda content: content["lane_segments"]["1"].update(lane_type="RIVER")),
        "lane_segments[1]: missing key or unknown lane type 'RIVER'",
    ),
    "unknown light": (
        lambda log: write_table(
            log / "traffic_lights.feather", {"timestamp_ns": [START_NS], "lane_id": [2], "state": ["BLUE"]}
        ),
        "traffic_lights.feather: state",
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_log_names_its_file_and_field_and_hurts_no_other(tmp_path: Path, fault: str) -> None:
    broken, sound = write_log(tmp_path / "log-a"), write_log(tmp_path / "log-b")
    assert sound.is_dir()
    harm, message = BROKEN[fault]
    harm(broken)
    reader = AV2Reader(tmp_path)
    with pytest.raises(BadClip) as caught:
        reader.read(ClipRef("av2", "log-a", 0))
    assert message in str(caught.value) and "log-a" in str(caught.value)
    assert pickle.loads(pickle.dumps(caught.value)).field == caught.value.field
    index = reader.index()
    assert [ref.start_ms for ref in index.refs if ref.log_id == "log-b"] == [0, 1000, 2000]
    named = [ref for ref in (*index.refs, *index.broken) if ref.log_id == "log-a"]
    assert named, "a broken log may be found when it is indexed or when it is read, but never vanishes"
    assert all(ref.start_ms == 0 for ref in index.broken)
    reader.read(ClipRef("av2", "log-b", 1000))
