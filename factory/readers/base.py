"""What a reader is, and how a clip is named before anything of it is opened."""

import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from numbers import Integral
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np

from factory.files import why_unread
from factory.wording import MOST_SAID, one_line, printable, shown
from tasks.world.arrays import Array, Bytes, Ints
from tasks.world.clip import CLIP_STEPS, STEP_S, AgentKind, AgentTracks, Camera, Clip
from tasks.world.frames import EGO_STATE_SIZE, HEADING, LARGEST, PACIFICA, X, Y, wrap_angle
from tasks.world.repair.records import Repair, first_repairs, repair_text
from tasks.world.road_map import Lane, LightState, MapLayer, RoadMap, Route, TrafficLights

SPLITS = ("train", "val", "test")
MAX_FILE_BYTES = 1 << 30  # of a file that is read whole


class BadClip(Exception):
    """The input is broken: says which file, which field, and how to fix it."""

    def __init__(self, file: str, field: str, problem: str) -> None:
        field, problem = _cut(field), _cut(problem)
        super().__init__(f"{file}: {field}: {problem}")
        self.file, self.field, self.problem = file, field, problem

    def __reduce__(self) -> tuple[type["BadClip"], tuple[str, str, str]]:
        return type(self), (self.file, self.field, self.problem)


class Unreadable(BadClip):
    """The input is broken in a way that its reader did not foresee: it raised something else, which is the cause."""


def _cut(text: str) -> str:
    return printable(text if len(text) <= MOST_SAID else f"{text[:MOST_SAID]}...")


@contextmanager
def failures_as_bad_clip(file: str) -> Iterator[None]:
    """Around what a reader does with one file, folder or clip: whatever it raises over that is that one's failure.

    Raises BadClip, Unreadable, and the OSError of another place, such as a full disk under the cache.
    """
    try:
        yield
    except BadClip:
        raise
    except Exception as error:
        if isinstance(error, OSError) and not _is_of(error, file):
            raise
        problem = f"cannot be read: {type(error).__name__}: {one_line(error)}"
        raise Unreadable(file, "reader", problem) from error


def _is_of(error: OSError, file: str) -> bool:
    if type(error) is OSError and error.errno is None:  # Arrow's, of a file that it does not understand
        return True
    return isinstance(error.filename, str) and Path(error.filename).is_relative_to(file)


def bytes_of(path: Path) -> bytes:
    """All of a file. Raises BadClip where it cannot be read or is larger than MAX_FILE_BYTES."""
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size > MAX_FILE_BYTES:
                raise BadClip(str(path), "size", f"more than {MAX_FILE_BYTES} bytes")
            return file.read()
    except OSError as error:
        raise BadClip(str(path), "file", f"cannot be read: {why_unread(path, error)}") from error


@dataclass(frozen=True, order=True)
class ClipRef:
    """Names one window of one log."""

    dataset: str
    log_id: str
    start_ms: int  # start of the window, milliseconds since the log's first annotated instant
    window: str = "1.5+8.0s@10Hz"

    @property
    def clip_id(self) -> str:
        """16 hex digits, known without opening a sensor file."""
        key = "\x1f".join((self.dataset, self.log_id, str(self.start_ms), self.window))
        return hashlib.sha256(key.encode()).hexdigest()[:16]


def split_of(log_id: str, val_percent: int = 10, test_percent: int = 10) -> str:
    """train, val or test by the hash of the log id, so that windows of one log never part."""
    bucket = int(hashlib.sha256(log_id.encode()).hexdigest()[:8], 16) % 100
    if bucket < test_percent:
        return "test"
    return "val" if bucket < test_percent + val_percent else "train"


@dataclass(frozen=True)
class ClipIndex:
    """What a root holds: windows to read, windows filtered (reason -> count), logs skipped or broken."""

    refs: tuple[ClipRef, ...]
    dropped: Mapping[str, int] = field(default_factory=dict)  # windows filtered, by reason
    skipped_logs: Mapping[str, str] = field(default_factory=dict)  # log id -> reason (e.g. no annotations)
    broken: Mapping[ClipRef, str] = field(default_factory=dict)  # unreadable logs: become failed outcomes


