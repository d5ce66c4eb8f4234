"""Reads ScenarioNet's scenario pickles (Li et al. 2023) as clips: nuScenes, Waymo and nuPlan conversions.

A scenario is a dict: `metadata` (dataset, ts, sdc_id, map), `length`, `tracks`, `map_features`, `dynamic_map_states`.
There are no cameras and no lidar in it: a sidecar brings them (photos.py). A database folder lists its scenarios in
`dataset_summary.pkl` (file name -> metadata) and their folders in `dataset_mapping.pkl` (file name -> folder relative
to the database).
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.linalg import lstsq, solveh_banded
from scipy.ndimage import convolve1d, median_filter

from factory.datasets.scenarionet.map import as_floats, road_map, traffic_lights
from factory.datasets.scenarionet.photos import (
    NO_PHOTOGRAPHS,
    Photographs,
    load_sidecar,
    read_photographs,
    sidecars_of,
    start_step_nearest_photos,
)
from factory.datasets.scenarionet.settings import ScenarioNetClips
from factory.files import broken_link, is_named, matching_below, named_once
from factory.readers.apart import ProcessFunction
from factory.readers.base import (
    BadClip,
    ClipIndex,
    ClipRef,
    bytes_of,
    folder_split,
    id_text,
    nuscenes_split,
    stamps_sign,
    waymo_split,
)
from factory.readers.logs import (
    BLOCK_STEPS,
    STEP_MS,
    LoggedDrive,
    LogReader,
    WholeLog,
    WindowSensors,
    block_of_log,
    files_within,
    route_of_drive,
)
from factory.readers.pickles import load_plain
from factory.wording import shown
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import CLIP_STEPS, STEP_S, AgentKind, AgentTracks
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, PACIFICA, VX, VY, X, Y, planar_matrices, wrap_angle
from tasks.world.repair.records import LEFT_OUT, Repair
from tasks.world.repair.road import lights_on_map
from tasks.world.repair.tracks import (
    EGO,
    MOST,
    UNSEEN,
    ObservedTracks,
    clock_repairs,
    increasing,
    repaired,
    whole_frames,
)
from tasks.world.road_map import TrafficLights

# ScenarioNet's tracks as 10 Hz arrays: a smooth ego at its rear axle, agents with velocities derived again.
#
# What the files hold (public converters, checked on seven nuScenes scenes) and what is done about it:
# * Invalid frames hold zeros and the last frame's velocity is 0, so `valid` masks everything and velocities are not rea
# * nuScenes' ego comes from the CAN bus on a clock of its own (canbus.py), or, without one, is a line between
#   2 Hz keyframes that are in truth 0.4-0.6 s apart. A jump that is left ends a segment; no clip reaches across it.
# * The ego is smoothed: the x(t) that minimises |x - log|^2 + lambda |third difference|^2, whose gain falls to a half
#   at lambda^(-1/6) / 0.1 s = 3.9 rad/s for lambda = 300. On the seven scenes |a| is then at most 3.1 m/s2 and the
#   jerk 3.7 m/s3. Speeds and accelerations are those of a quadratic over +-0.3 s, as in the metric's reference scenes.
# * Agents: nuScenes' are lines between keyframes. Velocity = least-squares slope over +-0.5 s, below 0.1 m/s set to 0.

# The clock of nuScenes' ego in ScenarioNet's files, put right.
#
# The converter takes the ego from the CAN bus: every fifth 50 Hz pose message, written as if they were 0.1 s apart and
# the first one at the log's start. Neither holds, and the agents keep the log's clock:
# * A lost message makes a step 0.02 s too long. It shows as such: on the seven scenes 37 steps are late by 0.014-0.025
#   and one by 0.039 s, all others by 0.002 s (standard deviation). Scene 0061 lost 20 messages, 0.4 s in 19 s.
# * Where the bus ends before the log, the converter goes on with keyframe poses, which are on the log's clock: the ego
#   falls back by 0.2-0.3 s, 3 m at 15 m/s. That jump tells how far the bus was ahead.
# So every message gets its time, and the ego is interpolated at the log's steps. Where the bus lasts to the log's end
# nothing tells its start, and 0 is assumed (the three scenes that tell: -0.13, 0.06 and 0.22 s).

MESSAGE_S = 0.02
MAX_LOST = 5  # messages in one step
TIMING_NOISE_S = 0.008
MIN_SPEED_MPS = 0.2  # slower, a step does not tell its duration
MAX_AHEAD_S = 0.5
JUMP_M, JUMP_S = 0.3, 0.03  # a 0.1 s step this far (plus this long at its speed) off the median step is a jump


def usual_steps(xy: Array) -> Array:
    """(S - 1, 2) median of the steps around each step, component by component."""
    return np.stack([median_filter(column, 11, mode="nearest") for column in np.diff(xy, axis=0).T], axis=1)


def jumps(xy: Array) -> Bools:
    """(S - 1,) True where the step to the next position is not part of the same drive."""
    usual = usual_steps(xy)
    return np.hypot(*(np.diff(xy, axis=0) - usual).T) > JUMP_M + JUMP_S / STEP_S * np.hypot(*usual.T)


def on_log_clock(xy: Array, heading: Array, valid: Bools) -> tuple[Array, Array, Bools]:
    """Positions (S, 2), unwrapped headings (S,) and valid (S,) at the log's steps, from those stored in message order.

    Steps before the first message and after the last one are not valid. An ego with gaps is given back as it is.
    """
    if not valid.all():
        return xy, heading, valid
    last = int(np.argmax(jumps(xy))) if jumps(xy).any() else len(xy) - 1  # index of the last message
    late = _late_seconds(xy)
    times = STEP_S * np.arange(last + 1) + MESSAGE_S * np.concatenate([[0.0], np.cumsum(_lost_messages(late[:last]))])
    if last < len(xy) - 1:
        ahead = -late[last]
        if not 0.0 <= ahead <= MAX_AHEAD_S:
            return xy, heading, valid
        times += STEP_S * last + ahead - times[-1]
    steps = STEP_S * np.arange(len(xy))
    bus = slice(0, last + 1)
    moved = np.stack([np.interp(steps, times, column) for column in xy[bus].T], axis=1)
    told = (steps >= times[0] - 1e-9) & (steps <= times[-1] + 1e-9)
    return moved, np.interp(steps, times, np.unwrap(heading[bus])), told


def _late_seconds(xy: Array) -> Array:
    """(S - 1,) seconds by which each step took longer than 0.1 s, at the speed of the steps around it; 0 when slow."""
    usual = usual_steps(xy)
    length = np.hypot(*usual.T)
    excess = ((np.diff(xy, axis=0) - usual) * usual).sum(axis=1) / np.maximum(length, 1e-9)
    return np.where(length > MIN_SPEED_MPS * STEP_S, STEP_S * excess / np.maximum(length, 1e-9), 0.0)


def _lost_messages(late: Array) -> Array:
    """(S,) messages lost within each step."""
    count = np.rint(late / MESSAGE_S)
    sure = (count >= 1) & (count <= MAX_LOST) & (np.abs(late - MESSAGE_S * count) < TIMING_NOISE_S)
    return np.where(sure, count, 0.0)


KINDS = {
    "VEHICLE": AgentKind.VEHICLE,
    "PEDESTRIAN": AgentKind.PEDESTRIAN,
    "CYCLIST": AgentKind.BICYCLE,  # nuScenes' motorcycles too
    "TRAFFIC_CONE": AgentKind.TRAFFIC_CONE,
    "TRAFFIC_BARRIER": AgentKind.BARRIER,
    **dict.fromkeys(("TRAFFIC_OBJECT", "OTHER", "UNSET"), AgentKind.GENERIC_OBJECT),
}
KEYFRAME_STEPS = 5
MAX_GAP_S = 0.55  # between two frames; longer ones cannot be filled in, no clip reaches across them
LONGEST_GAP_S = 600.0  # of one drive
SLOPE_STEPS = 5  # +-0.55 s holds five steps to each side
STANDING_MPS = 0.1
FIT_STEPS = 7  # +-0.3 s


@dataclass(frozen=True)
class Source:
    """What differs between the data sets that ScenarioNet converts."""

    licence: str
    origin_to_rear_axle_m: float  # from the stored ego position back along the heading
    smoothing: float  # lambda of the ego's smoother
    can_bus: bool  # the ego's frames are thinned 50 Hz messages


# nuScenes stores the ego pose, whose origin is the rear axle. Waymo's converter stores the box centre, nuPlan's the
# EgoState's waypoint, which is the centre too. The Pacifica's own offset keeps its box on the logged box.
SOURCES = {
    "nuscenes": Source("CC BY-NC-SA 4.0 (nuScenes via ScenarioNet)", 0.0, 300.0, True),
    "waymo": Source(
        "Waymo Open Dataset licence, non-commercial (via ScenarioNet)", PACIFICA.rear_axle_to_center, 10.0, False
    ),
    "nuplan": Source("CC BY-NC-SA 4.0 (nuPlan via ScenarioNet)", PACIFICA.rear_axle_to_center, 10.0, False),
}


@dataclass(frozen=True)
class LoggedTrack:
    """One track at the log's own frames."""

    position: Array  # (T, 3)
    heading: Array  # (T,)
    valid: Bools  # (T,)
    sizes: Array  # (T, 3) length, width, height; NaN where none is stored

    @property
    def size(self) -> Array:
        """(3,) median over the valid frames; NaN where none is stored."""
        return np.median(self.sizes[self.valid], axis=0) if self.valid.any() else np.full(3, np.nan)

    def at_frames(self, rows: Ints) -> "LoggedTrack":
        """The same at some of its frames."""
        return LoggedTrack(self.position[rows], self.heading[rows], self.valid[rows], self.sizes[rows])


