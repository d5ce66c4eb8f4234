"""Photos and sweeps beside a ScenarioNet log, which has none itself, or alone: what a sidecar says. docs/photos.md."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factory.files import broken_link, is_named, why_unread
from factory.readers.base import BadClip, camera_sign, id_text, stamps_sign
from factory.readers.pictures import file_and_frame, frame_uri
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.clip import (
    MOVING_KINDS,
    OTHER_LOG,
    ROTATION_SLACK,
    STEP_S,
    AgentKind,
    AgentTracks,
    Block,
    Camera,
    Fisheye,
    PhotoDrive,
    SensorFile,
)
from tasks.world.frames import EGO_STATE_SIZE, HEADING, X, Y, all_within, planar_matrices, wrap_angle

# Where the photos of ScenarioNet's logs are said to be: `cameras.json`, one of each log. Format: docs/photos.md.

NAME = "cameras.json"
MAX_BYTES = 1 << 28  # an entry of 12 Hz takes some 500: half a million


def sidecars_of(cameras: Path, log_ids: Iterable[str]) -> dict[str, Path]:
    """Log id -> its sidecar, of the logs that have one.

    `cameras`: one sidecar or the folder it lies in, for the only log; or a folder with one in <log id>/ for each. A
    folder may also be named by what follows the id's last underscore, which is nuScenes' scene (scene-0103).
    Raises ValueError where it is none of these.
    """
    ids, said = list(log_ids), f"clips.cameras={cameras}"
    alone = cameras if cameras.is_file() else cameras / NAME
    if is_named(alone):  # a broken link is named where it is read
        if len(ids) != 1:
            raise ValueError(
                f"{said}: one log's sidecar, and {len(ids)} logs are read: name it by clips.only=[...], "
                f"or put each log's into <log id>/{NAME}"
            )
        return {ids[0]: alone}
    if not cameras.is_dir():
        raise ValueError(f"{said}: {broken_link(cameras) or 'no such file or folder'}")
    found = {}
    for log_id in ids:
        places = (cameras / name / NAME for name in (log_id, log_id.rpartition("_")[2]))
        if there := [place for place in places if is_named(place)]:
            found[log_id] = there[0]
    if not found:
        raise ValueError(f"{said}: no {NAME} here, nor in <log id>/ of any log that is read: {', '.join(ids[:3])}")
    return found


def load_sidecar(path: Path) -> tuple[dict[str, Any], bytes]:
    """What stands in a sidecar, and its bytes. Raises BadClip."""
    file = str(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BadClip(file, "size", f"more than {MAX_BYTES} bytes")
        data = path.read_bytes()
        content = json.loads(data)
    except OSError as error:
        raise BadClip(file, "file", f"cannot be read: {why_unread(path, error)}") from error
    except (ValueError, RecursionError) as error:
        raise BadClip(file, "file", f"is no JSON: {error}") from error
    if not isinstance(content, dict):
        raise BadClip(file, "file", f"holds a {type(content).__name__}, expected an object with cameras and frames")
    return content, data


def cameras_in(content: Mapping[str, Any], file: str) -> dict[str, Mapping[str, Any]]:
    """Name -> the fields of each camera. Raises BadClip.

    A sidecar of one camera may have them at its top; the camera is then called as the folder of the first photo.
    """
    cameras = content.get("cameras")
    if cameras is None and "K" in content:
        frames = content.get("frames")
        first = frames[0] if isinstance(frames, list) and frames else None
        path = first.get("file") if isinstance(first, dict) else None
        return {Path(path).parent.name or "camera" if isinstance(path, str) else "camera": content}
    if not isinstance(cameras, dict) or not cameras or not all(isinstance(one, dict) for one in cameras.values()):
        raise BadClip(file, "cameras", "missing, or not an object of one object for each camera")
    return cameras


MAX_ENTRIES = 500_000
MAX_CAMERAS, MAX_PIXELS = 64, 1 << 14  # of a rig; a side of a photo
VIDEO = ".mp4"
INSTANT_STEPS = 5  # samples show 2 Hz
OFF_TRACK_M = 10.0  # from the log's own drive, whose clock may be off by a quarter of a second


@dataclass(frozen=True)
class Photographs:
    """What a sidecar says of one log; times are seconds since the log's first instant, files in their order."""

    data: bytes  # of the sidecar
    cameras: tuple[Camera, ...] = ()
    images: tuple[SensorFile, ...] = ()
    sweeps: tuple[SensorFile, ...] = ()