class ClipReader(Protocol):
    """Reads one data set. Readers from a user's own package satisfy it too."""

    @property
    def name(self) -> str:
        """Of the data set; part of every clip id."""
        ...

    def index(self) -> ClipIndex:
        """All windows under the root, in a stable order. Raises ValueError where the root is not this data set."""
        ...

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        ...


class Painter(Protocol):
    """Draws the world of a reader's clips as it is simulated, from anywhere: pictures without a scene."""

    def rig(self, clip: Clip, width: int, height: int) -> tuple[Camera, ...]:
        """The clip's cameras, of some size, or the painter's own of this size where it has none."""
        ...

    def lights(self, clip: Clip, n_steps: int) -> TrafficLights:
        """The clip's lights over `n_steps` steps from its first one."""
        ...

    def pictures(
        self, clip: Clip, cameras: Sequence[Camera], agents: AgentTracks, step: int, state: Array
    ) -> tuple[Array, list[Bytes]]:
        """The pose (4, 4) of an ego in a state (11,), and what each camera sees from there at a step of the clip.

        agents: who is there, in the steps of the clip.
        """
        ...


def painter_of(reader: ClipReader) -> Painter | None:
    """Who paints the reader's clips; None where nobody does."""
    return getattr(reader, "painter", None)


# Which split a log belongs to by its data set's own word; None where the data set has none.
#
# Only then does the hash of the log's id decide (`factory.readers.base.split_of`). A folder that is named after a
# split wins over what is known of single logs: whoever sorted the logs said so.

WAYMO = {"training": "train", "validation": "val", "testing": "test"}
FOLDERS = {"train": "train", "val": "val", "test": "test", **WAYMO}
# nuscenes-devkit @ d9de17a, python-sdk/nuscenes/utils/splits.py: the 150 scenes `val` of v1.0-trainval, whose other 700
# are `train`; `mini_val` of v1.0-mini; all of v1.0-test is `test`. The train scenes of the mini version are partly the
# whole data set's val scenes, so the version in a file's name decides.
_NUSCENES_VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
_NUSCENES_MINI_VAL = "103 916"


def _scenes(ranges: str) -> frozenset[int]:
    ends = [[int(number) for number in part.split("-")] for part in ranges.split()]
    return frozenset(scene for first, *last in ends for scene in range(first, (last or [first])[0] + 1))


NUSCENES_VAL = {"v1.0-trainval": _scenes(_NUSCENES_VAL), "v1.0-mini": _scenes(_NUSCENES_MINI_VAL)}


def folder_split(log: Path) -> str | None:
    """The split after which the folder of a log is named, as in Argoverse's `sensor/val/<log>`.

    Of a log that links lead to: the folder by which it is found, else the one where it lies.
    """
    return FOLDERS.get(log.parent.name) or FOLDERS.get(log.resolve().parent.name)


def nuscenes_split(scenario: str) -> str | None:
    """The split of a ScenarioNet file `sd_nuscenes_<version>_scene-<number>`, by nuScenes' own lists."""
    named = re.fullmatch(r"sd_nuscenes_(v1\.0-\w+)_scene-(\d{4})", scenario)
    if named is None:
        return None
    version, scene = named[1], int(named[2])
    if version == "v1.0-test":
        return "test"
    held_out = NUSCENES_VAL.get(version)
    return None if held_out is None else "val" if scene in held_out else "train"


def waymo_split(source_file: object) -> str | None:
    """The split of the record that a scenario was converted from: training*, validation*, testing*.tfrecord-*."""
    name = PurePosixPath(source_file).name if isinstance(source_file, str) else ""
    return next((split for word, split in WAYMO.items() if name.startswith(word)), None)


