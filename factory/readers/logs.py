"""The base of readers of whole logs: it finds the windows, keeps the last logs, cuts and validates the clips.

To write a reader, subclass `LogReader` and give it four things; AV2Reader has all of them, ScenarioNetReader the least:

* `logs()`: log id -> file or folder of every log under `self.root`; asked once a process;
* `drive(path)`: ego and agents every 0.1 s, all that the choice of windows needs. It runs over every log of the data
  set, so open no map and no sensor file;
* `load(path)`: the same, and the map, the route (`route_of_drive`), the lights: a `WholeLog`, or a subclass that keeps
  more;
* `recorded(log, start, stop)`: what else belongs to one window, which is the ego's pose in space, cameras and photos.

A fifth, `digest(ref) -> str`, is optional: the clip's content digest as `read` would give it, found without reading the
clip. With it a run sees that a log was changed though its clips lie prepared in the cache. A sixth, optional too,
`block(ref) -> str | None`, names the block that the clip is rendered from, as cheaply; with it the block is built once,
as a task of its own, before its clips are prepared.

Three more make a block's scene of other logs' drives through the same place as well (`traversals=N`): `world(path)`
names the frame that a log's poses are in where other logs share it, `block_steps(start)` gives the steps of a window's
block where that is longer than the window, and `log_digest(path)` the content digest of a log without loading it.

A format that may bring its reader down or never end, as pickles may, is `untrusted`: the index reads each log in
another process, one a core where there are many logs, and a log that kills it is broken as any other.

Wherever the input is broken, raise `BadClip(file, field, how to fix it)`. Units: metres, radians, seconds, one world
frame per log; the columns of ego states are named in tasks.world.frames, absent agents hold NaN and valid = False.
"""

import hashlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from factory.readers.apart import LOGS_PER_PROCESS, read_each
from factory.readers.base import (
    SPLITS,
    BadClip,
    ClipIndex,
    ClipRef,
    failures_as_bad_clip,
    map_sign,
    motion_sign,
    split_of,
    validate_clip,
)
from factory.readers.settings import LogClips, WindowSettings, check_traversals
from tasks.world.arrays import Array, Ints
from tasks.world.clip import (
    CLIP_STEPS,
    DRIVES_APART_S,
    NOW,
    OTHER_LOG,
    STEP_S,
    AgentTracks,
    Block,
    Camera,
    Clip,
    SensorFile,
)
from tasks.world.frames import VX, VY, X, Y
from tasks.world.repair.records import Repair, repairs_within
from tasks.world.repair.tracks import articulated
from tasks.world.road_map import CenterlineFinder, NoRoute, RoadMap, Route, TrafficLights, route_of_log

# Several logs of one place: which other drives lead through a block, and the block with what they saw.
#
# A block of one log has few photos of each thing at 2 Hz. Where other logs lead through the same place its scene is
# made of their photos and sweeps too. They are put onto the block's clock one after the other, `DRIVES_APART_S`
# between them, so that each has its own traffic, light and pose corrections; what the drives share is the street.
# What is theirs is named <log id>/<name>.

NEAR_M = 12.0  # between two drives on one street, on lanes of either direction
LEAST_M = 20.0  # of another drive beside the block's, or it is left out
SAMPLE_STEPS = 5  # a place of a drive is kept every 0.5 s
BROKEN_STEPS = 20  # as long may another drive be farther away in between
BLOCK_STEPS = 200  # 20 s, of a stretch that is reconstructed, and at most of another drive through it


@dataclass(frozen=True)
class DrivenPath:
    """Where a log's ego was, and in which world."""

    world: str  # name of the frame; logs with the same name share it
    steps: Ints  # (K,) ascending
    places: Array  # (K, 2) [m]


@dataclass(frozen=True)
class Traversal:
    """Steps start..stop-1 of a log, which lead through a block of another."""

    log_id: str
    start: int
    stop: int


@dataclass(frozen=True)
class OtherDrive:
    """What a traversal has."""

    log_id: str
    agents: AgentTracks
    cameras: tuple[Camera, ...]
    images: tuple[SensorFile, ...]  # timed since its first step
    sweeps: tuple[SensorFile, ...]


