"""Broken Argoverse 2 logs: each is repaired, or names its file and field, and hurts no other log."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from factory.datasets.av2.reader import AV2Reader, read_log
from factory.readers.base import BadClip, ClipRef
from tests.factory.datasets.av2.test_av2 import START_NS, edit, edit_map, the_map, write_log, write_table


def set_value(column: str, row: int, value: object, **others: object) -> Callable[[dict[str, list]], None]:
    """others: of further columns of the row."""

    def change(columns: dict[str, list]) -> None:
        for name, here in {column: value, **others}.items():
            columns[name][row] = here

    return change


def moved_by_30_m(columns: dict[str, list]) -> None:
    columns["tx_m"][50] += 30.0


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


def last_later(by_s: int) -> Callable[[dict[str, list]], None]:
    def change(columns: dict[str, list]) -> None:
        last = max(columns["timestamp_ns"])
        columns["timestamp_ns"] = [stamp + by_s * 10**9 * (stamp == last) for stamp in columns["timestamp_ns"]]

    return change


def two_days(columns: dict[str, list]) -> None:
    first = min(columns["timestamp_ns"])
    last_later(80_000)(columns)
    columns["timestamp_ns"] = [stamp - 80_000 * 10**9 * (stamp == first) for stamp in columns["timestamp_ns"]]


POSES, BOXES = "city_SE3_egovehicle.feather", "annotations.feather"
BROKEN = {
    "missing poses": (lambda log: (log / "city_SE3_egovehicle.feather").unlink(), "city_SE3_egovehicle.feather: file"),
    "truncated feather": (lambda log: cut_short(log / "annotations.feather"), "annotations.feather: file"),
    "most poses NaN": (
        lambda log: edit(
            log / "city_SE3_egovehicle.feather",
            lambda table: table.update(tx_m=[float("nan")] * 700 + table["tx_m"][700:]),
        ),
        "city_SE3_egovehicle.feather: qw qx qy qz tx_m ty_m tz_m: most of 1220 poses are NaN",
    ),
    "mostly unknown classes": (
        lambda log: edit(log / "annotations.feather", lambda table: table.update(category=["DRAGON"] * 234)),
        "annotations.feather: category: unknown class ['DRAGON']",
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
    "stamps of two days": (lambda log: [edit(log / name, two_days) for name in (BOXES, POSES)], "timestamps: a log of"),
    "empty map": (lambda log: edit_map(log, lambda content: content["lane_segments"].clear()), "lane_segments"),
    "bicycle lanes only": (
        lambda log: edit_map(
            log, lambda content: [x.update(lane_type="BIKE") for x in content["lane_segments"].values()]
        ),
        "lane_segments: the map has no VEHICLE or BUS lane",
    ),
    "lanes of no point": (
        lambda log: edit_map(
            log, lambda content: [x.update(left_lane_boundary=[]) for x in content["lane_segments"].values()]
        ),
        "no VEHICLE or BUS lane; left out: 1 (no point in its left boundary)",
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


def swap(columns: dict[str, list]) -> None:
    for values in columns.values():
        values[300], values[301] = values[301], values[300]


def beside_it(columns: dict[str, list]) -> None:
    """The car a second time, by another name and 10 cm farther on."""
    for name, values in columns.items():
        again = values[:117]
        values += ["double"] * 117 if name == "track_uuid" else [x + 0.1 for x in again] if name == "tx_m" else again


def the_ego(columns: dict[str, list]) -> None:
    for name, values in columns.items():
        again = values[:117]
        values += ["me"] * 117 if name == "track_uuid" else [1.4] * 117 if name == "tx_m" else again


# what is wrong -> its file, what is changed there, and (pass, thing, time, None: of the whole log) of what is told
REPAIRED = {
    "NaN pose": (POSES, set_value("tx_m", 7, float("nan")), [("impossible", "ego", 0.07)]),
    "NaN pose at a frame": (POSES, set_value("tx_m", 300, float("nan")), [("impossible", "ego", 3.0)]),
    "pose elsewhere": (POSES, set_value("ty_m", 300, 9000.0), [("jump", "ego", 3.0)]),
    "pose that is null": (POSES, set_value("tz_m", 300, None), [("impossible", "ego", 3.0)]),
    "time runs backwards": (POSES, set_value("timestamp_ns", 9, START_NS), [("clock", "ego", 0.0)]),
    "poses in another order": (POSES, swap, [("clock", "ego", 3.0)]),
    "a pose of long ago": (POSES, set_value("timestamp_ns", 300, 0), [("clock", "ego", None)]),
    "no rotation": (POSES, set_value("qw", 3, 0.0), [("impossible", "ego", 0.03)]),
    "no rotation at a frame": (POSES, set_value("qw", 500, 0.0), [("impossible", "ego", 5.0)]),
    "unknown class": (BOXES, set_value("category", 5, "DRAGON"), [("class", "car", 0.5)]),
    "no class": (BOXES, set_value("category", 5, None), [("class", "car", 0.5)]),
    "track twice in a frame": (BOXES, repeat_a_row, [("twice", "car", 0.3)]),
    "a track without a name": (BOXES, set_value("track_uuid", 5, " "), [("token", "box 5", 0.5), ("gap", "car", 0.5)]),
    "a track whose name is null": (
        BOXES,
        set_value("track_uuid", 5, None),
        [("token", "box 5", 0.5), ("gap", "car", 0.5)],
    ),
    "flat box": (BOXES, set_value("width_m", 5, 0.0), [("impossible", "car", 0.5), ("gap", "car", 0.5)]),
    "box at infinity": (BOXES, set_value("tx_m", 5, -float("inf")), [("impossible", "car", 0.5), ("gap", "car", 0.5)]),
    "box without rotation": (BOXES, set_value("qw", 5, 0.0), [("impossible", "car", 0.5), ("gap", "car", 0.5)]),
    "box turned round": (BOXES, set_value("qw", 5, 0.0, qz=1.0), [("heading", "car", 0.5)]),
    "box elsewhere": (BOXES, moved_by_30_m, [("jump", "car", 5.0), ("gap", "car", 5.0)]),
    "car listed twice": (BOXES, beside_it, [("twice", "double", 0.0)]),
    "ego among the boxes": (BOXES, the_ego, [("ego", "me", 0.0)]),
}


# what is wrong -> its file, what is changed there, windows that are left of three, what is told
OUTSIDE = {
    "poses end early": (
        POSES,
        lambda columns: [column.__delitem__(slice(1100, None)) for column in columns.values()],
        2,
        "6 frames at which the ego has no pose",
    ),
    "a box of long ago": (BOXES, set_value("timestamp_ns", 5, 0), 3, "1 frames at which the ego has no pose"),
    "a frame of years later": (BOXES, last_later(10**8), 3, "1 frames at which the ego has no pose"),
    "a pose of years later": (POSES, last_later(10**8), 3, "1 poses stamped over a day from the others"),
}


@pytest.mark.parametrize("fault", OUTSIDE)
def test_what_is_stamped_outside_the_drive_is_left_out_and_told_and_costs_no_other_window(
    tmp_path: Path, fault: str
) -> None:
    file, change, left, told = OUTSIDE[fault]
    edit(write_log(tmp_path / "spoiled" / "log") / file, change)
    write_log(tmp_path / "sound" / "log")
    reader, whole = (AV2Reader(tmp_path / name) for name in ("spoiled", "sound"))
    index = reader.index()
    assert index.refs == whole.index().refs[:left] and not index.broken and not index.dropped
    for ref in index.refs:
        found, sound = reader.read(ref), whole.read(ref)
        assert told in {repair.was for repair in found.repairs}
        assert found.agents.track_ids == sound.agents.track_ids
        np.testing.assert_array_equal(found.ego_states, sound.ego_states)
        here = found.agents.valid
        assert (~here).sum() == (fault == "a box of long ago" and ref.start_ms == 0)
        np.testing.assert_array_equal(found.agents.boxes[here], sound.agents.boxes[here])


@pytest.mark.parametrize("fault", REPAIRED)
def test_a_fault_of_one_thing_is_put_right_or_left_out_and_told_and_nothing_else_changes(
    tmp_path: Path, fault: str
) -> None:
    """Everything drives straight here: between two frames it is where it was."""
    file, change, told = REPAIRED[fault]
    spoiled = write_log(tmp_path / "spoiled" / "log")
    edit(spoiled / file, change)
    found, sound = read_log(spoiled), read_log(write_log(tmp_path / "sound" / "log"))
    at = (None if np.isnan(r.time_s) else round(r.time_s, 9) for r in found.repairs)
    assert [(r.what, r.thing, t) for r, t in zip(found.repairs, at)] == told
    assert found.agents.track_ids == sound.agents.track_ids
    assert found.agents.kinds == sound.agents.kinds
    assert found.agents.valid.all()
    np.testing.assert_allclose(found.agents.boxes, sound.agents.boxes, atol=1e-9)
    np.testing.assert_allclose(found.agents.velocities, sound.agents.velocities, atol=1e-9)
    np.testing.assert_allclose(found.ego_states, sound.ego_states, atol=1e-9)
    reader, whole = AV2Reader(spoiled), AV2Reader(tmp_path / "sound")
    index = reader.index()
    assert index.refs == whole.index().refs and not index.dropped and not index.broken
    clip = reader.read(index.refs[0])
    assert clip.repairs == found.repairs
    np.testing.assert_allclose(clip.world_from_ego, whole.read(index.refs[0]).world_from_ego, atol=1e-9)


def test_a_log_whose_first_pose_cannot_be_begins_a_step_later(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log")
    edit(log / POSES, set_value("tx_m", 0, float("nan")))
    index = AV2Reader(log).index()
    assert [ref.start_ms for ref in index.refs] == [100, 1100, 2100] and not index.dropped
