"""What NAVSIM pickles, as typed 2 Hz frames: an OpenScene log, and a synthetic scene of the second stage.

Keys, units and frames are those that the public reader takes (autonomousvision/navsim @ 0a380a9,
navsim/common/dataclasses.py); keys it does not read are not looked at. The pickle is data: nothing of it runs
(`factory.readers.pickles`).
"""

from collections.abc import Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factory.readers.base import BadClip, bytes_of, id_text, stamps_sign
from factory.readers.pickles import Record, load_plain, load_records
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.clip import AgentKind
from tasks.world.frames import to_local, wrap_angle
from tasks.world.repair.records import LEFT_OUT, Repair
from tasks.world.repair.tracks import MOST, increasing, whole_frames

# Values out of a pickled dict, checked one by one: what is wrong names file, frame and key.

MISSING = object()


@dataclass(frozen=True)
class CheckedValues:
    """The items of one dict; `place` says where it stands in the file, as `frames[3].`."""

    items: Mapping[Any, Any]
    file: str
    place: str = ""

    def bad(self, key: str, problem: str) -> BadClip:
        """The error that names the key."""
        return BadClip(self.file, f"{self.place}{key}", problem)

    def get(self, key: str, default: Any = MISSING) -> Any:
        """The value as it stands, or the default where the key is missing; without one that raises BadClip."""
        value = self.items.get(key, default)
        if value is MISSING:
            raise self.bad(key, "missing")
        return value

    def inner(self, key: str) -> "CheckedValues":
        """A dict within. Raises BadClip."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            raise self.bad(key, f"is a {type(value).__name__}, expected a dict")
        return CheckedValues(value, self.file, f"{self.place}{key}.")

    def text(self, key: str, *, may_be_empty: bool = False) -> str:
        """Raises BadClip where it is no text, or empty and must not be."""
        value = self.get(key)
        if not isinstance(value, str):
            raise self.bad(key, f"is a {type(value).__name__}, expected text")
        if not value and not may_be_empty:
            raise self.bad(key, "is empty")
        return str(value)

    def integer(self, key: str) -> int:
        """Python's or numpy's. Raises BadClip."""
        value = self.get(key)
        if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
            raise self.bad(key, f"is {shown(value)}, expected a whole number")
        return int(value)

    def numbers(self, key: str, shape: tuple[int | None, ...], whole: bool = True) -> Array:
        """A list or an array of numbers as float64, never a view of another's; None: any length; whole: finite ones.

        Raises BadClip.
        """
        value = self.get(key)
        try:
            array = np.array(value, np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.bad(key, f"holds no numbers ({shown(value)})") from error
        if array.size == 0 and shape[0] is None:  # an empty list says nothing of its columns
            array = array.reshape(0, *(n or 0 for n in shape[1:]))
        if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
            raise self.bad(key, f"shape {array.shape}, expected ({', '.join(str(n or 'N') for n in shape)})")
        if whole and not np.isfinite(array).all():
            raise self.bad(key, "holds NaN or infinity")
        return array

    def items_of(self, key: str) -> tuple[Any, ...]:
        """What a list, tuple or array holds. Raises BadClip."""
        value = self.get(key)
        if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
            raise self.bad(key, f"is a {type(value).__name__}, expected a list of text")
        return tuple(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """A list, tuple or array of text. Raises BadClip."""
        value = self.items_of(key)
        for item in value:
            if not isinstance(item, str):
                raise self.bad(key, f"holds {shown(item)}, expected text")
        return tuple(map(str, value))


CAMERA_NAMES = ("CAM_F0", "CAM_L0", "CAM_L1", "CAM_L2", "CAM_R0", "CAM_R1", "CAM_R2", "CAM_B0")
COMMANDS = ("left", "straight", "right", "unknown")  # the one-hot's order; NAVSIM says forward for straight
KIND_OF_NAME = {kind.value.lower(): kind for kind in AgentKind}  # vehicle, pedestrian, ..., generic_object
LOCATION_OF_ALIAS = {"las_vegas": "us-nv-las-vegas-strip"}
UNIT_SLACK = 1e-3  # of a quaternion's length
FRAME_US = 500_000
LATEST_US = 250_000  # after or before its frame a camera takes its picture, at most


@dataclass(frozen=True)
class FrameCamera:
    """One camera at one frame. Camera frame: x right, y down, z forward; its picture is distorted."""

    name: str  # of CAMERA_NAMES
    path: str  # of the JPEG below the folder of sensor blobs
    intrinsics: Array  # (3, 3) pixels, of the distorted picture
    distortion: Array  # (5,) k1, k2, p1, p2, k3
    ego_from_camera: Array  # (4, 4); OpenScene calls it sensor2lidar, its lidar frame is the ego frame
    late_s: float = 0.0  # when it took its picture, after the frame's stamp
    world_from_ego: Array | None = None  # (4, 4) then; None: the frame's


@dataclass(frozen=True)
class FrameBoxes:
    """N annotated boxes of one frame, in the ego frame (rear axle, x forward, y left, z up)."""

    boxes: Array  # (N, 7) centre x, y, z, length, width, height [m], heading [rad], not wrapped
    kinds: tuple[AgentKind, ...]  # (N,)
    velocities: Array  # (N, 3) [m/s], over ground, along the ego's axes
    track_tokens: tuple[str, ...]  # (N,) identity over time, unique within a frame


@dataclass(frozen=True)
class Frame:
    """One 2 Hz frame of a log."""

    token: str
    timestamp_us: int  # microseconds, Unix
    log_name: str
    scene_token: str
    map_location: str
    roadblock_ids: tuple[str, ...]  # of the planned route, in order, may repeat; empty: none is known
    pose: Array  # (3,) rear axle x, y [m], heading [rad] in the map's UTM frame
    world_from_ego: Array  # (4, 4) the same in space
    dynamic_state: Array  # (4,) vx, vy [m/s], ax, ay [m/s2] of the rear axle along the ego's axes
    lights: tuple[tuple[str, bool], ...]  # lane connector, whether it is red; yellow and unknown are not
    ego_status: CheckedValues  # with the log's own driving_command, which clips do not use: looked at when it is
    cameras: tuple[FrameCamera, ...]  # in the order of CAMERA_NAMES; those that the log gives a picture of
    lidar_path: str | None  # of the merged sweep below the folder of sensor blobs
    boxes: FrameBoxes | None  # None: nobody annotated the frame
    repairs: tuple[Repair, ...] = ()  # of its boxes, at time 0
    unreadable: str = ""  # why the one that stands here cannot be read: this is its neighbour, without boxes and blobs

    @property
    def command(self) -> str:
        """The log's own, of COMMANDS. Raises BadClip."""
        return parse_command(self.ego_status)


