"""A window of 2 Hz frames as the parts of a clip: states, agents and lights at 10 Hz, the road, the sensors' files.

States are as the public code makes them; frame k stands at 0.5 k s, whatever its stamp.
Rules of docs/reward.md 2 (autonomousvision/navsim @ 0a380a9, metric_cache_processor.py:99-267): a
box and its velocity are placed by the ego pose of their frame and are linear in between in x, y, unwrapped heading, vx,
vy; size and class are those of the first frame. An object is there from its first to its last frame OF THE 4 S THAT ARE
JUDGED, and one that is seen in a single frame of them stands there at all of their steps. So the frames of a window are
taken in three parts that know nothing of each other: before T, T to T+H, T+H to T+2H. The step T itself holds what its
frame shows, as planners find it; an object of a single frame whose box would touch the ego there is left out, since the
public log replay drops it. A light holds its state until the next frame.

Between frames the ego's pose, velocity and acceleration are linear too. Steering and rates are 0, as there.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from factory.datasets.navsim.log import Frame, FrameBoxes
from factory.datasets.navsim.maps import open_city
from factory.datasets.navsim.settings import FRAME_STEPS
from factory.files import is_named, why_unread
from factory.readers.base import BadClip
from factory.readers.pictures import BadPicture, Size, jpeg_size
from tasks.world.arrays import Array, Bools
from tasks.world.clip import (
    CLIP_STEPS,
    HISTORY_STEPS,
    HORIZON_STEPS,
    MOVING_KINDS,
    STEP_S,
    AgentKind,
    AgentTracks,
    Camera,
    SensorFile,
)
from tasks.world.frames import AX, EGO_STATE_SIZE, HEADING, LARGEST, PACIFICA, VX, X, ego_boxes, touching, wrap_angle
from tasks.world.repair.records import Repair, repairs_within
from tasks.world.repair.tracks import HEADING as BOX_HEADING
from tasks.world.repair.tracks import Repairs, observed, repaired
from tasks.world.road_map import CenterlineFinder, LightState, NoRoute, RoadMap, Route, TrafficLights
from tasks.world.roadblocks import corrected_roadblocks, route_of_roadblocks

FRAMES_BEFORE = HISTORY_STEPS // FRAME_STEPS  # of T in a window
HORIZON_FRAMES = HORIZON_STEPS // FRAME_STEPS
WINDOW_FRAMES = (CLIP_STEPS - 1) // FRAME_STEPS + 1  # 20
BOX, VELOCITY, HEIGHT_AT = slice(0, 3), slice(3, 5), 5  # columns of what is linear between frames


@dataclass(frozen=True)
class SeenBoxes:
    """What F frames show of N objects, world frame; NaN where a frame does not show one."""

    track_ids: tuple[str, ...]  # (N,)
    kinds: tuple[AgentKind, ...]  # (N,)
    linear: Array  # (F, N, 6) centre x, y [m], unwrapped heading [rad], vx, vy [m/s], centre z [m]
    sizes: Array  # (F, N, 3) length, width, height [m]

    @property
    def valid(self) -> Bools:
        """(F, N)"""
        return np.isfinite(self.linear[..., 0])


def repaired_frames(frames: Sequence[Frame], first: int, stop: int) -> tuple[tuple[Frame, ...], Repairs]:
    """frames[first:stop] of frames 0.5 s apart with their boxes repaired, and what was done, timed since `first`.

    The frames around them say what two or three at an edge cannot, as whether a thing jumps there.
    """
    times_s = np.arange(len(frames), dtype=np.float64) * (STEP_S * FRAME_STEPS)
    boxes, ids, kinds = [np.zeros((0, 9))], list[str](), list[AgentKind]()
    counts = [0 if frame.boxes is None else len(frame.boxes.kinds) for frame in frames]
    for frame in frames:
        if frame.boxes is not None:
            own = frame.boxes.boxes
            with np.errstate(invalid="ignore"):  # of headings that are none: the passes leave those boxes out
                linear = _in_world(frame)
            linear[np.abs(own[:, 6]) > LARGEST, 2] = np.nan  # wrapped it would look like any other
            boxes.append(np.column_stack([linear[:, [0, 1, HEIGHT_AT, 2]], own[:, 3:6], linear[:, VELOCITY]]))
            ids += frame.boxes.track_tokens
            kinds += frame.boxes.kinds
    seen, _ = observed(times_s, times_s[np.repeat(np.arange(len(frames)), counts)], ids, kinds, np.concatenate(boxes))
    seen, repairs = repaired(seen, np.array([frame.pose for frame in frames]))
    at_parse = (replace(one, time_s=float(t)) for frame, t in zip(frames, times_s) for one in frame.repairs)
    row_of = np.cumsum([0, *counts])
    out = []
    for i, frame in enumerate(frames[first:stop], start=first):
        if frame.boxes is None:
            out.append(frame)
            continue
        rows = seen.rows[i]
        here = np.flatnonzero(rows >= 0)
        here = here[np.argsort(rows[here])]
        at = rows[here] - row_of[i]
        own = frame.boxes.boxes[at]
        turned = np.cos(seen.boxes[i, here, BOX_HEADING] - frame.pose[2] - own[:, 6]) < 0.0
        own[turned, 6] = wrap_angle(own[turned, 6] + np.pi)
        tokens = tuple(seen.track_ids[n] for n in here)
        kept = FrameBoxes(own, tuple(seen.kinds[n] for n in here), frame.boxes.velocities[at], tokens)
        out.append(replace(frame, boxes=kept))
    return tuple(out), repairs_from((*at_parse, *repairs), times_s[first], times_s[stop - 1])


def repairs_from(repairs: Repairs, first_s: float, last_s: float) -> Repairs:
    """Those that show from first_s to last_s, on a clock that begins at first_s."""
    return tuple(
        replace(one, time_s=max(one.time_s, first_s) - first_s, until_s=min(one.until_s, last_s) - first_s)
        for one in repairs_within(repairs, first_s, last_s)
    )


def n_steps(n_frames: int) -> int:
    """Steps of 0.1 s from the first of n frames to the last, both counted."""
    return FRAME_STEPS * (n_frames - 1) + 1


def ego_states(frames: Sequence[Frame]) -> Array:
    """Ego states (S, 11) from the first frame to the last."""
    known = np.zeros((len(frames), EGO_STATE_SIZE))
    known[:, X : HEADING + 1] = [frame.pose for frame in frames]
    known[:, HEADING] = np.unwrap(known[:, HEADING])
    known[:, VX : AX + 2] = [frame.dynamic_state for frame in frames]
    states = _between(known)
    states[:, HEADING] = wrap_angle(states[:, HEADING])
    return states


def world_from_ego(frames: Sequence[Frame]) -> Array:
    """Ego poses in space (S, 4, 4): linear in position, spherical in rotation."""
    known = np.stack([frame.world_from_ego for frame in frames])
    at = np.arange(n_steps(len(frames))) / FRAME_STEPS
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, 3] = _between(known[:, :3, 3])
    turned = Rotation.from_matrix(known[:, :3, :3])
    poses[:, :3, :3] = Slerp(np.arange(len(frames)), turned)(at).as_matrix() if len(frames) > 1 else turned.as_matrix()
    return poses


def traffic_lights(frames: Sequence[Frame], lane_ids: Collection[str] | None = None) -> TrafficLights:
    """The lights (S, L) that any frame names, unknown in frames that do not; lane_ids: of these alone, None: of all."""
    wanted = None if lane_ids is None else frozenset(lane_ids)
    of_frames = {lane_id for frame in frames for lane_id, _ in frame.lights}
    named = sorted(of_frames if wanted is None else of_frames & wanted)
    column = {lane_id: i for i, lane_id in enumerate(named)}
    known = np.full((len(frames), len(named)), LightState.UNKNOWN, np.int8)
    for row, frame in zip(known, frames):
        for lane_id, is_red in frame.lights:
            if lane_id in column and row[column[lane_id]] != LightState.RED:  # red where it is named twice
                row[column[lane_id]] = LightState.RED if is_red else LightState.GREEN
    return TrafficLights(tuple(named), known[np.arange(n_steps(len(frames))) // FRAME_STEPS])


def window_agents(frames: Sequence[Frame]) -> AgentTracks:
    """The objects of a window of 20 frames over its 96 steps, as the module says."""
    assert len(frames) == WINDOW_FRAMES
    now, later, end = FRAMES_BEFORE, FRAMES_BEFORE + HORIZON_FRAMES, WINDOW_FRAMES
    seen = _seen(frames, (*range(now, later + 1), *range(now), *range(later + 1, end)))  # T's horizon has the first say
    agents = _nowhere(seen, CLIP_STEPS)
    for first, last, judged in ((0, now, False), (later, end - 1, True), (now, later, True)):
        _fill_agent_steps(agents, seen, frames, first, last, judged)
    return agents


def stretch_agents(frames: Sequence[Frame]) -> AgentTracks:
    """The objects of any number of frames, each from its first frame to its last."""
    seen = _seen(frames, range(len(frames)))
    agents = _nowhere(seen, n_steps(len(frames)))
    _fill_agent_steps(agents, seen, frames, 0, len(frames) - 1, False)
    return agents


def _between(known: Array) -> Array:
    """Rows (F, ...) at frames as rows (S, ...) at steps, linear."""
    at = np.arange(n_steps(len(known)))
    before = np.minimum(at // FRAME_STEPS, max(len(known) - 2, 0))
    share = (at / FRAME_STEPS - before).reshape(-1, *[1] * (known.ndim - 1))
    after = np.minimum(before + 1, len(known) - 1)
    return np.asarray(known[before] + share * (known[after] - known[before]))


def _seen(frames: Sequence[Frame], order: Sequence[int]) -> SeenBoxes:
    """The objects of frames; order: in which the frames say what an object is. A frame without boxes shows none."""
    kind_of: dict[str, AgentKind] = {}
    for boxes in (frames[i].boxes for i in order):
        if boxes is not None:
            for track_id, kind in zip(boxes.track_tokens, boxes.kinds):
                kind_of.setdefault(track_id, kind)
    column = {track_id: i for i, track_id in enumerate(kind_of)}
    linear = np.full((len(frames), len(column), 6), np.nan)
    sizes = np.full((len(frames), len(column), 3), np.nan)
    for row, frame in enumerate(frames):
        if frame.boxes is not None:
            at = [column[track_id] for track_id in frame.boxes.track_tokens]
            linear[row, at] = _in_world(frame)
            sizes[row, at] = frame.boxes.boxes[:, 3:6]
    stands = np.array([kind not in MOVING_KINDS for kind in kind_of.values()], bool)
    linear[:, stands, VELOCITY] = 0.0  # a thing that stands has no velocity in the public code, whatever the log says
    return SeenBoxes(tuple(kind_of), tuple(kind_of.values()), linear, sizes)


def _in_world(frame: Frame) -> Array:
    """(N, 6) as in `SeenBoxes.linear`: turned by the ego's heading alone, the height by its whole pose."""
    assert frame.boxes is not None
    boxes, velocities = frame.boxes.boxes, frame.boxes.velocities
    (x, y, heading), space = frame.pose, frame.world_from_ego
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [
            boxes[:, 0] * c - boxes[:, 1] * s + x,
            boxes[:, 0] * s + boxes[:, 1] * c + y,
            wrap_angle(boxes[:, 6] + heading),
            velocities[:, 0] * c - velocities[:, 1] * s,
            velocities[:, 0] * s + velocities[:, 1] * c,
            boxes[:, :3] @ space[2, :3] + space[2, 3],
        ]
    )