def path_of(world: str, ego_states: Array) -> DrivenPath:
    """The path of an ego (S, >= 2), NaN where it has no drive."""
    steps = np.arange(0, len(ego_states), SAMPLE_STEPS)
    steps = steps[np.isfinite(ego_states[steps, :2]).all(axis=1)]
    return DrivenPath(world, steps, np.asarray(ego_states[steps, :2], np.float64))


def traversals(paths: Mapping[str, DrivenPath], log_id: str, start: int, stop: int, most: int) -> tuple[Traversal, ...]:
    """The other drives along steps start..stop-1 of a log, `most` at most: those that go along with it farthest.

    Of each log the one stretch that goes along farthest, in either direction.
    """
    mine = paths[log_id]
    inside = (mine.steps >= start) & (mine.steps < stop)
    if not inside.any():
        return ()
    here = cKDTree(mine.places[inside])
    found = []
    for other_id, other in paths.items():
        if other_id == log_id or other.world != mine.world or not len(other.steps):
            continue
        away, _ = here.query(other.places, distance_upper_bound=NEAR_M)
        near = np.flatnonzero(np.isfinite(away))
        if not len(near):
            continue
        length, first, last = max(
            (_length(other.places[run[0] : run[-1] + 1]), -int(other.steps[run[0]]), int(other.steps[run[-1]]))
            for run in np.split(near, np.flatnonzero(np.diff(other.steps[near]) > BROKEN_STEPS) + 1)
        )
        if length >= LEAST_M:
            found.append((-length, Traversal(other_id, -first, min(last + 1, -first + BLOCK_STEPS))))
    return tuple(traversal for _, traversal in sorted(found, key=lambda row: (row[0], row[1].log_id))[:most])


def digest_with(digest: str, others: Sequence[Traversal], digest_of: Callable[[str], str]) -> str:
    """The content digest of a clip whose own log has `digest` and whose block is made of `others` as well.

    digest_of: the content digest of a log by its id.
    """
    if not others:
        return digest
    told = [f"{other.log_id}@{other.start}:{other.stop}={digest_of(other.log_id)}" for other in others]
    return hashlib.sha256("\x1f".join([digest, *told]).encode()).hexdigest()


def with_other_drives(block: Block, others: Sequence[OtherDrive]) -> Block:
    """The block with what the other drives saw."""
    agents, images, sweeps, cameras = [block.agents], list(block.images), list(block.sweeps), list[Camera]()
    first = [0]
    for other in others:
        first.append(first[-1] + agents[-1].n_steps + round(DRIVES_APART_S / STEP_S))
        agents.append(replace(other.agents, track_ids=tuple(_theirs(other, name) for name in other.agents.track_ids)))
        images += _later(other, other.images, first[-1])
        sweeps += _later(other, other.sweeps, first[-1])
        cameras += [replace(camera, name=_theirs(other, camera.name)) for camera in other.cameras]
    return replace(
        block,
        agents=_one_after_the_other(agents, first),
        images=tuple(images),
        sweeps=tuple(sweeps),
        own_s=(block.agents.n_steps - 1) * STEP_S + DRIVES_APART_S / 2,
        other_cameras=tuple(cameras),
    )


def _theirs(other: OtherDrive, name: str) -> str:
    return f"{other.log_id}{OTHER_LOG}{name}"


def _later(other: OtherDrive, files: Sequence[SensorFile], first: int) -> list[SensorFile]:
    return [replace(f, sensor=_theirs(other, f.sensor), time_s=f.time_s + first * STEP_S) for f in files]