# The last look at a clip before anything is computed from it; every reader's clips pass here.
#
# What a field must hold is said in docs/extend.md. A clip that breaks it would fail later, deep in the science, with
# an error that names neither clip nor field.

Fault = tuple[str, str]  # the field, and what is wrong with it
KINDS = {"agents": AgentTracks, "road_map": RoadMap, "route": Route, "lights": TrafficLights}
MAPS_REMEMBERED = 4  # clips of a log share its map, and a reader keeps the last logs only


def read_clip(reader: ClipReader, ref: ClipRef) -> Clip:
    """The reader's clip, looked at. Raises BadClip naming the clip and the field."""
    where = _clip_text(ref)
    with failures_as_bad_clip(where):
        clip = reader.read(ref)
    if not isinstance(clip, Clip):
        raise BadClip(where, "read", f"gave a {type(clip).__name__}, expected a tasks.world.clip.Clip")
    for name in ("clip_id", "dataset", "log_id"):
        if getattr(clip, name) != getattr(ref, name):
            raise BadClip(where, name, f"is {shown(getattr(clip, name))}, expected the ref's {getattr(ref, name)!r}")
    return validate_clip(clip, where)


@dataclass(frozen=True)
class RefusesRepairs:
    """The reader, to which a clip of which anything had to be repaired or left out is a bad clip (repairs=refuse)."""

    reader: ClipReader

    def __getattr__(self, name: str) -> Any:
        """What readers may have beside: digest, block, painter."""
        if name == "reader" or name.startswith("__"):  # not there while it is unpickled
            raise AttributeError(name)
        return getattr(self.reader, name)

    @property
    def name(self) -> str:
        """The reader's."""
        return self.reader.name

    def index(self) -> ClipIndex:
        """The reader's."""
        return self.reader.index()

    def read(self, ref: ClipRef) -> Clip:
        """The reader's clip. Raises BadClip."""
        clip = self.reader.read(ref)
        if not clip.repairs:
            return clip
        n, first = len(clip.repairs), first_repairs(clip.repairs, 1)[0]
        told = f"{n} repairs, the first" if n > 1 else "1 repair"
        how = "put it right in the log, or read the clip with repairs=make, the default"
        raise BadClip(_clip_text(ref), "repairs", f"{told} ({first.what}): {repair_text(first)}; {how}")


def _clip_text(ref: ClipRef) -> str:
    return f"clip {ref.clip_id} ({ref.dataset} {ref.log_id} at {ref.start_ms / 1000:g} s)"


def validate_clip(clip: Clip, file: str) -> Clip:
    """The same clip. Raises BadClip naming `file` and the field that breaks a promise of the clip's types."""
    for name, problem in _faults(clip):
        raise BadClip(file, name, problem)
    return clip


def _faults(clip: Clip) -> Iterator[Fault]:
    """In an order in which each check may rely on those before it."""
    for name, kind in KINDS.items():
        if not isinstance(getattr(clip, name), kind):
            yield name, f"is a {type(getattr(clip, name)).__name__}, expected {kind.__module__}.{kind.__qualname__}"
    for name in ("licence", "content_digest"):
        if not isinstance(getattr(clip, name), str):
            yield name, f"is a {type(getattr(clip, name)).__name__}, expected text"
    if clip.split not in SPLITS:
        yield "split", f"{shown(clip.split)} is none of {', '.join(SPLITS)}"
    yield from _array("ego_states", clip.ego_states, (CLIP_STEPS, EGO_STATE_SIZE))
    yield from _array("world_from_ego", clip.world_from_ego, (CLIP_STEPS, 4, 4))
    if sign := motion_sign(clip.ego_states):
        yield "ego_states", sign
    if sign := place_sign(clip.world_from_ego, clip.ego_states):
        yield "world_from_ego", sign
    yield from _agent_faults(clip)
    if fault := map_fault(clip.road_map):
        yield fault
    if sign := map_sign(clip.ego_states, clip.road_map):
        yield "road_map", sign
    yield from _route_faults(clip)
    yield from _polyline("centerline", clip.centerline)
    yield from _light_faults(clip)
    yield from _sensor_faults(clip)
    if any(not isinstance(repair, Repair) for repair in clip.repairs):
        yield "repairs", "expected tasks.world.repair.records.Repair"