NO_PHOTOGRAPHS = Photographs(b"")


def read_photographs(path: Path, root: Path, ego_states: Array) -> Photographs:
    """What the sidecar says, its files below `root`; ego_states (S, 11): the log's drive, NaN where it has none.

    A photo without a pose is where the log's ego was. Raises BadClip that names the field and what is expected.
    """
    file = str(path)
    content, data = load_sidecar(path)
    if content.get("version", 1) != 1:
        raise BadClip(file, "version", f"{shown(content['version'])}, this version reads 1")
    described = cameras_in(content, file)
    if len(described) > MAX_CAMERAS:
        raise BadClip(file, "cameras", f"{len(described)} of them, at most {MAX_CAMERAS} are read")
    at_top = content.get("cameras") is None
    cameras = {
        name: _camera(name, fields, file, "" if at_top else f"cameras.{name}.") for name, fields in described.items()
    }
    only = next(iter(cameras)) if len(cameras) == 1 else None
    drive = _Drive(ego_states)
    images, seen = [], set[tuple[str, float]]()
    entries = _entries(content, "frames", file)
    if sign := stamps_sign(np.array([_time(entry, file, f"frames[{i}]") for i, entry in enumerate(entries)]), "s"):
        raise BadClip(file, "frames.t_s", sign)
    for i, entry in enumerate(entries):
        field = f"frames[{i}]"
        name = entry.get("camera", only)
        if not isinstance(name, str) or name not in cameras:
            raise BadClip(file, f"{field}.camera", f"{shown(name)} is none of {', '.join(cameras)}")
        time_s = _time(entry, file, field)
        if (name, time_s) in seen:
            raise BadClip(file, f"{field}.t_s", f"{name} took two photos at {time_s:g} s")
        seen.add((name, time_s))
        pose = _pose(entry, cameras[name], drive, time_s, file, field)
        images.append(SensorFile(name, _uri(entry.get("file"), root, file, f"{field}.file"), time_s, pose))
    if not images:
        raise BadClip(file, "frames", "is empty: no photo")
    return Photographs(
        data,
        tuple(camera for name, camera in cameras.items() if any(image.sensor == name for image in images)),
        tuple(sorted(images, key=lambda image: image.time_s)),
        _sweeps(content, root, drive, file),
    )


class _Drive:
    """Where the log's ego was."""

    def __init__(self, ego_states: Array) -> None:
        self._steps = np.flatnonzero(np.isfinite(ego_states).all(axis=1))
        self._poses = ego_states[self._steps][:, [X, Y, HEADING]]
        self._headings = np.unwrap(self._poses[:, 2])

    def at(self, time_s: float) -> Array | None:
        """(4, 4), upright; None where the drive does not reach within half a step."""
        if not len(self._steps):
            return None
        step = time_s / STEP_S
        if not self._steps[0] - 0.5 <= step <= self._steps[-1] + 0.5:
            return None
        columns = (self._poses[:, 0], self._poses[:, 1], self._headings)
        x, y, heading = (np.interp(step, self._steps, column) for column in columns)
        return planar_matrices(np.array([[x, y, wrap_angle(np.array(heading))]]))[0]