def _one_after_the_other(parts: Sequence[AgentTracks], first: Sequence[int]) -> AgentTracks:
    """Tracks that each begin at step `first` of all; nobody is there before and after."""
    n_steps, n = first[-1] + parts[-1].n_steps, sum(map(len, parts))
    boxes, velocities = np.full((n_steps, n, 5), np.nan), np.full((n_steps, n, 2), np.nan)
    valid, center_z = np.zeros((n_steps, n), bool), np.full((n_steps, n), np.nan)
    column = 0
    for part, at in zip(parts, first, strict=True):
        rows, columns = slice(at, at + part.n_steps), slice(column, column + len(part))
        boxes[rows, columns], velocities[rows, columns] = part.boxes, part.velocities
        valid[rows, columns], center_z[rows, columns] = part.valid, part.center_z
        column += len(part)
    return AgentTracks(
        tuple(track_id for part in parts for track_id in part.track_ids),
        tuple(kind for part in parts for kind in part.kinds),
        boxes,
        velocities,
        valid,
        center_z,
        np.concatenate([part.heights for part in parts]),
    )


def _length(places: Array) -> float:
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


STEP_MS = round(STEP_S * 1000)
ROUTE_SAMPLE_STEPS = 2  # the route looks at the ego every 0.2 s
CACHED_LOGS = 2
FITTED_S = 0.65  # around a window: what velocities at its ends are fitted to, and half a step
EGO_STANDING, BROKEN_TRACKS = "ego_standing", "broken_tracks"  # reasons of the stage "clip"


@dataclass(frozen=True)
class LoggedDrive:
    """What moves in one log, every 0.1 s: step k stands 0.1 k s after the log's first annotated instant."""

    ego_states: Array  # (S, 11), NaN where the log has no continuous drive
    agents: AgentTracks  # S steps
    segment: Ints  # (S,) number of the unbroken stretch a step belongs to, -1: none; no window leaves it
    earliest: int = 0  # step before which no window begins
    repairs: tuple[Repair, ...] = ()


@dataclass(frozen=True)
class WholeLog:
    """What any clip of one log is cut from. Clips share its map and route, and hold copies of the rest."""

    file: str  # or folder; named in errors
    ego_states: Array  # (S, 11) every 0.1 s
    agents: AgentTracks  # S steps
    road_map: RoadMap
    route: Route
    lights: TrafficLights  # S steps
    licence: str
    content_digest: str  # sha256 of everything the clips are computed from, but pixels and points
    split: str | None = field(default=None, kw_only=True)  # the data set's own; None: by the hash of the log's id
    repairs: tuple[Repair, ...] = field(default=(), kw_only=True)  # what is not as the files have it

    @cached_property
    def finder(self) -> CenterlineFinder:
        """Of the centrelines ahead."""
        return CenterlineFinder(self.road_map, self.route)


@dataclass(frozen=True)
class WindowSensors:
    """What one window has besides states: the ego's pose in space, and what it is rendered from."""

    world_from_ego: Array  # (96, 4, 4) rear axle
    cameras: tuple[Camera, ...] = ()
    images: tuple[SensorFile, ...] = ()
    sweeps: tuple[SensorFile, ...] = ()
    block: Block | None = None


@dataclass(frozen=True)
class LogWindows:
    """What the index takes of one log."""

    starts: tuple[int, ...] = ()  # first steps of the windows that are clips
    dropped: Mapping[str, int] = field(default_factory=dict)  # the others, by reason
    skipped: str = ""  # why the log as a whole has none


Log = TypeVar("Log", bound=WholeLog)