@dataclass(frozen=True)
class FrameClock:
    """The T frames of a log whose stamps are in order, and the S steps of 0.1 s among them."""

    rows: Ints  # (T,) their numbers in the file
    times_s: Array  # (T,) increasing since the first
    at: Array  # (S,) fractional index of the frame at each step; whole where the log runs at 10 Hz within 1 ms
    known: Bools  # (S,) whether the frames around a step are near enough to each other to tell what is in between
    repairs: tuple[Repair, ...]


def frames_of(metadata: Mapping[str, Any], n_frames: int, file: str) -> FrameClock:
    """The clock of a log. Raises BadClip for missing, too sparse and mostly unordered stamps."""
    if "ts" not in metadata:
        raise BadClip(file, "metadata.ts", "missing")
    stored = as_floats(metadata["ts"], file, "metadata.ts").reshape(-1)
    if len(stored) == n_frames + 1:  # nuScenes' converter counts with arange(0, end, 0.1): rounding may add one
        stored = stored[:-1]
    stamps = _numbers(stored, (n_frames,), file, "metadata.ts").copy()
    twice = np.flatnonzero(np.diff(stamps) == 0.0)
    stamps[[*twice, *(twice + 1)]] = np.nan  # nothing tells which of the two it is of
    rows = increasing(stamps)
    if len(rows) <= MOST * n_frames:
        raise BadClip(file, "metadata.ts", "time is not finite and increasing in most of the frames")
    if sign := stamps_sign(stamps[rows], "s"):
        raise BadClip(file, "metadata.ts", sign)
    times_s = stamps[rows] - stamps[rows[0]]
    apart = np.diff(times_s)
    if not len(apart) or np.median(apart) > MAX_GAP_S:
        raise BadClip(file, "metadata.ts", f"frames further apart than {MAX_GAP_S} s cannot be resampled to 10 Hz")
    if apart.max() > LONGEST_GAP_S:
        raise BadClip(file, "metadata.ts", f"no frame for {apart.max():,.0f} s: one log is one drive, split it there")
    unordered = (
        Repair("clock", f"frame {k}", float(np.interp(k, rows, times_s)), f"stamped {stored[k]:g} s", LEFT_OUT)
        for k in np.setdiff1d(np.arange(n_frames), rows).tolist()
    )
    at = np.arange(len(rows), dtype=np.float64)
    if np.abs(times_s - STEP_S * at).max() >= 1e-3:
        at = np.interp(STEP_S * np.arange(int(np.floor(times_s[-1] / STEP_S + 1e-6)) + 1), times_s, at)
    before = np.minimum(at.astype(int), len(apart) - 1)
    known = (at == np.floor(at)) | (apart[before] <= MAX_GAP_S)
    return FrameClock(rows, times_s, at, known, (*clock_repairs(times_s), *unordered))