def _uri(name: object, root: Path, sidecar: str, field: str) -> str:
    """Of a picture below `root`, or of a frame of the video that stands for its folder. Raises BadClip for another."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise BadClip(sidecar, field, f"{shown(name)} is no path of a picture")
    path = Path(name)
    if path.is_absolute() or ".." in path.parts:
        raise BadClip(sidecar, field, f"{shown(name)}: paths are relative, below the folder of the photos")
    video = (root / path.parent).with_suffix(VIDEO)
    if path.stem.isascii() and path.stem.isdecimal() and video.is_file() and not (root / path.parent).is_dir():
        return frame_uri(video, int(path.stem))
    return str(root / path)


def _entries(content: Mapping[str, Any], name: str, file: str) -> Sequence[Mapping[str, Any]]:
    entries = content.get(name)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise BadClip(file, name, "missing, or not a list of objects")
    if len(entries) > MAX_ENTRIES:
        raise BadClip(file, name, f"{len(entries)} of them, at most {MAX_ENTRIES} are read")
    return entries


def _camera(name: str, fields: Mapping[str, Any], file: str, under: str) -> Camera:
    width, height = fields.get("width"), fields.get("height")
    for key, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_PIXELS:
            raise BadClip(file, under + key, f"{shown(value)}: expected a whole number of pixels, 1 to {MAX_PIXELS}")
    assert isinstance(width, int) and isinstance(height, int)
    intrinsics = _array(fields.get("K"), (3, 3), file, under + "K")
    if (intrinsics[2] != (0.0, 0.0, 1.0)).any() or intrinsics[0, 1] or intrinsics[1, 0]:
        raise BadClip(file, under + "K", "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    distortion = np.zeros(5)
    if "distortion" in fields:
        distortion = _array(fields["distortion"], (5,), file, under + "distortion")
    fisheye = None
    if "fisheye" in fields:
        if distortion.any():
            raise BadClip(file, under + "fisheye", "a lens is either a fisheye or has `distortion`")
        fisheye = Fisheye(intrinsics, _array(fields["fisheye"], (4,), file, under + "fisheye"))
    mount = _rigid(fields.get("cam_to_ego"), file, under + "cam_to_ego")
    readout_s = fields.get("readout_s", 0.0)
    if isinstance(readout_s, bool) or not isinstance(readout_s, int | float):
        raise BadClip(file, under + "readout_s", f"{shown(readout_s)}: expected seconds from the first row to the last")
    try:
        camera = Camera(name, width, height, intrinsics, distortion, mount, fisheye, float(readout_s))
    except ValueError as error:
        raise BadClip(file, under.rstrip(".") or "camera", str(error)) from error
    if sign := camera_sign(camera):
        raise BadClip(file, under.rstrip(".") or "camera", sign)
    return camera


def _time(entry: Mapping[str, Any], file: str, field: str) -> float:
    value = entry.get("t_s")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
        raise BadClip(file, f"{field}.t_s", f"{shown(value)}: expected seconds since the log's first instant")
    return float(value)


def _pose(
    entry: Mapping[str, Any], camera: Camera | None, drive: _Drive, time_s: float, file: str, field: str
) -> Array:
    """(4, 4) world from ego, held against the log's own drive."""
    logged = drive.at(time_s)
    if camera is not None and "cam_to_world" in entry:
        key, pose = "cam_to_world", _rigid(entry["cam_to_world"], file, f"{field}.cam_to_world")
        pose = pose @ np.linalg.inv(camera.ego_from_camera)
    elif "ego_to_world" in entry:
        key, pose = "ego_to_world", _rigid(entry["ego_to_world"], file, f"{field}.ego_to_world")
    elif logged is None:
        problem = f"missing, and there is no drive at {time_s:g} s to take it from"
        raise BadClip(file, f"{field}.ego_to_world", problem)
    else:
        return logged
    if logged is not None and (apart := float(np.linalg.norm(pose[:2, 3] - logged[:2, 3]))) > OFF_TRACK_M:
        problem = f"{apart:,.0f} m from where the log's ego was at {time_s:g} s: another log's, or another world frame?"
        raise BadClip(file, f"{field}.{key}", problem)
    return pose