def _nowhere(seen: SeenBoxes, steps: int) -> AgentTracks:
    """Tracks that are absent at all steps."""
    n = len(seen.track_ids)
    known = seen.valid
    first = np.argmax(known, axis=0)
    return AgentTracks(
        track_ids=seen.track_ids,
        kinds=seen.kinds,
        boxes=np.full((steps, n, 5), np.nan),
        velocities=np.full((steps, n, 2), np.nan),
        valid=np.zeros((steps, n), bool),
        center_z=np.full((steps, n), np.nan),
        heights=seen.sizes[first, np.arange(n), 2],
    )


def _fill_agent_steps(
    agents: AgentTracks, seen: SeenBoxes, frames: Sequence[Frame], first: int, last: int, judged: bool
) -> None:
    """Frames first..last into the steps from the one to the other, whatever stood there."""
    steps = slice(FRAME_STEPS * first, FRAME_STEPS * last + 1)
    at = np.arange(n_steps(last - first + 1))
    known = seen.valid[first : last + 1]
    agents.valid[steps] = False
    for column in (agents.boxes, agents.velocities, agents.center_z):
        column[steps] = np.nan
    for i in np.flatnonzero(known.any(axis=0)):
        shown = np.flatnonzero(known[:, i])
        here = (at >= FRAME_STEPS * shown[0]) & (at <= FRAME_STEPS * shown[-1])
        rows = seen.linear[first + shown, i]
        rows[:, 2] = np.unwrap(rows[:, 2])
        size = seen.sizes[first + shown[0], i]
        if judged and len(shown) == 1:
            here = (at > 0) | (shown[0] == 0)  # at all steps that are judged, but for the first ...
            box = np.concatenate([rows[0, BOX], size[:2]])
            if not here[0] and bool(touching(box, ego_boxes(_rear_axle(frames[first]), PACIFICA))):
                continue  # ... and never where it would touch the ego at that one
        linear = np.stack([np.interp(at[here], FRAME_STEPS * shown, column) for column in rows.T], axis=1)
        step = np.arange(steps.start, steps.stop)[here]
        agents.valid[step, i] = True
        agents.boxes[step, i, :3], agents.boxes[step, i, 3:] = linear[:, BOX], size[:2]
        agents.boxes[step, i, 2] = wrap_angle(linear[:, 2])
        agents.velocities[step, i], agents.center_z[step, i] = linear[:, VELOCITY], linear[:, HEIGHT_AT]