def read_track(tracks: Mapping[Any, Any], track_id: str | int, n_frames: int, file: str) -> LoggedTrack:
    """One track, with what is impossible in its file. Raises BadClip naming what is missing or misshapen."""
    field = f"tracks[{track_id}].state"
    state = tracks[track_id].get("state") if isinstance(tracks[track_id], dict) else None
    if not isinstance(state, dict):
        raise BadClip(file, field, "missing")
    for name in ("position", "heading", "valid"):
        if name not in state:
            raise BadClip(file, f"{field}.{name}", "missing")
    valid = _numbers(state["valid"], (n_frames,), file, f"{field}.valid") > 0.5
    position = as_floats(state["position"], file, f"{field}.position")
    if position.ndim != 2 or position.shape[0] != n_frames or position.shape[1] not in (2, 3):
        raise BadClip(file, f"{field}.position", f"shape {position.shape}, expected ({n_frames}, 3)")
    if position.shape[1] == 2:
        position = np.column_stack([position, np.zeros(n_frames)])
    heading = _numbers(state["heading"], (n_frames,), file, f"{field}.heading")
    sizes = np.full((n_frames, 3), np.nan)
    for column, name in enumerate(("length", "width", "height")):
        if name in state:
            sizes[:, column] = _numbers(state[name], (n_frames,), file, f"{field}.{name}")
    return LoggedTrack(position, heading, valid, sizes)


def ground_height(ego: LoggedTrack, frames: FrameClock, file: str) -> Array:
    """(S,) height of the road under the ego: below Waymo's box centre; 0 where the file keeps the ego at z = 0."""
    if not ego.position[ego.valid, 2].any():
        return np.zeros(len(frames.at))
    if not np.isfinite(ego.size[2]):
        raise BadClip(file, "tracks[sdc].state.height", "missing, and the ego is not at z = 0")
    return resampled(ego, frames)[0][:, 2] - ego.size[2] / 2.0