LONGEST_S = 600.0  # of a drive that one scene is made of
BOX_REACH_S = 0.55  # from an instant at which a thing's box is given: so far its place is known


def read_photo_drive(path: Path, root: Path) -> PhotoDrive:
    """What a sidecar says where there is no log: a drive from its first photo or sweep to the last one.

    Raises BadClip as `read_photographs`, and for files that are not there.
    """
    found = read_photographs(path, root, np.full((1, EGO_STATE_SIZE), np.nan))
    files = (*found.images, *found.sweeps)
    if lost := [file.uri for file in files if not file_and_frame(file.uri)[0].is_file()]:
        problem = f"{len(lost):,} of {len(files):,} files are not there, such as {lost[0]}: do paths count from {root}?"
        raise BadClip(str(path), "frames", problem)
    first_s, last_s = min(file.time_s for file in files), max(file.time_s for file in files)
    if last_s - first_s > LONGEST_S:
        problem = f"{last_s - first_s:,.0f} s from the first to the last: a scene is of some 20 s, make several files"
        raise BadClip(str(path), "frames.t_s", problem)
    images, sweeps = (
        tuple(replace(file, time_s=file.time_s - first_s) for file in part) for part in (found.images, found.sweeps)
    )
    steps_s = first_s + STEP_S * np.arange(int((last_s - first_s) / STEP_S) + 2, dtype=np.float64)
    block = Block(first_s, _boxed(json.loads(found.data), steps_s, str(path)), images, sweeps)
    name = path.absolute().parent.name
    return PhotoDrive("photos", name, hashlib.sha256(found.data).hexdigest(), found.cameras, block)


def _boxed(content: Mapping[str, Any], steps_s: Array, file: str) -> AgentTracks:
    """The things whose boxes a sidecar has, at times (S,): linear between two, absent far from any."""
    kinds, rows = dict[str, AgentKind](), dict[str, dict[float, Array]]()
    for i, entry in enumerate(_entries(content, "boxes", file) if "boxes" in content else ()):
        field, name, kind = f"boxes[{i}]", id_text(entry.get("id")), entry.get("kind", AgentKind.VEHICLE.value)
        if not name or OTHER_LOG in name:
            raise BadClip(file, f"{field}.id", f"{shown(entry.get('id'))}: expected text without {OTHER_LOG}")
        if kind not in sorted(MOVING_KINDS):
            raise BadClip(file, f"{field}.kind", f"{shown(kind)} is none of {', '.join(sorted(MOVING_KINDS))}")
        time_s = _time(entry, file, field)
        if time_s in rows.setdefault(name, {}):
            raise BadClip(file, f"{field}.t_s", f"{name} has two boxes at {time_s:g} s")
        yaw = _array([entry["yaw"]] if "yaw" in entry else None, (1,), file, f"{field}.yaw")
        center, size = (_array(entry.get(key), (3,), file, f"{field}.{key}") for key in ("center", "size"))
        if size.min() <= 0.0:
            raise BadClip(file, f"{field}.size", "expected length, width and height above 0")
        kinds[name], rows[name][time_s] = AgentKind(kind), np.concatenate([center, yaw, size])
    shape = len(steps_s), len(rows)
    boxes, center_z, valid, heights = np.full((*shape, 5), np.nan), np.full(shape, np.nan), np.zeros(shape, bool), []
    for j, given in enumerate(rows.values()):
        times = np.array(sorted(given))
        at = np.stack([given[time_s] for time_s in times])
        after = np.minimum(np.searchsorted(times, steps_s), len(times) - 1)
        apart = [np.abs(steps_s - times[row]) for row in (after, np.maximum(after - 1, 0))]
        near = np.minimum(*apart) <= BOX_REACH_S
        there = near & (steps_s >= times[0] - STEP_S / 2) & (steps_s <= times[-1] + STEP_S / 2)
        columns = (*at[:, :3].T, np.unwrap(at[:, 3]))
        x, y, z, yaw = (np.interp(steps_s[there], times, column) for column in columns)
        length, width, height = np.median(at[:, 4:], axis=0)
        boxes[there, j] = np.column_stack([x, y, wrap_angle(yaw), np.full_like(x, length), np.full_like(x, width)])
        center_z[there, j], valid[:, j] = z, there
        heights.append(height)
    velocities = np.gradient(boxes[..., :2], STEP_S, axis=0)
    return AgentTracks(tuple(rows), tuple(kinds.values()), boxes, velocities, valid, center_z, np.array(heights))