def _rear_axle(frame: Frame) -> Array:
    state = np.zeros(EGO_STATE_SIZE)
    state[X : HEADING + 1] = frame.pose
    return state


# The road around a drive in NAVSIM's frames, from nuPlan's maps.

MAP_RADIUS_M = 150.0  # around the drive: the reward's 100 m, and room for one that strays


@dataclass(frozen=True)
class RoadAhead:
    """The map around a drive and the way through it."""

    road_map: RoadMap
    route: Route
    centerline: Array  # (P, 3) from the lane of the pose at T along the route
    city_lanes: Collection[str] = ()  # ids of all lanes of the city
    repairs: tuple[Repair, ...] = ()  # what of the map is not as its file has it


def road_around(maps: Path, frame: Frame, along_xy: Array, pose: Array, file: str, number: int) -> RoadAhead:
    """The map around the drive (S, 2) and along its route; the route and its centre line from `pose` (3,) at `frame`.

    Lights count on the lanes of the log's own roadblocks, before the route is mended: the public metric cache
    gathers the one and the other so (metric_cache_processor.py, `_load_route_dicts` and `_build_pdm_observation`).
    file, number: of the frame there. Raises BadClip, which names both.
    """
    city = open_city(maps, frame.map_location)
    blocks = city.roadblocks
    try:
        passed = corrected_roadblocks(blocks, frame.roadblock_ids, pose)
        own = [block for block in frame.roadblock_ids if block in blocks.lanes_of]
        lit = frozenset(lane_id for block in own for lane_id in blocks.lanes_of[block])
        along = [lane_id for block in passed for lane_id in blocks.lanes_of.get(block, ())]
        road_map, repairs = city.road_map(along_xy, MAP_RADIUS_M, along)
        route = replace(route_of_roadblocks(road_map, frame.roadblock_ids, pose, blocks), lit_lane_ids=lit)
        centerline = CenterlineFinder(road_map, route).centerline_from(pose)
        return RoadAhead(road_map, route, centerline, city.lane_ids, repairs)
    except NoRoute as error:
        raise BadClip(file, f"frames[{number}].roadblock_ids", str(error)) from error