def observed_agents(
    tracks: Mapping[Any, Any], sdc_id: str, n_frames: int, frames: FrameClock, file: str
) -> tuple[ObservedTracks, tuple[Repair, ...]]:
    """All tracks but the ego at the log's T frames; those that name no id, no class or no states are left out.

    Raises BadClip where that is most of them.
    """
    found: list[tuple[str, AgentKind, LoggedTrack]] = []
    names = set[str]()
    done: list[Repair] = []
    wrong: list[BadClip] = []
    for track_id in tracks:
        name = id_text(track_id)
        if name == sdc_id:
            continue
        kind = tracks[track_id].get("type") if isinstance(tracks[track_id], dict) else None
        try:
            if name is None:
                raise BadClip(file, f"tracks[{shown(track_id)}]", "is no id of a track, expected text or a number")
            if name in names:
                raise BadClip(file, f"tracks[{name}]", "stands twice, as a text and as a number")
            if not isinstance(kind, str) or kind not in KINDS:
                raise BadClip(file, f"tracks[{name}].type", f"unknown class {shown(kind)}")
            track = read_track(tracks, track_id, n_frames, file).at_frames(frames.rows)
        except BadClip as error:
            what = "class" if error.field.endswith(".type") else "impossible"
            what = "token" if name is None else "twice" if name in names else what
            done.append(Repair(what, name or shown(track_id), np.nan, error.problem, LEFT_OUT))
            wrong.append(error)
            continue
        names.add(name)
        if track.valid.any():
            found.append((name, KINDS[kind], track))
    if len(wrong) > MOST * max(len(tracks) - 1, 1):
        raise wrong[0]
    boxes = np.zeros((len(frames.rows), len(found), 9))
    rows = np.full(boxes.shape[:2], UNSEEN)
    for n, (_, _, track) in enumerate(found):
        boxes[:, n, :3], boxes[:, n, 3], boxes[:, n, 4:7] = track.position, track.heading, track.sizes
        rows[track.valid, n] = n
    ids, kinds = tuple(name for name, _, _ in found), tuple(kind for _, kind, _ in found)
    return ObservedTracks(frames.times_s, ids, kinds, boxes, rows), tuple(done)


def agent_tracks(seen: ObservedTracks, frames: FrameClock, ground: Array) -> AgentTracks:
    """Tracks at the steps (S,), heights above `ground` (S,)."""
    valid = np.zeros((len(frames.at), len(seen)), bool)
    boxes, z = np.full((*valid.shape, 5), np.nan), np.full(valid.shape, np.nan)
    heights = np.zeros(len(seen))
    for n in range(len(seen)):
        box = seen.boxes[:, n]
        track = LoggedTrack(box[:, :3], box[:, 3], seen.seen[:, n], box[:, 4:7])
        position, heading, here = resampled(track, frames)
        flat = not track.position[track.valid, 2].any()  # nuPlan stores no height: the box stands on the ground
        valid[:, n] = here
        boxes[here, n, :2], boxes[here, n, 2] = position[here, :2], heading[here]
        boxes[here, n, 3:] = track.size[:2]
        heights[n] = track.size[2]
        z[here, n] = heights[n] / 2.0 if flat else (position[:, 2] - ground)[here]
    return AgentTracks(
        track_ids=seen.track_ids,
        kinds=seen.kinds,
        boxes=boxes,
        velocities=fitted_velocities(boxes[..., :2], valid),
        valid=valid,
        center_z=z,
        heights=heights,
    )


def resampled(track: LoggedTrack, frames: FrameClock) -> tuple[Array, Array, Bools]:
    """(S, 3) position, (S,) heading in [-pi, pi), (S,) valid: both frames around a step must be, and near it."""
    before = np.floor(frames.at).astype(int)
    after = np.minimum(before + 1, len(track.valid) - 1)
    share = frames.at - before
    after = np.where(share > 0.0, after, before)
    position = track.position[before] + share[:, None] * (track.position[after] - track.position[before])
    heading = track.heading[before] + share * wrap_angle(track.heading[after] - track.heading[before])
    return position, wrap_angle(heading), track.valid[before] & track.valid[after] & frames.known


def fitted_velocities(xy: Array, valid: Bools) -> Array:
    """(S, N, 2) m/s: least-squares slope of the valid positions (S, N, 2) within five steps; NaN where not valid."""
    n_steps = len(xy)
    filled = np.where(valid[..., None], xy, 0.0)
    count, time, square = (np.zeros(valid.shape) for _ in range(3))
    total, moment = np.zeros(xy.shape), np.zeros(xy.shape)
    for offset in range(-SLOPE_STEPS, SLOPE_STEPS + 1):
        rows = slice(max(0, -offset), n_steps - max(0, offset))
        shifted = slice(max(0, offset), n_steps - max(0, -offset))
        here = valid[shifted] & valid[rows]
        # Relative to the step's own position, so that world coordinates of kilometres cancel nothing.
        relative = np.where(here[..., None], filled[shifted] - filled[rows], 0.0)
        t = offset * STEP_S
        count[rows] += here
        time[rows] += t * here
        square[rows] += t * t * here
        total[rows] += relative
        moment[rows] += t * relative
    spread = count * square - time**2
    known = valid & (spread > 1e-9)
    slope = (count[..., None] * moment - time[..., None] * total) / np.where(known, spread, 1.0)[..., None]
    slope[~known] = 0.0
    slope[np.hypot(slope[..., 0], slope[..., 1]) < STANDING_MPS] = 0.0
    slope[~valid] = np.nan
    return slope