class LogReader(ABC, Generic[Log]):
    """Clips of logs of one format: a `factory.readers.base.ClipReader`.

    Keeps the last two logs it read; workers get a reader without them.
    """

    data_set: ClassVar[str]  # name where none is given
    untrusted: ClassVar[bool] = False  # the format can bring a reader down: the index reads it in another process
    length_is: ClassVar[str] = "long"  # "12.3 s ..." of a log that is too short
    block_stride_steps: ClassVar[int | None] = None  # between the stretches that are blocks; None: a window is one

    def __init__(
        self,
        root: str | Path,
        stride_s: float = LogClips.stride_s,
        name: str | None = None,
        min_top_speed_mps: float = LogClips.min_top_speed_mps,
        first_window: int = LogClips.first_window,
        only: Sequence[str] = LogClips.only,
        split: str | None = LogClips.split,
        traversals: int = LogClips.traversals,
    ) -> None:
        """name: the data set's name, part of every clip id; first_window: of each log, skips those before it.

        only: ids of the logs to take, of all that are there where none is named; split: of every clip, whatever its
        data set says; traversals: other logs' drives that a block is made of as well, at most. Raises ValueError for
        an impossible stride, first window, split or number of traversals.
        """
        if split is not None and split not in SPLITS:
            raise ValueError(f"clips.split={split} is none of {', '.join(SPLITS)}; null: the data set's own")
        self.root = Path(root).expanduser().absolute()
        self.name = self.data_set if name is None else name
        self.windows = WindowSettings(stride_s, min_top_speed_mps, first_window)
        self.only, self.split = tuple(only), split
        check_traversals(traversals)
        self.traversals = traversals
        self._logs: dict[str, Log] = {}

    def __getstate__(self) -> dict[str, Any]:
        held = {**self.__dict__, "_logs": {}}
        held.pop("_listed", None)
        return held

    @cached_property
    def _listed(self) -> Mapping[str, Path]:
        """The logs, listed once a process."""
        return self.logs()

    @abstractmethod
    def logs(self) -> Mapping[str, Path]:
        """Log id -> its file or folder, sorted by id. Raises ValueError where the root is not this data set."""

    @abstractmethod
    def drive(self, path: Path) -> LoggedDrive | str:
        """What moves in the log; or, as text, why the log is skipped. Raises BadClip."""

    @abstractmethod
    def load(self, path: Path) -> Log:
        """The whole log, with the same steps as `drive`. Raises BadClip."""

    @abstractmethod
    def recorded(self, log: Log, start: int, stop: int) -> WindowSensors:
        """What steps start..stop-1 of the log have besides states. Raises BadClip."""

    def world(self, path: Path) -> str | None:
        """Name of the frame of the log's poses that other logs share; None: none is known to. Raises BadClip."""
        return None

    def block_steps(self, start: int) -> tuple[int, int]:
        """Steps first..stop-1 of a log that the block of the window from step `start` on takes, where it has them."""
        if self.block_stride_steps is None:
            return start, start + CLIP_STEPS
        first = start // self.block_stride_steps * self.block_stride_steps
        return first, first + BLOCK_STEPS

    def block_name(self, ref: ClipRef) -> str:
        """Log and second at which the block begins that a clip is rendered from."""
        return f"{ref.log_id}@{self.block_steps(ref.start_ms // STEP_MS)[0] * STEP_S:g}s"

    def log_digest(self, path: Path) -> str:
        """The content digest of the log at a path; readers that need not load it for that override. Raises BadClip."""
        return self.load(path).content_digest

    def index(self) -> ClipIndex:
        """All windows of all logs, ordered by log id and time. Raises ValueError where the root holds no log."""
        refs: list[ClipRef] = []
        dropped: Counter[str] = Counter()
        skipped: dict[str, str] = {}
        broken: dict[ClipRef, str] = {}
        chosen = self._chosen()
        if self.traversals:
            self._driven  # noqa: B018 - found once, before workers get the reader
        module = type(self).__module__  # no other process knows a class of __main__
        apart = module.startswith("factory.") and len(chosen) >= 2 * LOGS_PER_PROCESS
        apart |= module != "__main__" and self.untrusted
        for log_id, found in zip(chosen, read_each(self.windows_of, chosen.values(), apart)):
            if isinstance(found, BadClip):
                broken[ClipRef(self.name, log_id, 0)] = str(found)
                continue
            if found.skipped:
                skipped[log_id] = found.skipped
            dropped += Counter(found.dropped)
            refs += [ClipRef(self.name, log_id, start * STEP_MS) for start in found.starts]
        return ClipIndex(tuple(refs), dict(dropped), skipped, broken)

    def windows_of(self, path: Path) -> LogWindows:
        """The windows of one log. Raises BadClip."""
        drive = self.drive(path)
        if isinstance(drive, str):
            return LogWindows(skipped=drive)
        if sign := motion_sign(drive.ego_states):
            raise BadClip(str(path), "ego", sign)
        driven = np.flatnonzero(np.isfinite(drive.ego_states).all(axis=1))
        driven = driven[driven >= drive.earliest]
        first, n_steps = (int(driven[0]), int(driven[-1] - driven[0]) + 1) if len(driven) else (0, 0)
        # The first window begins where the ego's drive does.
        starts = range(self.windows.first_step, n_steps - CLIP_STEPS + 1, self.windows.stride_steps)
        if not starts:
            needs_s = (self.windows.first_step + CLIP_STEPS) * STEP_S
            return LogWindows(skipped=f"{n_steps * STEP_S:.1f} s {self.length_is}, a clip needs {needs_s:.1f} s")
        reasons = {first + i: self._drop_reason(drive, first + i, first + i + CLIP_STEPS) for i in starts}
        kept = tuple(start for start, reason in reasons.items() if reason is None)
        return LogWindows(kept, Counter(reason for reason in reasons.values() if reason is not None))

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        with failures_as_bad_clip(str(self.path_of(ref))):
            return self._read(ref)

    def _read(self, ref: ClipRef) -> Clip:
        log = self._log(ref)
        start, rest = divmod(ref.start_ms, STEP_MS)
        stop = start + CLIP_STEPS
        if rest or start < 0 or stop > len(log.ego_states):
            raise BadClip(log.file, "start_ms", f"no window of {ref.window} starts at {ref.start_ms} ms")
        recorded = self.recorded(log, start, stop)
        agents = only_present(log.agents.window(start, stop))
        ego_states = log.ego_states[start:stop].copy()  # the log stays with the reader, the clip is the caller's
        try:
            centerline = log.finder.centerline_from(ego_states[NOW, :3])
        except NoRoute as error:
            raise BadClip(log.file, "route", str(error)) from error
        clip = Clip(
            clip_id=ref.clip_id,
            dataset=self.name,
            log_id=ref.log_id,
            split=self.split or log.split or split_of(ref.log_id),
            start_s=start * STEP_S,
            ego_states=ego_states,
            world_from_ego=recorded.world_from_ego,
            agents=agents,
            road_map=log.road_map,
            route=log.route,
            centerline=centerline,
            lights=TrafficLights(log.lights.lane_ids, log.lights.states[start:stop].copy()),
            cameras=recorded.cameras,
            images=recorded.images,
            sweeps=recorded.sweeps,
            block=None if recorded.block is None else self._with_others(ref, recorded.block),
            licence=log.licence,
            content_digest=self.digest_with_others(ref, log.content_digest),
            repairs=repairs_within(log.repairs, start * STEP_S - FITTED_S, (stop - 1) * STEP_S + FITTED_S)
            + articulated(agents),
        )
        return validate_clip(clip, log.file)

    def digest_with_others(self, ref: ClipRef, digest: str) -> str:
        """The content digest of a clip whose log's is `digest`: that of the drives its block is made of is in it."""
        return digest_with(digest, self._others(ref), lambda log_id: self.log_digest(self._listed[log_id]))

    def _others(self, ref: ClipRef) -> tuple[Traversal, ...]:
        """The other drives that the block of a clip is made of as well."""
        if not self.traversals or ref.log_id not in self._driven:
            return ()
        return traversals(self._driven, ref.log_id, *self.block_steps(ref.start_ms // STEP_MS), self.traversals)

    def _with_others(self, ref: ClipRef, block: Block) -> Block:
        others = []
        for other in self._others(ref):
            log = self._log(replace(ref, log_id=other.log_id))
            start, stop = other.start, min(other.stop, len(log.ego_states))
            seen = self.recorded(log, start, stop)
            agents = only_present(log.agents.window(start, stop))
            if seen.images or seen.sweeps:
                others.append(OtherDrive(other.log_id, agents, seen.cameras, seen.images, seen.sweeps))
        return with_other_drives(block, others) if others else block

    @cached_property
    def _driven(self) -> dict[str, DrivenPath]:
        """Where the logs' egos were, of those that share a world and can be read. Raises ValueError where none does."""
        found, worlds = {}, False
        for log_id, path in self._chosen().items():
            try:
                with failures_as_bad_clip(str(path)):
                    world = self.world(path)
                    worlds = worlds or world is not None
                    drive = None if world is None else self.drive(path)
            except BadClip:  # the index says what is wrong with it
                continue
            if world is not None and isinstance(drive, LoggedDrive):
                found[log_id] = path_of(world, drive.ego_states)
        if not worlds:
            raise ValueError(f"clips.traversals={self.traversals}: no log under {self.root} says which world it shares")
        return found

    def _chosen(self) -> Mapping[str, Path]:
        logs = self._listed
        unknown = [log_id for log_id in self.only if log_id not in logs]
        if unknown:
            raise ValueError(f"clips.only: no log {', '.join(unknown)} under {self.root}; there are {', '.join(logs)}")
        return {log_id: logs[log_id] for log_id in logs if not self.only or log_id in self.only}

    def path_of(self, ref: ClipRef) -> Path:
        """The file or folder of the clip's log. Raises BadClip where there is none."""
        path = self._listed.get(ref.log_id)
        if path is None or ref.dataset != self.name:
            raise BadClip(str(self.root), "log_id", f"no log {ref.log_id} of data set {ref.dataset} here")
        return path

    def _drop_reason(self, drive: LoggedDrive, start: int, stop: int) -> str | None:
        """Why the window is dropped; None keeps it."""
        ego, segment = drive.ego_states[start:stop], drive.segment[start:stop]
        if np.hypot(ego[:, VX], ego[:, VY]).max() < self.windows.min_top_speed_mps:
            return EGO_STANDING
        moved = np.diff(np.concatenate([ego[:, None, [X, Y]], drive.agents.boxes[start:stop, :, :2]], axis=1), axis=0)
        jumped = (
            np.hypot(*np.moveaxis(moved, -1, 0)) > self.windows.max_speed_mps * STEP_S
        )  # false next to absent steps
        unbroken = (segment >= 0) & (segment == segment[0])
        return None if unbroken.all() and not jumped.any() else BROKEN_TRACKS

    def _log(self, ref: ClipRef) -> Log:
        if ref.log_id not in self._logs:
            log = self.load(self.path_of(ref))
            self._logs = dict([*self._logs.items(), (ref.log_id, log)][-(CACHED_LOGS + self.traversals) :])
        return self._logs[ref.log_id]


def route_of_drive(road_map: RoadMap, poses: Array, file: str, field: str) -> Route:
    """The route that rear-axle poses (S, 3), 0.1 s apart, take. Raises BadClip naming the map's file and field."""
    try:
        return route_of_log(road_map, poses[::ROUTE_SAMPLE_STEPS])
    except NoRoute as error:
        why = map_sign(poses, road_map)
        raise BadClip(file, field, f"{error}: {why}" if why else str(error)) from error


def files_within(files: Sequence[SensorFile], start: int, stop: int) -> tuple[SensorFile, ...]:
    """Those of the steps start..stop-1, half a step around them included, timed since step `start`.

    files: timed since the log's first step.
    """
    first, last = start * STEP_S, (stop - 1) * STEP_S
    inside = (file for file in files if first - STEP_S / 2 < file.time_s <= last + STEP_S / 2)
    return tuple(replace(file, time_s=file.time_s - first) for file in inside)


def block_of_log(
    log: WholeLog,
    images: Sequence[SensorFile],
    sweeps: Sequence[SensorFile],
    steps: tuple[int, int],
    ground_m: float | None = None,
) -> Block:
    """The block of steps first..stop-1, as far as the log goes; images, sweeps: of the log, timed since its start."""
    first, stop = steps[0], min(steps[1], len(log.ego_states))
    sensed = files_within(images, first, stop), files_within(sweeps, first, stop)
    return Block(first * STEP_S, only_present(log.agents.window(first, stop)), *sensed, ground_m)


def only_present(agents: AgentTracks) -> AgentTracks:
    """Only the tracks that are present at one of the steps or more."""
    seen = np.flatnonzero(agents.valid.any(axis=0))
    return replace(
        agents,
        track_ids=tuple(agents.track_ids[i] for i in seen),
        kinds=tuple(agents.kinds[i] for i in seen),
        boxes=agents.boxes[:, seen],
        velocities=agents.velocities[:, seen],
        valid=agents.valid[:, seen],
        center_z=agents.center_z[:, seen],
        heights=agents.heights[seen],
    )
