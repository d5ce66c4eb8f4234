"""Photos and lidar of nuScenes' own folders as sidecars of ScenarioNet's logs, one file a scene (docs/photos.md).

From nuScenes' schema (nuscenes-devkit @ d9de17a, its page on the schema): tables are JSON lists of rows that name each
other by tokens. Photos are undistorted, each has an ego pose of its own, and the world is the city's map frame, which
ScenarioNet keeps. Its clock counts keyframes as 0.5 s each, so stamps are put on that.
"""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factory.datasets.scenarionet.photos import NAME
from factory.files import atomic_file, matching
from factory.readers.base import BadClip
from factory.wording import shown
from tasks.world.arrays import Array

LIDAR = "LIDAR_TOP"
KEYFRAME_S = 0.5  # ScenarioNet's, whatever the stamps say
CHUNK = 1 << 20
MAX_ROW = 1 << 22  # characters; a row has some 500


@dataclass(frozen=True)
class WrittenSidecar:
    """What a scene's sidecar holds."""

    path: Path
    scene: str
    cameras: int
    photos: int
    sweeps: int
    missing: tuple[str, ...]  # files that the tables name and that are not there


@dataclass(frozen=True)
class _Shot:
    """A row of sample_data, of a camera or the lidar."""

    channel: str
    stamp_us: int
    file: str
    size: tuple[int, int]
    pose: str  # token
    calibration: str  # token


def import_cameras(
    root: Path, out: Path, version: str | None = None, only: Collection[str] = (), sweeps: bool = True
) -> Iterator[WrittenSidecar]:
    """Write `out`/<scene>/cameras.json for each scene of `root`/<version>, all or those named in `only`.

    version: None: the only one there; sweeps: False: keyframes alone. Photos stay where they are; those that are not
    there are left out. Raises BadClip for tables that do not hold together, ValueError for what is not there.
    """
    tables = root / _version(root, version)
    scenes = {_text(row, "token", tables / "scene.json"): row for row in rows_of(tables / "scene.json")}
    names = {token: _text(row, "name", tables / "scene.json") for token, row in scenes.items()}
    if unknown := [name for name in only if name not in names.values()]:
        raise ValueError(
            f"only=: {tables} has no {', '.join(unknown)}; there are {', '.join(sorted(names.values())[:5])}"
        )
    chosen = {token for token, name in names.items() if not only or name in only}
    keyframes: dict[str, list[int]] = {token: [] for token in chosen}
    scene_of: dict[str, str] = {}
    for row in rows_of(file := tables / "sample.json"):
        scene = _text(row, "scene_token", file)
        if scene in chosen:
            keyframes[scene].append(_whole(row, "timestamp", file))
            scene_of[_text(row, "token", file)] = scene
    rig = _calibrations(tables)
    shots: dict[str, list[_Shot]] = {token: [] for token in chosen}
    for row in rows_of(file := tables / "sample_data.json"):
        scene = scene_of.get(_text(row, "sample_token", file), "")
        key = _text(row, "calibrated_sensor_token", file)
        if not scene or key not in rig or not (row.get("is_key_frame") is True or (sweeps and rig[key].is_camera)):
            continue
        size = (_whole(row, "width", file), _whole(row, "height", file)) if rig[key].is_camera else (0, 0)
        shots[scene].append(
            _Shot(
                rig[key].channel,
                _whole(row, "timestamp", file),
                _below(_text(row, "filename", file), file),
                size,
                _text(row, "ego_pose_token", file),
                key,
            )
        )
    poses = _poses(tables, {shot.pose for mine in shots.values() for shot in mine})
    for token in sorted(chosen, key=names.__getitem__):
        yield _write(out / names[token] / NAME, names[token], root, keyframes[token], shots[token], rig, poses)


def rows_of(table: Path) -> Iterator[Mapping[str, Any]]:
    """The rows of a table one after the other: sample_data of all of nuScenes takes over a gigabyte. Raises BadClip."""
    decoder, text, begun = json.JSONDecoder(), "", False
    try:
        with table.open(encoding="utf-8") as stream:
            while True:
                more = stream.read(CHUNK)
                text += more
                at = 0
                while True:
                    while at < len(text) and text[at] in " \t\r\n,":
                        at += 1
                    if not begun and at < len(text):
                        if text[at] != "[":
                            raise BadClip(str(table), "table", "is no JSON list of rows")
                        begun, at = True, at + 1
                        continue
                    if text.startswith("]", at):
                        return
                    try:
                        row, at = decoder.raw_decode(text, at)
                    except json.JSONDecodeError:
                        break  # the row goes on in the next part
                    if not isinstance(row, dict):
                        raise BadClip(str(table), "table", f"holds a {type(row).__name__} among its rows")
                    yield row
                text = text[at:]
                if not more or len(text) > MAX_ROW:
                    raise BadClip(str(table), "table", f"is no JSON, or ends within a row: {text[:40]!r}")
    except (OSError, UnicodeDecodeError) as error:
        raise BadClip(str(table), "table", f"cannot be read: {error}") from error


@dataclass(frozen=True)
class _Calibration:
    channel: str
    is_camera: bool
    ego_from_sensor: Array  # (4, 4)
    intrinsics: Array | None  # (3, 3)