def ego_segments(track: LoggedTrack, source: Source, frames: FrameClock) -> tuple[Array, Ints]:
    """Ego states (S, 11), and (S,) the number of the continuous drive that a step belongs to; NaN and -1: none.

    Columns 7..10 (steering and rates) are 0, as NAVSIM initialises an ego.
    """
    xy, heading, valid = _ego_at_steps(track, source, frames)
    states, segment = np.full((len(xy), EGO_STATE_SIZE), np.nan), np.full(len(xy), -1, np.int64)
    broken = jumps(xy) | ~valid[1:] | ~valid[:-1]
    runs = pairwise([0, *(np.flatnonzero(broken) + 1).tolist(), len(xy)])
    long_enough = [(a, b) for a, b in runs if b - a >= FIT_STEPS and valid[a:b].all()]
    for number, (start, stop) in enumerate(long_enough):
        here = np.unwrap(heading[start:stop])
        back = source.origin_to_rear_axle_m * np.stack([np.cos(here), np.sin(here)], axis=1)
        axle = xy[start:stop] - back
        states[start:stop] = smooth_drive(axle, here, _keyframe_weights(axle), source.smoothing)
        segment[start:stop] = number
    return states, segment


def _ego_at_steps(track: LoggedTrack, source: Source, frames: FrameClock) -> tuple[Array, Array, Bools]:
    """(S, 2) positions, (S,) headings, (S,) valid, on the log's clock."""
    position, heading, valid = resampled(track, frames)
    if not source.can_bus or len(position) < 2 or not _keyframe_weights(position[:, :2]).all():
        return position[:, :2], heading, valid
    apart = np.diff(frames.times_s)
    is_whole = ((apart > 0.5 * STEP_S) & (apart < 1.5 * STEP_S)).all()
    if (frames.at == np.floor(frames.at)).all() or not is_whole:
        return on_log_clock(position[:, :2], heading, valid)
    # As the messages come, before stamps that jitter by half a message pass for lost ones.
    xy, heading, valid = on_log_clock(track.position[:, :2], track.heading, track.valid)
    return resampled(replace(track, position=xy, heading=heading, valid=valid), frames)


def smooth_drive(xy: Array, heading: Array, weight: Array, smoothing: float) -> Array:
    """Ego states (S, 11) of the smooth drive nearest to rear-axle positions (S, 2) and headings (S,), unwrapped.

    weight: (S,) 1 where a step was observed, 0 where it only lies between two that were, three or more of them 1;
    S >= 7. Steering and rates are 0.
    """
    drive = _least_third_difference(np.column_stack([xy, heading]), weight, smoothing)
    velocity, acceleration = (fitted_derivative(drive[:, :2], order) for order in (1, 2))
    c, s = np.cos(drive[:, 2]), np.sin(drive[:, 2])
    states = np.zeros((len(xy), EGO_STATE_SIZE))
    states[:, X], states[:, Y], states[:, HEADING] = drive[:, 0], drive[:, 1], wrap_angle(drive[:, 2])
    for (along, across), vector in (((VX, VY), velocity), ((AX, AY), acceleration)):
        states[:, along] = c * vector[:, 0] + s * vector[:, 1]
        states[:, across] = -s * vector[:, 0] + c * vector[:, 1]
    return states


def fitted_derivative(values: Array, order: int) -> Array:
    """(S, C) derivative per second of parabolas through FIT_STEPS steps each: about a step, at the ends the outermost.

    Savitzky and Golay's filter, to the bit scipy.signal's, whose import takes longer than to read most logs.
    """
    half, powers, steps = FIT_STEPS // 2, np.arange(3)[:, None], np.arange(FIT_STEPS)
    wanted = math.factorial(order) / STEP_S**order * (powers[:, 0] == order)
    weights = lstsq((half - steps) ** powers, wanted)[0]
    found: Array = convolve1d(values, weights, axis=0, mode="constant")
    for window, ends, at in (
        (values[:FIT_STEPS], found[:half], steps[:half]),
        (values[-FIT_STEPS:], found[-half:], steps[-half:]),
    ):
        parabola = np.polyfit(steps, window, 2)
        for _ in range(order):
            parabola = parabola[:-1] * np.arange(len(parabola) - 1, 0, -1)[:, None]
        ends[:] = np.polyval(parabola, at[:, None]) / STEP_S**order
    return found


