"""Real logs turned into ones of another meaning: each is told by what gives it away, and as they are they are read."""

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow.feather import read_table, write_feather
from scipy.spatial.transform import Rotation

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip, ClipReader
from tests.writable import load_writable

BOXES, POSES = "annotations.feather", "city_SE3_egovehicle.feather"
MOUNTS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
TURN, PLACE = ["qx", "qy", "qz", "qw"], ["tx_m", "ty_m", "tz_m"]
Columns = dict[str, np.ndarray]
Table = Callable[[Columns], object]


def stacked(columns: Columns, names: list[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=1)


def put(columns: Columns, names: list[str], values: np.ndarray) -> None:
    columns.update(zip(names, values.T))


def divided(by: int) -> Table:
    return lambda columns: columns.update(timestamp_ns=columns["timestamp_ns"] // by)


def shifted(columns: Columns) -> None:
    put(columns, PLACE, stacked(columns, PLACE) - stacked(columns, PLACE)[0])


def in_millimetres(columns: Columns) -> None:
    put(columns, PLACE, 1000.0 * stacked(columns, PLACE))


def inverse_turn(columns: Columns) -> None:
    put(columns, TURN, Rotation.from_quat(stacked(columns, TURN)).inv().as_quat())


def inverse(columns: Columns) -> None:
    turn = Rotation.from_quat(stacked(columns, TURN)).inv()
    put(columns, PLACE, -turn.apply(stacked(columns, PLACE)))
    put(columns, TURN, turn.as_quat())


def axes_of_ego(columns: Columns) -> None:
    forward_left_up = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    put(columns, TURN, (Rotation.from_quat(stacked(columns, TURN)) * forward_left_up).as_quat())


AV2: dict[str, tuple[tuple[str, ...], Table, str]] = {
    "us": (
        (BOXES, POSES),
        divided(1000),
        r"annotations.feather: timestamp_ns: .*0.1 s if they were in us: expected ns",
    ),
    "ms": ((BOXES, POSES), divided(10**6), r"timestamp_ns: stamps are 1e-07 s apart, .* in ms: expected ns"),
    "s": ((BOXES, POSES), divided(10**9), r"timestamp_ns: .* in s: expected ns"),
    "poses in us": ((POSES,), divided(1000), r"city_SE3_egovehicle.feather: timestamp_ns: .* in us: expected ns"),
    "from the log's start": (
        (POSES,),
        shifted,
        r"lane_segments: .* is nowhere nearer than 5,531 m to a lane of the map",
    ),
    "poses in mm": ((POSES,), in_millimetres, r"ego drives at 3,906 m/s"),
    "ego from city": ((POSES,), inverse_turn, r"headings are \d+ deg off the direction of motion \(median of 129"),
    "mounts in mm": ((MOUNTS,), in_millimetres, r"cameras.ring_front_center: stands 1,635.0 m ahead.* in millimetres"),
    "sensor from ego": ((MOUNTS,), inverse, r"ring_front_center: .*90 deg off upright, its inverse would be right"),
    "axes of the ego": ((MOUNTS,), axes_of_ego, r"ring_front_center: looks at the sky, 90 deg"),
    "focal of width": (
        (INTRINSICS,),
        lambda columns: columns.update(fx_px=columns["fx_px"] / 1550, fy_px=columns["fy_px"] / 1550),
        "ring_front_center: a focal length of .* px in an image 1550 px wide sees 180 deg",
    ),
}


def refusal(reader: ClipReader) -> None:
    """What the index or the first clip is refused by. Raises BadClip."""
    index = reader.index()
    for ref, problem in index.broken.items():
        raise BadClip(ref.log_id, "index", problem)
    reader.read(index.refs[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", AV2)
def test_argoverse_of_another_meaning_is_told(shared_root: Path, tmp_path: Path, kind: str) -> None:
    names, change, said = AV2[kind]
    log = tmp_path / "log"
    source = next((shared_root / "data" / "av2" / "sensor").rglob("calibration")).parent
    shutil.copytree(source, log, ignore=shutil.ignore_patterns("sensors"))
    for name in names:
        columns = {key: np.array(values) for key, values in read_table(log / name).to_pydict().items()}
        change(columns)
        (log / name).chmod(0o644)
        write_feather(pa.table(columns), log / name)
    with pytest.raises(BadClip, match=said):
        refusal(AV2Reader(log))


Scenario = dict[str, Any]


def of_ego(change: Callable[[dict[str, Any]], object]) -> Callable[[Scenario], object]:
    return lambda scenario: change(scenario["tracks"][scenario["metadata"]["sdc_id"]]["state"])


def timed(factor: float) -> Callable[[Scenario], object]:
    return lambda scenario: scenario["metadata"].update(ts=factor * np.asarray(scenario["metadata"]["ts"]))


def placed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Scenario], object]:
    def changed(scenario: Scenario) -> None:
        for track in scenario["tracks"].values():
            track["state"]["position"] = change(track["state"]["position"])

    return changed


SCENARIONET: dict[str, tuple[Callable[[Scenario], object], str]] = {
    "ms": (timed(1e3), "metadata.ts: stamps are 100 s apart, and 0.1 s if they were in ms: expected s"),
    "us": (timed(1e6), "metadata.ts: .* in us: expected s"),
    "ns": (timed(1e9), "metadata.ts: .* in ns: expected s"),
    "degrees": (of_ego(lambda s: s.update(heading=np.degrees(s["heading"]))), r"ego: headings are \d+ deg off"),
    "compass": (
        of_ego(lambda s: s.update(heading=np.pi / 2 - s["heading"])),
        r"headings are 123 deg off .*of 189 steps",
    ),
    "clockwise": (of_ego(lambda s: s.update(heading=-s["heading"])), "headings are 135 deg off"),
    "swapped": (placed(lambda p: p[:, [1, 0, 2]]), "headings are 123 deg off"),
    "another frame": (placed(lambda p: p - np.float32(5000.0)), r"map_features: .* is nowhere nearer than [4-9],\d+ m"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENARIONET)
def test_scenarionet_of_another_meaning_is_told(shared_root: Path, tmp_path: Path, kind: str) -> None:
    change, said = SCENARIONET[kind]
    source = next((shared_root / "data" / "scenarionet").rglob("sd_*0061.pkl"))
    scenario = load_writable(source)
    change(scenario)
    (tmp_path / source.name).write_bytes(pickle.dumps(scenario))
    with pytest.raises(BadClip, match=said):
        refusal(ScenarioNetReader(tmp_path / source.name))


@pytest.mark.slow
def test_the_real_logs_pass_as_they_are(shared_root: Path) -> None:
    for reader in (AV2Reader(shared_root / "data/av2/sensor"), ScenarioNetReader(shared_root / "data/scenarionet")):
        index = reader.index()
        assert not index.broken
        for log in {ref.log_id: ref for ref in index.refs}.values():
            reader.read(log)
    photos = shared_root / "data" / "nuscenes_front"
    refusal(ScenarioNetReader(next(photos.glob("*.pkl")), cameras=photos))