# The eight cameras of a frame as a clip's rig, and the blobs of frames as sensor files.
#
# NAVSIM's pictures are distorted and its K is that of the distorted picture. The factory keeps both in `Camera`, and
# whoever opens a photo takes the distortion out (`tasks.render.views.undistorted`), so scenes are built of pinholes.
#
# A download may hold the pictures of a few frames only: navtrain's current and history archives have none of the
# future. So a frame none of whose blobs is there has no pictures. A frame that has some and lacks others was damaged.

LIDAR = "lidar"
FRAME_S = 0.5


def sensor_files(frames: Sequence[Frame], folder: Path) -> tuple[tuple[SensorFile, ...], tuple[SensorFile, ...]]:
    """The pictures and sweeps below `folder` of frames 0.5 s apart, times from the first; of cameras with stamps of
    their own when and where these say. Raises BadClip."""
    images: list[SensorFile] = []
    sweeps: list[SensorFile] = []
    for k, frame in enumerate(frames):
        files = {camera.name: _below(folder, camera.path) for camera in frame.cameras}
        there = {name: path for name, path in files.items() if is_named(path)}  # a broken link is named later
        if there and (missing := [path for name, path in files.items() if name not in there]):
            problem = f"missing, though {len(there)} of the frame's {len(files)} pictures are there"
            raise BadClip(str(missing[0]), "image", f"{problem}: restore it, or remove them all")
        for camera in (camera for camera in frame.cameras if camera.name in there):
            pose = frame.world_from_ego if camera.world_from_ego is None else camera.world_from_ego
            images.append(SensorFile(camera.name, str(there[camera.name]), FRAME_S * k + camera.late_s, pose))
        if frame.lidar_path is not None and is_named(sweep := _below(folder, frame.lidar_path)):
            sweeps.append(SensorFile(LIDAR, str(sweep), FRAME_S * k, frame.world_from_ego))
    return tuple(images), tuple(sweeps)