def _agent_faults(clip: Clip) -> Iterator[Fault]:
    agents, n = clip.agents, len(clip.agents)
    columns: dict[str, tuple[int, ...]] = {"boxes": (5,), "velocities": (2,), "valid": (), "center_z": ()}
    for name, last in columns.items():
        yield from _shape(f"agents.{name}", getattr(agents, name), (CLIP_STEPS, n, *last))
    yield from _shape("agents.heights", agents.heights, (n,))
    if agents.valid.dtype != np.bool_:
        yield "agents.valid", f"dtype {agents.valid.dtype}, expected bool"
    if len(agents.kinds) != n:
        yield "agents.kinds", "not one kind per track"
    if strange := sorted({shown(kind) for kind in agents.kinds if not isinstance(kind, AgentKind)}):
        yield "agents.kinds", f"{', '.join(strange)}: expected tasks.world.clip.AgentKind"
    if len(set(agents.track_ids)) != n:
        yield "agents.track_ids", "a track id stands twice"
    for name in ("boxes", "velocities", "center_z"):
        if not (np.abs(getattr(agents, name)[agents.valid]) <= LARGEST).all():
            yield f"agents.{name}", f"not finite where valid, or above {LARGEST:g}"
    if not (agents.boxes[agents.valid][:, 3:] > 0.0).all():
        yield "agents.boxes", "a length or width is not positive"


@lru_cache(maxsize=MAPS_REMEMBERED)
def map_fault(road_map: RoadMap) -> Fault | None:
    """The first field of a map that breaks a promise; None where all hold. A map's identity is the object's."""
    return next(_map_faults(road_map), None)


def _map_faults(road_map: RoadMap) -> Iterator[Fault]:
    lanes = road_map.lanes
    for lane_id, lane in lanes.items():
        yield from _lane_faults(f"road_map.lanes[{shown(lane_id)}]", lane_id, lane)
    if not any(lane.drives_cars for lane in lanes.values()):
        yield "road_map.lanes", "no lane for cars"
    for name in ("drivable_areas", "intersections"):
        for i, area in enumerate(getattr(road_map, name) or ()):
            if not isinstance(area.layer, MapLayer):
                yield f"road_map.{name}[{i}].layer", f"{shown(area.layer)}: expected tasks.world.road_map.MapLayer"
            for ring in (area.ring, *area.holes):
                yield from _ring(f"road_map.{name}[{i}]", ring)
    for i, ring in enumerate(road_map.crossings):
        yield from _ring(f"road_map.crossings[{i}]", ring)
    if unknown := sorted(set(road_map.roadblock_of) - set(lanes)):
        yield "road_map.roadblock_of", f"names lanes that are not on the map: {_some(unknown)}"


def _lane_faults(field: str, lane_id: str, lane: Any) -> Iterator[Fault]:
    if not isinstance(lane, Lane):
        yield field, f"is a {type(lane).__name__}, expected tasks.world.road_map.Lane"
    if lane.lane_id != lane_id:
        yield field, f"its lane_id is {shown(lane.lane_id)}"
    yield from _ring(f"{field}.ring", lane.ring)
    yield from _polyline(f"{field}.centerline", lane.centerline)
    for side in ("left_boundary", "right_boundary"):
        if (line := getattr(lane, side)) is not None:
            yield from _array(f"{field}.{side}", line, (None, 3))