@dataclass(frozen=True)
class LogFrames:
    """The frames of one log in time order, timestamps strictly increasing.

    One that cannot be read stands as `unreadable`, which no clip holds.
    """

    file: str
    name: str
    frames: tuple[Frame, ...]  # one or more


def read_frames(path: Path, whole: bool = True) -> LogFrames:
    """The log in this pickle; whole: as of parse_frames. Raises BadClip, naming frame and key."""
    return parse_frames(load_plain(bytes_of(path), str(path)), path, whole)


def parse_frames(value: Any, path: Path, whole: bool = True) -> LogFrames:
    """What a log's pickle holds, checked. Raises BadClip.

    whole: every frame and box has to be right. Else boxes and frames that are not are left out, and the log is refused
    where that is most of its frames.
    """
    file = str(path)
    if not isinstance(value, list) or not value:
        raise BadClip(file, "frames", f"holds a {type(value).__name__}, expected a list of frames, one or more")
    frames: dict[int, Frame] = {}
    wrong: dict[int, BadClip] = {}
    for i, item in enumerate(value):
        try:
            frames[i] = parse_frame(item, file, f"frames[{i}].", whole)
        except BadClip as error:
            wrong[i] = error
    if sign := stamps_sign(np.array([frames[i].timestamp_us for i in sorted(frames)]), "us"):
        raise BadClip(file, "frames.timestamp", sign)
    for i, problem in _out_of_place(frames, path):
        wrong[i] = problem
        frames.pop(i, None)
    for i in _away(frames) if frames and not whole else ():
        wrong[i] = BadClip(file, f"frames[{i}].ego2global_translation", "the ego lies away from the frames around it")
        frames.pop(i)
    if wrong and (whole or len(wrong) > MOST * len(value)):
        raise wrong[min(wrong)]
    if len({frame.map_location for frame in frames.values()}) > 1:
        raise BadClip(file, "map_location", "changes within the log")
    known = np.array(sorted(frames))
    stamps = np.array([frames[i].timestamp_us for i in known])
    for i in sorted(wrong):
        k = int(np.searchsorted(known, i))
        if 0 < k < len(known) and stamps[k] - stamps[k - 1] < FRAME_US * (known[k] - known[k - 1] - 0.5):
            continue  # no frame is missing between those around it, as where one stands twice
        at = int(known[np.argmin(np.abs(known - i))])
        near, stamp = frames[at], frames[at].timestamp_us + FRAME_US * (i - at)
        named = replace(near, token=f"unreadable-{i}", timestamp_us=stamp, unreadable=str(wrong[i]))
        frames[i] = replace(named, cameras=(), lidar_path=None, boxes=None)
    return LogFrames(file, path.stem, _with_late_cameras([frames[i] for i in sorted(frames)]))