def _calibrations(tables: Path) -> dict[str, _Calibration]:
    """Of cameras and the lidar, by token."""
    sensors = {}
    for row in rows_of(file := tables / "sensor.json"):
        sensors[_text(row, "token", file)] = _text(row, "channel", file), _text(row, "modality", file)
    out = {}
    for row in rows_of(file := tables / "calibrated_sensor.json"):
        sensor = _text(row, "sensor_token", file)
        if sensor not in sensors:
            raise BadClip(str(file), "sensor_token", f"{sensor} is in no row of sensor.json")
        channel, modality = sensors[sensor]
        if modality == "camera" or channel == LIDAR:
            k = _numbers(row, "camera_intrinsic", (3, 3), file) if modality == "camera" else None
            out[_text(row, "token", file)] = _Calibration(channel, modality == "camera", _pose(row, file), k)
    return out


def _poses(tables: Path, wanted: Collection[str]) -> dict[str, Array]:
    """Token -> (4, 4) world from ego."""
    file = tables / "ego_pose.json"
    out = {token: _pose(row, file) for row in rows_of(file) if (token := _text(row, "token", file)) in wanted}
    if lost := sorted(set(wanted) - out.keys()):  # the same one each time
        raise BadClip(str(file), "token", f"no pose {lost[0]}, which sample_data.json names")
    return out


def _write(
    path: Path,
    scene: str,
    root: Path,
    keyframes_us: Sequence[int],
    shots: Sequence[_Shot],
    rig: Mapping[str, _Calibration],
    poses: Mapping[str, Array],
) -> WrittenSidecar:
    there = [shot for shot in sorted(shots, key=lambda shot: shot.stamp_us) if (root / shot.file).is_file()]
    missing = tuple(sorted({shot.file for shot in shots} - {shot.file for shot in there}))
    clock = on_scenarionet_clock(np.array([shot.stamp_us for shot in there], np.int64), keyframes_us)
    cameras: dict[str, Any] = {}
    calibrated: dict[str, str] = {}
    frames, sweeps = [], []
    for shot, t_s in zip(there, clock.tolist()):
        calibration = rig[shot.calibration]
        if calibrated.setdefault(shot.channel, shot.calibration) != shot.calibration:
            raise BadClip(str(root), f"sample_data of {scene}", f"{shot.channel} has two calibrations in one scene")
        entry = {"t_s": round(t_s, 6), "file": shot.file, "ego_to_world": poses[shot.pose].tolist()}
        if calibration.intrinsics is None:
            sweeps.append(entry)
            continue
        size = {"width": shot.size[0], "height": shot.size[1]}
        mount = {"K": calibration.intrinsics.tolist(), "cam_to_ego": calibration.ego_from_sensor.tolist()}
        cameras.setdefault(shot.channel, mount | size)
        frames.append({"camera": shot.channel, **entry})
    content: dict[str, Any] = {"version": 1, "cameras": cameras, "frames": frames}
    if sweeps:
        mount = {"lidar_to_ego": rig[calibrated[LIDAR]].ego_from_sensor.tolist()}
        content |= {"lidar": {LIDAR: mount}, "sweeps": sweeps}
    if frames:
        text = json.dumps(content).encode()
        with atomic_file(path, len(text)) as draft:
            draft.write_bytes(text)
    return WrittenSidecar(path, scene, len(cameras), len(frames), len(sweeps), missing)


def on_scenarionet_clock(stamps_us: np.ndarray[Any, np.dtype[np.int64]], keyframes_us: Sequence[int]) -> Array:
    """(N,) seconds of stamps (N,) [us] where keyframe k counts as 0.5 k seconds; linear between, and on beyond.

    Raises ValueError for fewer than two keyframes.
    """
    keys = np.unique(np.array(keyframes_us, np.int64))
    if len(keys) < 2:
        raise ValueError(f"a scene of {len(keys)} keyframes has no clock")
    before = np.clip(np.searchsorted(keys, stamps_us, side="right") - 1, 0, len(keys) - 2)
    share = (stamps_us - keys[before]) / (keys[before + 1] - keys[before])
    return np.asarray(KEYFRAME_S * (before + share), np.float64)


def _version(root: Path, version: str | None) -> str:
    there = [path.parent.name for path in matching(root, "v1.0-*/scene.json")]
    if version in there:
        return str(version)
    if version is not None or len(there) != 1:
        wanted = f"version={version}: not there" if version is not None else "version= is missing"
        raise ValueError(f"{wanted}: {root} has {', '.join(there) or 'no folder v1.0-* with scene.json'}")
    return there[0]


def _below(name: str, file: Path) -> str:
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise BadClip(str(file), "filename", f"{shown(name)} is no path below the folder of the data set")
    return name


def _pose(row: Mapping[str, Any], file: Path) -> Array:
    """(4, 4) of translation and rotation (w, x, y, z)."""
    w, x, y, z = _numbers(row, "rotation", (4,), file)
    if abs(np.linalg.norm([w, x, y, z]) - 1.0) > 1e-3:
        raise BadClip(str(file), "rotation", f"{row.get('token')}: a quaternion that is not of unit length")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = _numbers(row, "translation", (3,), file)
    return pose


def _numbers(row: Mapping[str, Any], key: str, shape: tuple[int, ...], file: Path) -> Array:
    try:
        array = np.array(row.get(key), np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise BadClip(str(file), key, f"{row.get('token')}: expected {' x '.join(map(str, shape))} finite numbers")
    return array


def _text(row: Mapping[str, Any], key: str, file: Path) -> str:
    value = row.get(key)
    if not isinstance(value, str):
        raise BadClip(str(file), key, f"missing in a row, or no text: {shown(value)}")
    return value


def _whole(row: Mapping[str, Any], key: str, file: Path) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadClip(str(file), key, f"missing in row {row.get('token')}, or no whole number: {shown(value)}")
    return value