def start_step_nearest_photos(found: Photographs, first: int, n_steps: int) -> int:
    """The step of `first` .. `first` + 4 from which on instants every 0.5 s lie nearest to photos of all cameras.

    Samples show such instants, and windows begin at one.
    """

    def apart(start: int) -> float:
        instants = STEP_S * np.arange(start, n_steps, INSTANT_STEPS)
        taken = [np.array([image.time_s for image in found.images if image.sensor == c.name]) for c in found.cameras]
        return float(np.mean([np.abs(instants[:, None] - times).min(axis=1).mean() for times in taken]))

    starts = range(first, min(first + INSTANT_STEPS, n_steps))
    return min(starts, key=apart, default=first)


def _sweeps(content: Mapping[str, Any], root: Path, drive: _Drive, file: str) -> tuple[SensorFile, ...]:
    if "sweeps" not in content:
        return ()
    lidar = content.get("lidar")
    name, fields = next(iter(lidar.items())) if isinstance(lidar, dict) and len(lidar) == 1 else ("", None)
    if not isinstance(fields, dict):
        raise BadClip(file, "lidar", 'missing, or not one lidar: {"LIDAR_TOP": {"lidar_to_ego": ...}}')
    mount = _rigid(fields.get("lidar_to_ego"), file, f"lidar.{name}.lidar_to_ego")
    out = []
    for i, entry in enumerate(_entries(content, "sweeps", file)):
        field = f"sweeps[{i}]"
        time_s = _time(entry, file, field)
        pose = _pose(entry, None, drive, time_s, file, field)
        out.append(SensorFile(name, _uri(entry.get("file"), root, file, f"{field}.file"), time_s, pose, mount))
    return tuple(sorted(out, key=lambda sweep: sweep.time_s))


def _rigid(value: object, file: str, field: str) -> Array:
    """A 4 x 4 pose, given as such or as {"R": 3 x 3, "t": 3}."""
    pose = np.eye(4)
    if isinstance(value, dict):
        pose[:3, :3] = _array(value.get("R"), (3, 3), file, f"{field}.R")
        pose[:3, 3] = _array(value.get("t"), (3,), file, f"{field}.t")
    else:
        pose = _array(value, (4, 4), file, field)
    turned = pose[:3, :3]
    if (pose[3] != (0.0, 0.0, 0.0, 1.0)).any() or np.abs(turned @ turned.T - np.eye(3)).max() > ROTATION_SLACK:
        raise BadClip(file, field, "is not a rotation and a shift")
    if np.linalg.det(turned) < 0.0:
        raise BadClip(file, field, "mirrors: its axes are not right-handed")
    return pose


def _array(value: object, shape: tuple[int, ...], file: str, field: str) -> Array:
    """Finite numbers of a shape, as nested lists."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(file, field, f"is not numbers, expected {_shape_text(shape)} of them") from error
    if value is None or array.shape != shape:
        found = "missing" if value is None else f"shape {array.shape}"
        raise BadClip(file, field, f"{found}, expected {_shape_text(shape)} numbers")
    if not all_within(array):
        raise BadClip(file, field, "holds NaN, infinity or numbers beyond 1e8")
    return array


def _shape_text(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