def _with_late_cameras(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """The same, cameras that took their pictures beside the frame's stamp knowing where: the ego drives on as from the
    frame before to the one after."""
    if not any(camera.late_s for frame in frames for camera in frame.cameras):
        return tuple(frames)
    read = [frame for frame in frames if not frame.unreadable]
    at_s = np.array([frame.timestamp_us - read[0].timestamp_us for frame in read]) / 1e6
    place = {frame.token: k for k, frame in enumerate(read)}

    def pose(k: int, late_s: float) -> Array:
        before, after = max(k - 1, 0), min(k + 1, len(read) - 1)
        first, second, here = (read[i].world_from_ego for i in (before, after, k))
        share, out = late_s / (at_s[after] - at_s[before]) if after > before else 0.0, here.copy()
        turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
        out[:3, :3] = here[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        out[:3, 3] += share * (second[:3, 3] - first[:3, 3])
        return out

    return tuple(
        replace(
            frame,
            cameras=tuple(
                replace(c, world_from_ego=pose(place[frame.token], c.late_s)) if c.late_s else c for c in frame.cameras
            ),
        )
        for frame in frames
    )


def _out_of_place(frames: Mapping[int, Frame], path: Path) -> Iterator[tuple[int, BadClip]]:
    """The frames that do not belong where they stand, and why."""
    file = str(path)
    order = sorted(frames)
    in_time = {order[k] for k in increasing(np.array([frames[i].timestamp_us for i in order], np.float64))}
    seen: set[str] = set()
    for i in order:
        frame = frames[i]
        if i not in in_time:
            yield i, BadClip(file, f"frames[{i}].timestamp", "time does not go on")
        elif frame.log_name != path.stem:  # NAVSIM finds logs by the one and scenes by the other
            problem = f"is {shown(frame.log_name)}, but the file is named {path.stem!r}: rename the file"
            yield i, BadClip(file, f"frames[{i}].log_name", problem)
        elif frame.token in seen:
            yield i, BadClip(file, "token", f"{frame.token} stands twice")
        else:
            seen.add(frame.token)


def _away(frames: Mapping[int, Frame]) -> list[int]:
    """The frames whose ego cannot have come from the one before and go on to the next."""
    order = np.array(sorted(frames), int)
    boxes = np.ones((len(order), 9))
    boxes[:, :2] = np.array([frames[i].pose[:2] for i in order]).reshape(-1, 2)
    left, _ = whole_frames(np.array([frames[i].timestamp_us / 1e6 for i in order]), boxes)
    return [int(i) for i in order[~left]]


def parse_frame(item: Any, file: str, place: str, whole: bool = True) -> Frame:
    """One frame's dict, checked; `place` names it in errors; whole: as of parse_frames. Raises BadClip."""
    if not isinstance(item, Mapping):
        raise BadClip(file, place.rstrip("."), f"is a {type(item).__name__}, expected a dict")
    values = CheckedValues(item, file, place)
    translation = values.numbers("ego2global_translation", (3,))
    pose, world_from_ego = parse_pose(values, "ego2global_rotation", translation)
    location, lidar_path = values.text("map_location"), values.get("lidar_path")  # None or empty: no lidar
    boxes, repairs = parse_boxes(values.inner("anns"), whole=whole) if item.get("anns") is not None else (None, ())
    return Frame(
        token=values.text("token"),
        timestamp_us=values.integer("timestamp"),
        log_name=values.text("log_name"),
        scene_token=values.text("scene_token"),
        map_location=LOCATION_OF_ALIAS.get(location, location),
        roadblock_ids=values.texts("roadblock_ids"),
        pose=pose,
        world_from_ego=world_from_ego,
        dynamic_state=values.numbers("ego_dynamic_state", (4,)).astype(np.float32).astype(np.float64),  # as NAVSIM does
        lights=parse_lights(values),
        ego_status=only_command(values),
        cameras=parse_cameras(values.inner("cams"), values.integer("timestamp")),
        lidar_path=None if lidar_path is None else values.text("lidar_path", may_be_empty=True) or None,
        boxes=boxes,
        repairs=repairs,
    )


def parse_pose(values: CheckedValues, key: str, translation: Array) -> tuple[Array, Array]:
    """The pose (3,) and its matrix (4, 4) by the quaternion w, x, y, z under `key`. Raises BadClip.

    The heading is the public reader's, pyquaternion's first Tait-Bryan angle of R = Rx Ry Rz. In a frame that is
    tilted it is not the direction of the ego's forward axis on the ground, by the product of roll and pitch.
    """
    quaternion = values.numbers(key, (4,))
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > UNIT_SLACK:
        raise values.bad(key, f"a quaternion w, x, y, z of length {length:.4g}, expected 1")
    w, x, y, z = quaternion / length
    heading = np.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y**2 + z**2))
    world_from_ego = np.eye(4)
    world_from_ego[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    world_from_ego[:3, 3] = translation
    return np.array([translation[0], translation[1], heading]), world_from_ego


def parse_lights(values: CheckedValues) -> tuple[tuple[str, bool], ...]:
    """`traffic_lights`: (lane connector id, whether it is red) each. Raises BadClip."""
    lights = values.get("traffic_lights")
    if not isinstance(lights, list | tuple):
        raise values.bad("traffic_lights", f"is a {type(lights).__name__}, expected a list")
    out = []
    for light in lights:
        lane_id, is_red = light if isinstance(light, list | tuple) and len(light) == 2 else (None, None)
        name = id_text(lane_id)
        if name is None or not isinstance(is_red, bool | np.bool_ | int):
            raise values.bad("traffic_lights", f"holds {shown(light)}, expected (lane connector id, is_red)")
        out.append((name, bool(is_red)))
    return tuple(out)


def only_command(values: CheckedValues) -> CheckedValues:
    """The same without what is not the driving command."""
    return replace(values, items={key: value for key, value in values.items.items() if key == "driving_command"})


def parse_command(values: CheckedValues) -> str:
    """`driving_command`, the one-hot of left, forward, right, unknown (OpenDriveLab/OpenScene @ 7286074,
    DriveEngine/process_data/helpers/driving_command.py:57, 91-97). Raises BadClip.

    Of three places it lacks the last: unknown is a route that cannot be followed (ibid., 66-69), which NAVSIM's own
    page on agents does not know ("left, straight or right", autonomousvision/navsim @ 51cecd5, v0.1, line 13).
    """
    one_hot = values.numbers("driving_command", (None,)).tolist()
    if len(one_hot) not in (3, 4) or sorted(one_hot) != [*[0.0] * (len(one_hot) - 1), 1.0]:
        raise values.bad("driving_command", f"{one_hot} is no one-hot of left, forward, right, unknown")
    return COMMANDS[one_hot.index(1.0)]


def parse_cameras(cams: CheckedValues, timestamp_us: int | None = None) -> tuple[FrameCamera, ...]:
    """`cams`: all eight, by their names in any case; those without a picture are left out. Raises BadClip.

    A camera may have a stamp of its own, `timestamp`: nuPlan's take their pictures up to 40 ms apart, and who converts
    its database keeps that; OpenScene's own logs do not.
    """
    by_name = {key.upper(): key for key in cams.items if isinstance(key, str)}
    if missing := [name for name in CAMERA_NAMES if name not in by_name]:
        raise cams.bad(missing[0], "missing; a frame names all eight cameras, with {} for one that has no picture")
    found = []
    for name in CAMERA_NAMES:
        camera = cams.inner(by_name[name])
        named = camera.get("data_path", None)
        if named is None or (isinstance(named, str) and not named):  # else text() says what it is
            continue
        ego_from_camera = np.eye(4)
        ego_from_camera[:3, :3] = camera.numbers("sensor2lidar_rotation", (3, 3))
        ego_from_camera[:3, 3] = camera.numbers("sensor2lidar_translation", (3,))
        late_us = 0
        if timestamp_us is not None and camera.get("timestamp", None) is not None:
            late_us = camera.integer("timestamp") - timestamp_us
            if abs(late_us) > LATEST_US:
                raise camera.bad("timestamp", f"{late_us / 1e6:.3g} s from its frame's: expected microseconds of it")
        found.append(
            FrameCamera(
                name=name,
                path=camera.text("data_path"),
                intrinsics=camera.numbers("cam_intrinsic", (3, 3)),
                distortion=camera.numbers("distortion", (5,)),
                ego_from_camera=ego_from_camera,
                late_s=late_us / 1e6,
            )
        )
    return tuple(found)


def parse_boxes(
    anns: CheckedValues, names: Mapping[str, str] | None = None, whole: bool = True
) -> tuple[FrameBoxes, tuple[Repair, ...]]:
    """`anns`: five keys of equal length, and what was left out; whole: nothing is. Raises BadClip.

    names: other names of the five keys, as those of NAVSIM's own `Annotations`. Without `whole` values may be NaN or
    impossible, and boxes without a token, of no known class, or with the token of another are left out.
    """
    key = {name: (names or {}).get(name, name) for name in ("gt_boxes", "gt_names", "gt_velocity_3d")}
    boxes = anns.numbers(key["gt_boxes"], (None, 7), whole)
    n = len(boxes)
    velocities = anns.numbers(key["gt_velocity_3d"], (None, 3), whole)
    classes = anns.items_of(key["gt_names"]) if n else ()
    texts = anns.texts if whole else anns.items_of
    tokens, instances = texts("track_tokens"), texts("instance_tokens")
    rows: dict[str, Sized] = {key["gt_velocity_3d"]: velocities, key["gt_names"]: classes, "track_tokens": tokens}
    for name, column in {**rows, "instance_tokens": instances}.items():
        if len(column) != n:
            raise anns.bad(name, f"{len(column)} entries, but {n} boxes")
    if whole and (boxes[:, 3:6] <= 0.0).any():
        raise anns.bad(key["gt_boxes"], "a box has a size that is not positive")
    left: dict[str, int] = {}
    repairs: list[Repair] = []
    for row, (token, kind) in enumerate(zip(tokens, classes)):
        known = ", ".join(KIND_OF_NAME)
        if not isinstance(token, str) or not token.strip():
            repairs.append(Repair("token", f"box {row}", 0.0, f"the token {shown(token)}", LEFT_OUT))
            problem = "track_tokens", "holds an empty token, which tells no objects apart"
        elif not isinstance(kind, str) or kind not in KIND_OF_NAME:
            repairs.append(Repair("class", token, 0.0, f"the class {shown(kind)}", LEFT_OUT))
            problem = key["gt_names"], f"unknown class {kind if isinstance(kind, str) else shown(kind)}; known: {known}"
        elif token in left:
            repairs.append(Repair("twice", token, 0.0, "two boxes of one frame", "the first of them"))
            problem = "track_tokens", f"{token} stands twice in one frame"
        else:
            left[str(token)] = row
            continue
        if whole:
            raise anns.bad(*problem)
    at = list(left.values())
    return FrameBoxes(boxes[at], tuple(KIND_OF_NAME[classes[i]] for i in at), velocities[at], tuple(left)), tuple(
        repairs
    )


# A scene of NAVSIM's second stage: the pickle that `Scene.save_to_disk` writes, read without nuPlan's devkit.
#
# Four frames of history, as a log's, and what others do in the 4 s after them as objects of nuPlan's classes in the
# world's frame (autonomousvision/navsim @ 0a380a9, navsim/common/dataclasses.py:612-730). They are read as records:
# no class is imported, and one that is not listed here is refused.

HISTORY_FRAMES, FUTURE_FRAMES = 4, 8
PATHS = ("pathlib PosixPath", "pathlib PurePosixPath", "pathlib._local PosixPath")
CLASSES = (
    *PATHS,
    "nuplan.common.maps.maps_datatypes TrafficLightStatuses",
    "nuplan.common.maps.maps_datatypes TrafficLightStatusData",
    "nuplan.common.maps.maps_datatypes TrafficLightStatusType",
    "nuplan.planning.simulation.observation.observation_type DetectionsTracks",
    "nuplan.common.actor_state.tracked_objects TrackedObjects",
    "nuplan.common.actor_state.agent Agent",
    "nuplan.common.actor_state.static_object StaticObject",
    "nuplan.common.actor_state.scene_object SceneObjectMetadata",
    "nuplan.common.actor_state.tracked_objects_types TrackedObjectType",
    "nuplan.common.actor_state.oriented_box OrientedBox",
    "nuplan.common.actor_state.oriented_box Dimension",
    "nuplan.common.actor_state.state_representation StateSE2",
    "nuplan.common.actor_state.state_representation StateVector2D",
    "nuplan.common.actor_state.state_representation Point2D",
    "nuplan.common.actor_state.state_representation TimePoint",
)
RED = 2  # nuPlan's TrafficLightStatusType: green, yellow, red, unknown
KINDS = (  # nuPlan's TrackedObjectType, in its order
    *(AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.TRAFFIC_CONE),
    *(AgentKind.BARRIER, AgentKind.CZONE_SIGN, AgentKind.GENERIC_OBJECT),
)
ANNOTATIONS = {"gt_boxes": "boxes", "gt_names": "names", "gt_velocity_3d": "velocity_3d"}  # a log's key -> here


@dataclass(frozen=True)
class SyntheticScene:
    """A second-stage scene: four frames, and the objects and lights of up to eight more.

    The ego of the later frames is unknown: they stand at the pose of the fourth, in whose frame their boxes are. Boxes
    of later frames have no height above the ground (NaN).
    """

    file: str
    token: str  # of the fourth frame, 17 digits
    log_name: str
    original_scene: str | None  # token of the log's frame at the same time
    frames: tuple[Frame, ...]  # HISTORY_FRAMES and what follows


def read_scene_pickle(path: Path, *, as_shown: bool = False) -> SyntheticScene:
    """The scene in this pickle; as_shown: what an agent is shown, four frames without boxes, whatever else is there.

    Raises BadClip, naming frame and key.
    """
    file = str(path)
    value = load_records(bytes_of(path), file, CLASSES)
    if not isinstance(value, Mapping):
        raise BadClip(file, "scene", f"holds a {type(value).__name__}, expected a dict")
    values = CheckedValues(value, file)
    about = values.inner("scene_metadata")
    items = list_of(values, "frames")
    if len(items) != about.integer("num_history_frames") + about.integer("num_future_frames"):
        raise values.bad("frames", f"{len(items)}, the scene's metadata say otherwise")
    if about.integer("num_history_frames") != HISTORY_FRAMES:
        raise about.bad("num_history_frames", f"expected {HISTORY_FRAMES}")
    history = [
        _frame(CheckedValues(item, file, f"frames[{i}]."), about, as_shown=as_shown)
        for i, item in enumerate(items[:HISTORY_FRAMES])
    ]
    if history[-1].token != about.text("initial_token"):
        raise about.bad("initial_token", f"is not {history[-1].token}, the token of frames[{HISTORY_FRAMES - 1}]")
    original = "corresponding_original_scene"
    if original not in about.items:
        original = "corresponding_orignal_scene"  # v2.0's spelling
    return SyntheticScene(
        file=file,
        token=history[-1].token,
        log_name=about.text("log_name"),
        original_scene=None if about.items.get(original) is None else about.text(original),
        frames=(*history, *(() if as_shown else _later(values, history[-1]))),
    )


def _frame(values: CheckedValues, about: CheckedValues, *, as_shown: bool) -> Frame:
    """One frame's dict. Raises BadClip."""
    if not isinstance(values.items, Mapping):
        raise BadClip(values.file, values.place.rstrip("."), f"is a {type(values.items).__name__}, expected a dict")
    ego = values.inner("ego_status")
    if ego.get("in_global_frame") is not True:
        raise ego.bad("in_global_frame", "must be True: a scene's poses are the world's")
    pose = ego.numbers("ego_pose", (3,))
    location = about.text("map_name")
    motion = [ego.numbers(key, (2,)) for key in ("ego_velocity", "ego_acceleration")]
    return Frame(
        token=values.text("token"),
        timestamp_us=values.integer("timestamp"),
        log_name=about.text("log_name"),
        scene_token=about.text("scene_token"),
        map_location=LOCATION_OF_ALIAS.get(location, location),
        roadblock_ids=values.texts("roadblock_ids"),
        pose=pose,
        world_from_ego=_level(*pose),
        dynamic_state=np.concatenate(motion),
        lights=parse_lights(values),
        ego_status=only_command(ego),
        cameras=parse_cameras(
            CheckedValues(_paths_as_text(values.get("camera_dict")), values.file, f"{values.place}camera_dict.")
        ),
        lidar_path=None,
        boxes=None if as_shown else parse_boxes(values.inner("annotations"), ANNOTATIONS)[0],
    )


def _later(values: CheckedValues, now: Frame) -> list[Frame]:
    """The frames after the last, 0.5 s apart. Raises BadClip."""
    tracks, lights = list_of(values, "extended_detections_tracks"), list_of(values, "extended_traffic_light_data")
    if len(tracks) < FUTURE_FRAMES or len(lights) < FUTURE_FRAMES:
        found = f"{len(tracks)} and {len(lights)} of extended_traffic_light_data"
        raise values.bad("extended_detections_tracks", f"{found}, expected {FUTURE_FRAMES}: 4 s are driven")
    return [
        replace(
            now,
            token=f"{now.token}+{i}",
            timestamp_us=now.timestamp_us + i * FRAME_US,
            cameras=(),
            lights=_lights(values, light, f"extended_traffic_light_data[{i - 1}]"),
            boxes=_boxes(values, track, f"extended_detections_tracks[{i - 1}]", now),
        )
        for i, (track, light) in enumerate(zip(tracks[:FUTURE_FRAMES], lights), 1)
    ]


def _lights(values: CheckedValues, statuses: Any, place: str) -> tuple[tuple[str, bool], ...]:
    found = list_of(record_fields(values, statuses, ("TrafficLightStatuses",), place), "traffic_lights")
    out = []
    for k, light in enumerate(found):
        fields = record_fields(values, light, ("TrafficLightStatusData",), f"{place}.traffic_lights[{k}]")
        number = enum_number(fields, fields.get("status"), "TrafficLightStatusType", "status")
        out.append((str(fields.integer("lane_connector_id")), number == RED))
    return tuple(out)


def _boxes(values: CheckedValues, tracks: Any, place: str, now: Frame) -> FrameBoxes:
    """The objects of one instant, in the frame of the ego at now."""
    found = tracked_objects(values, tracks, place)
    local = to_local(now.pose, found.poses)
    c, s = np.cos(now.pose[2]), np.sin(now.pose[2])
    velocities = np.column_stack([found.velocities @ np.array([[c, -s], [s, c]]), np.zeros(len(local))])
    heights = np.full(len(local), np.nan)
    boxes = np.column_stack([local[:, :2], heights, found.sizes, wrap_angle(local[:, 2])])
    return FrameBoxes(boxes, found.kinds, velocities, found.track_tokens)


@dataclass(frozen=True)
class TrackedObjects:
    """N objects of nuPlan's classes at one instant, world frame."""

    poses: Array  # (N, 3) centre x, y [m], heading [rad]
    sizes: Array  # (N, 3) length, width, height [m]
    velocities: Array  # (N, 2) [m/s]; of things that stand 0
    kinds: tuple[AgentKind, ...]  # (N,)
    track_tokens: tuple[str, ...]  # (N,) unique


def tracked_objects(values: CheckedValues, tracks: Any, place: str) -> TrackedObjects:
    """What a record of nuPlan's `DetectionsTracks` holds; place: where it stands in the file. Raises BadClip."""
    holder = record_fields(values, tracks, ("DetectionsTracks",), place)
    found = list_of(inner_record(holder, "tracked_objects", "TrackedObjects"), "tracked_objects")
    poses, sizes, velocities = np.zeros((len(found), 3)), np.zeros((len(found), 3)), np.zeros((len(found), 2))
    kinds, names = [], []
    for k, item in enumerate(found):
        thing = record_fields(values, item, ("Agent", "StaticObject"), f"{place}.tracked_objects[{k}]")
        kind = "_tracked_object_type"
        number = enum_number(thing, thing.get(kind), "TrackedObjectType", kind)
        if not 0 <= number < len(KINDS):
            raise thing.bad(kind, f"is {number}, expected 0 .. {len(KINDS) - 1}")
        kinds.append(KINDS[number])
        names.append(inner_record(thing, "_metadata", "SceneObjectMetadata").text("track_token"))
        box = inner_record(thing, "_box", "OrientedBox")
        poses[k] = se2(inner_record(box, "_center", "StateSE2"))
        sizes[k] = [number_of(box, key) for key in ("_length", "_width", "_height")]
        if "_velocity" in thing.items:  # nuPlan's static objects have none
            velocities[k] = vector(inner_record(thing, "_velocity", "StateVector2D"))
    if len(set(names)) < len(names):
        raise values.bad(place, "a track stands twice")
    if (sizes <= 0.0).any():
        raise values.bad(place, "a box has a size that is not positive")
    return TrackedObjects(poses, sizes, velocities, tuple(kinds), tuple(names))


def record_fields(values: CheckedValues, record: Any, names: Sequence[str], place: str) -> CheckedValues:
    """The fields of an object of a class that is one of `names`. Raises BadClip."""
    if not isinstance(record, Record) or record.name not in names:
        got = record.name if isinstance(record, Record) else type(record).__name__
        raise values.bad(place, f"is a {got}, expected {' or '.join(names)}")
    return CheckedValues(record.state, values.file, f"{values.place}{place}.")


def inner_record(values: CheckedValues, key: str, name: str) -> CheckedValues:
    """The fields of the object under `key`, of the class `name`. Raises BadClip."""
    return record_fields(values, values.get(key), (name,), key)


def se2(values: CheckedValues) -> tuple[float, float, float]:
    """x, y [m], heading [rad] of a `StateSE2`. Raises BadClip."""
    return number_of(values, "x"), number_of(values, "y"), number_of(values, "heading")


def vector(values: CheckedValues) -> tuple[float, float]:
    """x, y of a `StateVector2D`. Raises BadClip."""
    return number_of(values, "_x"), number_of(values, "_y")


def enum_number(values: CheckedValues, member: Any, name: str, place: str) -> int:
    """The number of a member of the enumeration `name`. Raises BadClip."""
    if not isinstance(member, Record) or member.name != name or len(member.arguments) != 1:
        raise values.bad(place, f"is no {name}")
    return CheckedValues({place: member.arguments[0]}, values.file, values.place).integer(place)


def number_of(values: CheckedValues, key: str) -> float:
    """A finite number. Raises BadClip."""
    return float(values.numbers(key, ()))


def list_of(values: CheckedValues, key: str) -> list[Any]:
    """Raises BadClip where it is none."""
    found = values.get(key)
    if not isinstance(found, list):
        raise values.bad(key, f"is a {type(found).__name__}, expected a list")
    return found


def _paths_as_text(value: Any) -> Any:
    """With pathlib's paths as text."""
    if isinstance(value, Record) and f"{value.module} {value.name}" in PATHS:
        return str(Path(*map(str, value.arguments)))
    if isinstance(value, dict):
        return {key: _paths_as_text(item) for key, item in value.items()}
    return value


def _level(x: float, y: float, heading: float) -> Any:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    pose[:2, 3] = x, y
    return pose