def _route_faults(clip: Clip) -> Iterator[Fault]:
    route, blocks = clip.route, clip.road_map.roadblock_of
    if not route.lane_ids:
        yield "route.lane_ids", "empty"
    for name in ("lane_ids", "lane_path"):
        if unknown := sorted(set(getattr(route, name)) - set(clip.road_map.lanes)):
            yield f"route.{name}", f"not on the map: {_some(unknown)}"
    if without := sorted(set(route.lane_ids) - set(blocks)):
        how = "fill it with tasks.world.road_map.roadblocks_of(lanes)"
        yield "road_map.roadblock_of", f"has no roadblock of on-route {_some(without)}: {how}"
    if beside := sorted({blocks[lane_id] for lane_id in route.lane_ids} - set(route.roadblock_ids)):
        yield "route.roadblock_ids", f"lacks the roadblocks of on-route lanes: {_some(beside)}"


def _light_faults(clip: Clip) -> Iterator[Fault]:
    lights = clip.lights
    if not lights.lane_ids:
        return
    yield from _shape("lights.states", lights.states, (CLIP_STEPS, len(lights.lane_ids)))
    if strange := sorted(set(np.unique(lights.states).tolist()) - {int(state) for state in LightState}):
        yield "lights.states", f"{_some(strange)}: expected tasks.world.road_map.LightState"


def _sensor_faults(clip: Clip) -> Iterator[Fault]:
    if any(not isinstance(camera, Camera) for camera in clip.cameras):
        yield "cameras", "expected tasks.world.clip.Camera"
    names = [camera.name for camera in clip.cameras]
    if len(set(names)) != len(names):
        yield "cameras", "a name stands twice"
    for camera in (*clip.cameras, *(clip.block.other_cameras if clip.block else ())):
        if sign := camera_sign(camera):
            yield f"cameras.{camera.name}", sign
    if uncalibrated := sorted({image.sensor for image in clip.images} - set(names)):
        yield "images", f"no calibration of camera {uncalibrated}"
    for kind in ("images", "sweeps"):
        for i, file in enumerate(getattr(clip, kind)):
            yield from _array(f"{kind}[{i}].world_from_ego", file.world_from_ego, (4, 4))
            step = min(max(round(file.time_s / STEP_S), 0), CLIP_STEPS - 1)
            if sign := place_sign(file.world_from_ego[None], clip.ego_states[step, None]):
                yield f"{kind}[{i}].world_from_ego", sign
            if file.ego_from_sensor is not None and (sign := mount_sign(file.ego_from_sensor)):
                yield f"{kind}[{i}].ego_from_sensor", sign


def _shape(field: str, array: Any, shape: tuple[int | None, ...]) -> Iterator[Fault]:
    """None: any number of them."""
    if not isinstance(array, np.ndarray):
        yield field, f"is a {type(array).__name__}, expected an array"
    elif array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        yield field, f"shape {array.shape}, expected ({expected}{',' if len(shape) == 1 else ''})"


def _array(field: str, array: Any, shape: tuple[int | None, ...]) -> Iterator[Fault]:
    yield from _shape(field, array, shape)
    if not (np.abs(array) <= LARGEST).all():
        yield field, f"not finite, or above {LARGEST:g}"


def _ring(field: str, ring: Any) -> Iterator[Fault]:
    yield from _array(field, ring, (None, 2))
    if len(ring) < 4:
        yield field, f"{len(ring)} points: a closed ring has four or more"


def _polyline(field: str, line: Any) -> Iterator[Fault]:
    yield from _array(field, line, (None, 3))
    if len(line) < 2:
        yield field, f"{len(line)} points: a line has two or more"


def _some(names: Sequence[object]) -> str:
    """The first few of many."""
    first = ", ".join(name if isinstance(name, str) else shown(name) for name in names[:3])
    return first + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def id_text(value: object) -> str | None:
    """What names a thing in a file, as text: a text or a whole number; None of all that names nothing.

    `str` would make one thing of all those whose id is None, NaN or empty.
    """
    if isinstance(value, str):
        return str(value) if value.strip() else None
    return str(int(value)) if isinstance(value, Integral) and not isinstance(value, bool) else None


# What gives away that a log's calibration, poses or stamps mean something else: numbers that pass every other check.
#
# Each function says what it saw, with its number, and what helps; None: nothing gives it away. Numbers beside the
# limits are those of 26 real cameras and ten real logs (Argoverse 2, nuPlan, nuScenes).