def _keyframe_weights(xy: Array) -> Array:
    """(S,) 1 at every step; only at keyframes where the steps between them are on a straight line at even speed."""
    bend = np.concatenate([[False], np.hypot(*np.diff(xy, n=2, axis=0).T) > 1e-4, [False]])
    phase = np.flatnonzero(bend) % KEYFRAME_STEPS
    if len(phase) == 0 or (phase != phase[0]).any():
        return np.ones(len(xy))
    weight = np.zeros(len(xy))
    weight[phase[0] :: KEYFRAME_STEPS] = 1.0
    weight[[0, -1]] = 1.0
    return weight


def _least_third_difference(log: Array, weight: Array, smoothing: float) -> Array:
    """(S, C): argmin of sum w (x - log)^2 + smoothing sum (third difference of x)^2, by a banded Cholesky solve."""
    n = len(log)
    kernel = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))  # lower form: bands[k, i] = A[i + k, i]
    for k in range(4):
        for j in range(4 - k):
            bands[k, j : n - 3 + j] += smoothing * kernel[j] * kernel[j + k]
    bands[0] += weight
    center = log[0]  # solved about the first row: world coordinates of kilometres would cost digits
    solved: Array = solveh_banded(bands, weight[:, None] * (log - center), lower=True)
    return solved + center


def _numbers(value: object, shape: tuple[int, ...], file: str, field: str) -> Array:
    """An array of the shape given; a trailing axis of one is dropped."""
    array = as_floats(value, file, field)
    if array.ndim == len(shape) + 1 and array.shape[-1] == 1:
        array = array[..., 0]
    if array.shape != shape:
        raise BadClip(file, field, f"shape {array.shape}, expected {shape}")
    return array


SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"
GROUND_M = 0.0  # of the ego's frame, in sidecars and in the plane of the log: it stands on the road


@dataclass(frozen=True)
class ScenarioLog(WholeLog):
    """One log, whole, with the segments of its drive and what its sidecar brings."""

    motion: LoggedDrive
    photographs: Photographs = NO_PHOTOGRAPHS