def cameras_with_pictures(frame: Frame, images: Sequence[SensorFile], file: str) -> tuple[Camera, ...]:
    """The cameras of a frame that took any of the `images`, whose first tells their size. Raises BadClip."""
    first: dict[str, str] = {}
    for image in images:
        first.setdefault(image.sensor, image.uri)
    cameras = []
    for camera in frame.cameras:
        if camera.name in first:
            _, (width, height) = read_jpeg(Path(first[camera.name]))
            try:
                cameras.append(
                    Camera(camera.name, width, height, camera.intrinsics, camera.distortion, camera.ego_from_camera)
                )
            except ValueError as error:
                raise BadClip(file, f"cams.{camera.name}", str(error)) from error
    return tuple(cameras)


def read_jpeg(path: Path) -> tuple[bytes, Size]:
    """The file and its picture's width and height [px]. Raises BadClip."""
    try:
        data = path.read_bytes()
        return data, jpeg_size(data)
    except OSError as error:
        raise BadClip(str(path), "image", f"cannot be read: {why_unread(path, error)}") from error
    except BadPicture as error:
        raise BadClip(str(path), error.field, str(error)) from error


def _below(folder: Path, path: str) -> Path:
    """A path of the log, which may not lead out of the folder of blobs. Raises BadClip."""
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise BadClip(str(folder), path, "a log's sensor paths lie below the folder of sensor blobs")
    return folder / path