MOST_TILT_RAD = np.radians(60.0)  # between the image's top and the vertical; 3 deg
BESIDE_VEHICLE_M = 2.0  # around the Pacifica's box, which leaves room for a truck; all cameras are within it
LOW_M, HIGH_M = -0.5, 4.5  # above the rear axle; 1.2 to 1.5
LEAST_M = 0.4  # from the rear axle, of one that is thought to be in another unit; 1.4
NARROW, WIDE = 0.1, 20.0  # focal length in image widths; 0.8 to 1.2. 0.1 is 157 deg, 20 is 3 deg
OFF_CENTRE = 0.2  # of width and height, the principal point in both; 0.02


def camera_sign(camera: Camera) -> str | None:
    """Of a camera that looks at the sky or the ground, lies on its side, stands beside the car, or has another K."""
    pose = camera.ego_from_camera
    if not _is_upright(pose):
        elevation = float(np.degrees(np.arcsin(np.clip(pose[2, 2], -1.0, 1.0))))
        tilt = float(np.degrees(np.arccos(np.clip(-pose[2, 1], -1.0, 1.0))))
        looks = f"looks at the {'sky' if elevation > 0.0 else 'ground'}, {elevation:.0f} deg above the horizon"
        said = looks if abs(elevation) > np.degrees(MOST_TILT_RAD) else f"its image's top is {tilt:.0f} deg off upright"
    elif not _is_on_vehicle(pose[:3, 3]):
        said = _place_sign(pose[:3, 3])
    else:
        return _intrinsics_sign(camera)
    inverse = np.asarray(np.linalg.inv(pose), np.float64)
    if _is_upright(inverse) and _is_on_vehicle(inverse[:3, 3]):
        said += ", its inverse would be right"
    return f"{said}: expected ego from camera, in metres, camera x right, y down, z forward"


def _is_upright(pose: Array) -> bool:
    return bool(-pose[2, 1] >= np.cos(MOST_TILT_RAD))


def mount_sign(mount: Array) -> str | None:
    """Of a lidar (4, 4) on the ego that stands beside the car; its axes may be any."""
    if _is_on_vehicle(mount[:3, 3]):
        return None
    return f"{_place_sign(mount[:3, 3])}: expected ego from lidar, in metres"


def _is_on_vehicle(place: Array) -> bool:
    x, y, z = place
    along = abs(x - PACIFICA.rear_axle_to_center) <= PACIFICA.half_length + BESIDE_VEHICLE_M
    return bool(along and abs(y) <= PACIFICA.half_width + BESIDE_VEHICLE_M and LOW_M <= z <= HIGH_M)


def _place_sign(place: Array) -> str:
    x, y, z = place
    said = f"stands {x:,.1f} m ahead, {y:,.1f} m left and {z:,.1f} m above the rear axle, not on the vehicle"
    for unit, metres in (("centimetres", 0.01), ("millimetres", 0.001)):
        if np.linalg.norm(place * metres) > LEAST_M and _is_on_vehicle(place * metres):
            return f"{said}, which it were in {unit}"
    return said


def _intrinsics_sign(camera: Camera) -> str | None:
    k = camera.intrinsics
    focal = k[0, 0] / camera.width
    if not NARROW <= focal <= WIDE:
        fov = 2.0 * np.degrees(np.arctan(0.5 / focal))
        said = f"a focal length of {k[0, 0]:,.3g} px in an image {camera.width} px wide sees {fov:.0f} deg"
        return f"{said}: expected pixels of this image"
    off = np.abs([k[0, 2] / camera.width - 0.5, k[1, 2] / camera.height - 0.5])
    if off.min() > OFF_CENTRE:
        said = f"the principal point ({k[0, 2]:,.0f}, {k[1, 2]:,.0f}) px is far off the centre of the image"
        return f"{said}, {camera.width} x {camera.height} px: expected the intrinsics of images of this size"
    return None


