"""Binary PCD files: records of any field order and type, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from factory.readers.base import BadClip
from factory.readers.points import read_pcd
from factory.stages.sensors import load_sweeps
from tasks.world.clip import SensorFile

FIELDS = (("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<u1"), ("ring", "<u2"), ("lidar_info", "<i4"))


def pcd(points: np.ndarray, **other: str) -> bytes:
    """The records as nuPlan's merged sweeps hold them; other: header lines instead of the true ones."""
    names = points.dtype.names or ()
    types = [points.dtype[name] for name in names]
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(names),
        "SIZE": " ".join(str(t.itemsize) for t in types),
        "TYPE": " ".join(t.kind.upper() for t in types),
        "COUNT": " ".join("1" for _ in names),
        "WIDTH": str(len(points)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(points)),
        "DATA": "binary",
    }
    lines = [f"{key} {value}" for key, value in (header | other).items() if value]
    return ("# .PCD v0.7\n" + "\n".join(lines) + "\n").encode() + points.tobytes()


def records(n: int = 5) -> np.ndarray:
    points = np.zeros(n, np.dtype(list(FIELDS)))
    points["x"], points["y"], points["z"] = np.arange(n) + 10.5, -np.arange(n), 0.25
    points["intensity"] = 40 * np.arange(n)
    return points


def test_every_field_comes_back_in_its_own_type_whatever_the_order(tmp_path: Path) -> None:
    points = records()
    for order in (list(FIELDS), FIELDS[::-1]):
        turned = np.zeros(len(points), np.dtype(list(order)))
        for name, _ in order:
            turned[name] = points[name]
        path = tmp_path / "a.pcd"
        path.write_bytes(pcd(turned) + b"trailing")
        read = read_pcd(path, [name for name, _ in FIELDS])
        for name, kind in FIELDS:
            assert read[name].dtype == kind and (read[name] == points[name]).all()


def test_a_sweep_of_a_clip_may_be_a_pcd(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(records()))
    (sweep,) = load_sweeps([SensorFile("lidar", str(path), 0.5, np.eye(4))])
    assert sweep.points.dtype == np.float32 and sweep.points.tolist()[1] == [11.5, -1.0, 0.25]


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (pcd(records())[:-30], "DATA"),
        (pcd(records())[:40], "header"),
        (b"\x89PNG\n\xff\xfe\n", "header"),
        (pcd(records(), DATA="ascii"), "DATA"),
        (pcd(records(), DATA="binary_compressed"), "DATA"),
        (pcd(records(), COUNT="1 1 1 1 1 3"), "COUNT"),
        (pcd(records(), TYPE="F F F U U S"), "TYPE"),
        (pcd(records(), SIZE="4 4 4 1 2 3"), "TYPE"),
        (pcd(records(), FIELDS="x y z z ring lidar_info"), "FIELDS"),
        (pcd(records(), FIELDS="x y h intensity ring lidar_info"), "FIELDS"),
        (pcd(records(), POINTS="many"), "POINTS"),
        (pcd(records(), POINTS="0"), "POINTS"),
        (pcd(records(), SIZE=""), "SIZE"),
        (pcd(records()).replace(b"HEIGHT", b"HEIGTH"), "header"),
    ],
)
def test_what_is_no_binary_pcd_is_refused_by_field(tmp_path: Path, data: bytes, field: str) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(data)
    with pytest.raises(BadClip) as refused:
        read_pcd(path, ("x", "y", "z"))
    assert (refused.value.file, refused.value.field) == (str(path), field)


def test_points_that_are_no_numbers_and_missing_files_are_named(tmp_path: Path) -> None:
    points = records()
    points["y"][2] = np.nan
    (tmp_path / "a.pcd").write_bytes(pcd(points))
    with pytest.raises(BadClip, match=r"a\.pcd: y: holds NaN"):
        read_pcd(tmp_path / "a.pcd", ("x", "y"))
    with pytest.raises(BadClip, match=r"b\.pcd: file: cannot be read"):
        read_pcd(tmp_path / "b.pcd", ("x",))