class ScenarioNetReader(LogReader[ScenarioLog]):
    """Clips of one scenario pickle, of a folder of them, or of a ScenarioNet database folder.

    A log's id is its file's name without the suffix.
    """

    data_set = "scenarionet"
    untrusted = True
    length_is = "of driving"
    # As far apart as any clip still lies in one, so that a scene of nuScenes, 20 s and no more, is one.
    block_stride_steps = BLOCK_STEPS - CLIP_STEPS

    def __init__(
        self,
        root: str | Path,
        cameras: str | Path | None = ScenarioNetClips.cameras,
        sensor_root: str | Path | None = ScenarioNetClips.sensor_root,
        **windows: Any,
    ) -> None:
        """cameras: a log's sidecar or a folder of such, None: no photos; sensor_root: of what they name, None: theirs.

        windows: as of LogReader. Raises ValueError.
        """
        super().__init__(root, **windows)
        self.cameras, self.sensor_root = (
            None if path is None else Path(path).expanduser().absolute() for path in (cameras, sensor_root)
        )
        if self.sensor_root is not None and not self.sensor_root.is_dir():
            raise ValueError(
                f"clips.sensor_root={self.sensor_root}: {broken_link(self.sensor_root) or 'no such folder'}"
            )
        if self.sensor_root is not None and self.cameras is None:
            raise ValueError("clips.sensor_root goes with clips.cameras, which says what the photos below it show")

    @cached_property
    def _sidecars(self) -> dict[Path, Path]:
        """Pickle -> sidecar, of the logs that have one."""
        if self.cameras is None:
            return {}
        chosen = self._chosen()
        return {chosen[log_id]: path for log_id, path in sidecars_of(self.cameras, chosen).items()}

    @cached_property
    def _files(self) -> dict[str, Path]:
        return scenario_files(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> pickle, listed once. Raises ValueError where the root holds no scenario."""
        return self._files

    def index(self) -> ClipIndex:
        """As of LogReader; sidecars are looked for before a scenario is opened, and once for all of them."""
        _ = self._sidecars
        return super().index()

    def drive(self, path: Path) -> LoggedDrive:
        """Ego and agents of the scenario in this file. Raises BadClip."""
        sidecars = self._sidecars
        scenario, _ = read_scenario(path)
        drive = read_motion(scenario, str(path))
        if path not in sidecars:
            return drive
        found = self._photographs(path, drive.ego_states)  # told here, once, what would fail each of its clips
        first = int(np.argmax(drive.segment >= 0))
        return replace(drive, earliest=start_step_nearest_photos(found, first, len(drive.segment)))

    def load(self, path: Path) -> ScenarioLog:
        """The scenario in this file, with its photos. Raises BadClip."""
        log = read_log(path)
        if path not in self._sidecars:
            return log
        found = self._photographs(path, log.ego_states)
        return replace(log, photographs=found, content_digest=_digest(log.content_digest, found.data))

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's file and sidecar alone. Raises BadClip."""
        path = self.path_of(ref)
        digest = hashlib.sha256(bytes_of(path)).hexdigest()
        return _digest(digest, load_sidecar(self._sidecars[path])[1]) if path in self._sidecars else digest

    def block(self, ref: ClipRef) -> str | None:
        """The block that the clip is rendered from; None where the log has no photos."""
        return self.block_name(ref) if self.path_of(ref) in self._sidecars else None

    def recorded(self, log: ScenarioLog, start: int, stop: int) -> WindowSensors:
        """The ego's poses, photos and sweeps of a window. Raises BadClip where the ego's drive is broken."""
        ego_states = log.motion.ego_states[start:stop]
        if not np.isfinite(ego_states).all():
            raise BadClip(log.file, "tracks[sdc]", f"the ego's drive is broken in the window at {start * STEP_MS} ms")
        poses = planar_matrices(ego_states)  # the format's ego has no roll or pitch, its road is at z = 0
        found = log.photographs
        if not found.images:
            return WindowSensors(poses)
        sensed = files_within(found.images, start, stop), files_within(found.sweeps, start, stop)
        block = block_of_log(log, found.images, found.sweeps, self.block_steps(start), GROUND_M)
        return WindowSensors(poses, found.cameras, *sensed, block)

    def _photographs(self, path: Path, ego_states: Array) -> Photographs:
        sidecar = self._sidecars[path]
        return read_photographs(sidecar, self.sensor_root or sidecar.parent, ego_states)


def _digest(scenario: str, sidecar: bytes) -> str:
    return hashlib.sha256(f"{scenario}\x1f{len(sidecar)}\x1f".encode() + sidecar).hexdigest()


def scenario_files(root: Path) -> dict[str, Path]:
    """Log id -> pickle, sorted by id. Raises ValueError where the root is neither a pickle nor a folder with some.

    A database's own list counts, with files that are missing; a plain folder is searched for sd_*.pkl in all depths.
    """
    if root.is_file() and root.suffix.lower() == ".pkl":
        return {root.stem: root}
    if not root.is_dir():
        raise ValueError(f"{root}: {broken_link(root) or 'no such folder or .pkl file'}")
    listed = is_named(root / SUMMARY)
    paths = _listed(root) if listed else matching_below(root, "sd_*.pkl")
    files = named_once(root, ((path.stem, path) for path in paths))
    if not files:
        raise ValueError(f"{root}: no scenario here; expected sd_*.pkl files, a database with {SUMMARY}, or one .pkl")
    return files


def _listed(root: Path) -> list[Path]:
    """The database's scenarios by its summary and mapping. Merged databases point to folders beside their own.

    Both are read as logs are, in another process: they are as much a stranger's.
    """
    summary, mapped = root / SUMMARY, root / MAPPING
    try:
        names = ProcessFunction(_names)(summary, str(summary))
        folders = ProcessFunction(_folders)(mapped, str(mapped)) if is_named(mapped) else {}
    except BadClip as error:
        raise ValueError(str(error)) from error
    return [root / folders.get(name, "") / name for name in names]


def _names(path: Path) -> list[str]:
    """File names that a summary describes. Raises BadClip."""
    names = _dict_in(path)
    for name in names:
        if not isinstance(name, str) or not name.endswith(".pkl") or PurePosixPath(name).name != name:
            raise BadClip(str(path), "name", f"an impossible file {shown(name)}")
    return list(names)


def _folders(path: Path) -> dict[str, str]:
    """File name -> its folder, by a mapping. Raises BadClip."""
    folders = _dict_in(path)
    for name, folder in folders.items():
        if not isinstance(folder, str) or PurePosixPath(folder).is_absolute():
            raise BadClip(str(path), "folder", f"an impossible file {shown(name)} in {shown(folder)}")
    return folders


def _dict_in(path: Path) -> dict[Any, Any]:
    found = load_plain(bytes_of(path), str(path))
    if not isinstance(found, dict):
        raise BadClip(str(path), "pickle", f"holds a {type(found).__name__}, expected a dict by file name")
    return found


def read_scenario(path: Path) -> tuple[dict[str, Any], str]:
    """The scenario dict and the sha256 of its file. Raises BadClip naming the field that is missing."""
    file, data = str(path), bytes_of(path)
    scenario = load_plain(data, file)
    if not isinstance(scenario, dict):
        raise BadClip(file, "scenario", f"holds a {type(scenario).__name__}, not a dict")
    for name in ("metadata", "tracks", "map_features", "dynamic_map_states"):
        if not isinstance(scenario.get(name), dict):
            raise BadClip(file, name, "missing or not a dict")
    if not isinstance(scenario.get("length"), int | np.integer):
        raise BadClip(file, "length", "missing or not a number of frames")
    return scenario, hashlib.sha256(data).hexdigest()


def _source(scenario: Mapping[str, Any], file: str) -> tuple[str, Source]:
    name = scenario["metadata"].get("dataset")
    if not isinstance(name, str) or name not in SOURCES:
        raise BadClip(
            file, "metadata.dataset", f"{shown(name)} is not supported; conversions of {', '.join(SOURCES)} are"
        )
    return name, SOURCES[name]


def read_motion(scenario: Mapping[str, Any], file: str) -> LoggedDrive:
    """Ego and agents of a scenario every 0.1 s. Raises BadClip."""
    n_frames, tracks = int(scenario["length"]), scenario["tracks"]
    _, source = _source(scenario, file)
    sdc_id = scenario["metadata"].get("sdc_id")
    named = id_text(sdc_id)
    if named is None or sdc_id not in tracks:
        raise BadClip(file, "metadata.sdc_id", f"missing, or names no track: {shown(sdc_id)}")
    frames = frames_of(scenario["metadata"], n_frames, file)
    ego, of_ego = whole_ego(read_track(tracks, sdc_id, n_frames, file).at_frames(frames.rows), frames.times_s, file)
    states, segment = ego_segments(ego, source, frames)
    ground = ground_height(ego, frames, file)
    seen, left_out = observed_agents(tracks, named, n_frames, frames, file)
    poses = np.column_stack([ego.position[:, :2], ego.heading])
    poses[:, :2] -= source.origin_to_rear_axle_m * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    poses[~ego.valid] = np.nan
    seen, repairs = repaired(seen, poses)
    repairs = (*frames.repairs, *of_ego, *left_out, *repairs)
    return LoggedDrive(states, agent_tracks(seen, frames, ground), segment, repairs=repairs)


def whole_ego(ego: LoggedTrack, times_s: Array, file: str) -> tuple[LoggedTrack, tuple[Repair, ...]]:
    """The ego without frames that cannot be or lie elsewhere, and with those between two close ones.

    Raises BadClip where most of its frames cannot be.
    """
    frames = np.flatnonzero(ego.valid)
    boxes = np.ones((len(frames), 9))
    boxes[:, :3], boxes[:, 3] = ego.position[frames], ego.heading[frames]
    left, repairs = whole_frames(times_s[frames], boxes)
    if left.sum() <= MOST * len(left):
        raise BadClip(file, "tracks[sdc].state", f"most of {len(left)} poses of the ego are NaN or infinite")
    known = frames[left]
    valid = np.isin(np.arange(len(times_s)), known)
    for before, after in pairwise(known.tolist()):
        if after - before > 1 and times_s[after] - times_s[before] <= MAX_GAP_S:
            valid[before:after] = True
            was = f"no pose for {times_s[after] - times_s[before]:.2f} s"
            repairs += (Repair("gap", EGO, float(times_s[before]), was, "filled in"),)
    if np.array_equal(valid, ego.valid) and left.all():
        return ego, repairs
    heading = np.interp(times_s, times_s[known], np.unwrap(ego.heading[known]))
    position = np.stack([np.interp(times_s, times_s[known], axis) for axis in ego.position[known].T], axis=1)
    return replace(ego, position=position, heading=heading, valid=valid), repairs


def read_log(path: Path) -> ScenarioLog:
    """The whole log: motion, map, route, lights. Raises BadClip."""
    scenario, digest = read_scenario(path)
    file = str(path)
    motion = read_motion(scenario, file)
    name, source = _source(scenario, file)
    n_frames, metadata = int(scenario["length"]), scenario["metadata"]
    frames = frames_of(metadata, n_frames, file)
    times_s = np.interp(np.arange(n_frames), frames.rows, frames.times_s)
    every_light, state_repairs = traffic_lights(scenario["dynamic_map_states"], times_s, file)
    location = id_text(metadata.get("map")) or ""
    lanes, map_repairs = road_map(scenario["map_features"], every_light.lane_ids, name, location, file)
    lights, light_repairs = lights_on_map(every_light, lanes.lanes)
    route = route_of_drive(lanes, motion.ego_states[motion.segment >= 0, :3], file, "map_features")
    return ScenarioLog(
        file=file,
        motion=motion,
        ego_states=motion.ego_states,
        agents=motion.agents,
        road_map=lanes,
        route=route,
        lights=TrafficLights(lights.lane_ids, lights.states[frames.rows[(frames.at + 1e-9).astype(int)]]),
        licence=source.licence,
        content_digest=digest,
        split=folder_split(path) or nuscenes_split(path.stem) or waymo_split(metadata.get("source_file")),
        repairs=(*motion.repairs, *map_repairs, *state_repairs, *light_repairs),
    )