FAR_M = 100.0  # of a whole drive from any lane, and of two poses at one instant
MOVING_MPS, MOVING_STEPS = 1.0, 10
OFF_MOTION_RAD = 0.35  # of headings, the median of the steps that move; 0.003 to 0.016
REVERSING_MPS = 5.0  # faster, nobody drives backwards
FASTEST_MPS = 80.0


def motion_sign(ego_states: Array) -> str | None:
    """Of an ego (S, 11), every 0.1 s, whose headings are not along its motion, or whose places are in another unit."""
    moved, headings = np.diff(ego_states[:, [X, Y]], axis=0), ego_states[:, HEADING]
    speeds = np.hypot(*moved.T) / STEP_S
    moving = speeds > MOVING_MPS  # false next to absent steps
    if moving.sum() < MOVING_STEPS:
        return None
    if (usual := float(np.median(speeds[moving]))) > FASTEST_MPS:
        return f"the ego drives at {usual:,.0f} m/s (median): expected places in metres and stamps of the right unit"
    between = headings[:-1] + wrap_angle(np.diff(headings)) / 2.0
    off = float(np.median(np.abs(wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - between))[moving]))
    if off <= OFF_MOTION_RAD or (off >= np.pi - OFF_MOTION_RAD and speeds[moving].max() <= REVERSING_MPS):
        return None
    said = f"headings are {np.degrees(off):.0f} deg off the direction of motion (median of {moving.sum()} steps)"
    expected = "expected radians from x, counter-clockwise, of the ego's axis that points forward"
    return f"{said}: {expected}; are they degrees, clockwise, or of a quaternion in another order?"


def place_sign(world_from_ego: Array, ego_states: Array) -> str | None:
    """Of poses in space (S, 4, 4) that are elsewhere than the ego (S, >= 2) at the same instants."""
    apart = float(np.hypot(*(world_from_ego[:, :2, 3] - ego_states[:, :2]).T).max())
    if apart <= FAR_M:
        return None
    return f"up to {apart:,.0f} m from where ego_states have the ego: expected its poses in the same world frame"


def map_sign(poses: Array, road_map: RoadMap) -> str | None:
    """Of a drive (S, >= 2) [m] that lies nowhere near a lane of its map."""
    if not len(poses) or not road_map.lanes:
        return None
    places, lanes = poses[::10, :2], np.concatenate([lane.centerline[:, :2] for lane in road_map.lanes.values()])
    away = min(float(np.hypot(*(lanes - place).T).min()) for place in places)
    if away <= FAR_M:
        return None
    return (
        f"the drive ({_extent(poses)}) is nowhere nearer than {away:,.0f} m to a lane of the map ({_extent(lanes)}): "
        "its poses are in another frame or unit than the map"
    )


def _extent(points: Array) -> str:
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return f"x {x0:,.0f} to {x1:,.0f}, y {y0:,.0f} to {y1:,.0f} m"


UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAST_APART_S, MOST_APART_S = 2e-3, 5.0  # of poses, frames and photos; 6e-3 to 0.6
USUAL_APART_S = 0.1


def stamps_sign(stamps: Array | Ints, unit: str) -> str | None:
    """Of stamps (n,) that come at an impossible rate in their unit, "s" to "ns", and at a usual one in another."""
    apart = np.diff(np.unique(stamps))
    if not len(apart):
        return None
    usual = float(np.median(apart))
    if LEAST_APART_S <= usual * UNITS_S[unit] <= MOST_APART_S:
        return None
    others = [name for name, unit_s in UNITS_S.items() if LEAST_APART_S <= usual * unit_s <= MOST_APART_S]
    if not others:
        return None
    other = min(others, key=lambda name: abs(np.log(usual * UNITS_S[name] / USUAL_APART_S)))
    said = f"stamps are {usual * UNITS_S[unit]:.3g} s apart, and {usual * UNITS_S[other]:.3g} s if they were in {other}"
    return f"{said}: expected {unit}"
