"""A bank of scenes: the reward of a training step's own proposals, in one call (docs/bank.md).

A scene is kept as its rules take it, packed to the last bit (tasks.reward.packing). What is large of a prepared scene,
the map's index, is not: it is made anew at every call, of the part of the map that the call's drives reach.
"""

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tasks.bank_traffic import unpack_traffic
from tasks.caches import Damaged, parse_json_with_checksum
from tasks.experts.pdm_closed import plan_for
from tasks.kernels.compiled import kernel, read_only
from tasks.kernels.threads import run_in_chunks
from tasks.reward.areas import RedLanes
from tasks.reward.centerline import line_through
from tasks.reward.collisions import CIRCUMRADIUS, obstacles_of, obstacles_of_tracks, with_index
from tasks.reward.comfort import HISTORY_ROWS, N_FLAGS
from tasks.reward.epdms import (
    INDEX_FROM_ROWS,
    N_ROWS,
    N_TIMES,
    NO_REFERENCE,
    PDM_SCORE,
    PreparedScene,
    RuleContext,
    add_up,
    prepare_scene,
    score,
    score_all,
)
from tasks.reward.map_index import Grid, assembled, touched_cells, window_around
from tasks.reward.packing import MOST, packed, unpacked
from tasks.rollout.corridor import Paths
from tasks.rollout.idm import AgentStates, IdmDriver, Roles, Yielding, empty_motion, empty_rows
from tasks.rollout.lqr import follow
from tasks.rollout.simulate import boxes_and_velocities, drive, idm_driver
from tasks.settings import TrafficSettings
from tasks.subscores import LABELLED, OF_ONE_PLAN
from tasks.trajectories import COARSE_STEPS, at_ten_hz, interpolated
from tasks.world.arrays import Array, Bytes, Ints
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, LARGEST, PACIFICA, REAR_AXLE_TO_CENTER, X, Y

# A scene as bytes.

N_PARTS = 20
PLACE, SIZES, EGO, HISTORY, LINE_X, LINE_Y, POINT_X, POINT_Y, EDGE_FROM, EDGE_TO = range(10)
EDGE_KIND, BOUNDED, PLAYING, BOXES, STOPPED, COLLISION, RED_TIMES, RED_BOUNDS, RED_FIRST, RED_EDGES = range(10, N_PARTS)
ORDERS = (0, 0, 0, 0, 2, 2, 2, 2, 2, 2, 1, 0, 0, 2, 1, 1, 1, 0, 0, 1)  # of packing
N_PLACE, N_SIZES, N_LAYERS, BOX = 4, 4, 4, 5  # columns of PLACE and SIZES; parts that a region plays; numbers of a box
FORMAT = 3


def pack_scene(clip: Clip) -> bytes:
    """A clip's scene at T among the logged traffic, its progress relative to PDM-Closed.

    Raises ValueError as `prepare_scene` for a scene that cannot be scored.
    """
    scene = scene_of_clip(clip)
    prepared = prepare_scene(scene, clip.agents.window(NOW, NOW + N_TIMES))
    return pack_prepared(prepared, scene.ego_state, compliant_progress_m(prepared, plan_for(scene).driven))


def compliant_progress_m(prepared: PreparedScene, driven: Array) -> float:
    """What progress is relative to beside a reference's drive (41, 11): its progress [m] times its multiplier."""
    reference = score(prepared, driven[None])
    return float(reference.ep_raw_m[0] * reference.multiplier[0])


def pack_prepared(prepared: PreparedScene, ego_state: Array, reference_m: float = NO_REFERENCE) -> bytes:
    """All that `SceneBank.score` asks of a scene, to the last bit.

    ego_state: (11,) where plans begin; reference_m: of `compliant_progress_m`, NO_REFERENCE where the plans of a call
    are always a batch.
    """
    index, red, boxes = prepared.map_index, prepared.red_lanes, prepared.obstacles.boxes
    ends = index.edges.reshape(-1, 2).view(np.int64)  # -0.0 is not 0.0
    points, first, end = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    by_place = np.argsort(first)  # along the rings, where the next point is foreseen best
    end = np.argsort(by_place)[end.ravel()]
    points, kinds = points[by_place].view(np.float64), np.unique(index.bounded, axis=0, return_inverse=True)
    parts: list[NDArray[Any]] = [
        np.array([index.low_x, index.low_y, index.cell_m, reference_m]),
        np.array([*index.cells.shape, index.n_lane_words, index.bounded.shape[1]]),
        ego_state,
        np.empty(0) if prepared.history is None else prepared.history,
        np.append(prepared.centerline.segments[:, 0], prepared.centerline.segments[-1, 2]),
        np.append(prepared.centerline.segments[:, 1], prepared.centerline.segments[-1, 3]),
        *points.T,
        *(end.reshape(-1, 2).T),
        kinds[1].ravel(),
        kinds[0].view(np.int64),
        index.playing.view(np.int64),
        boxes.transpose(1, 2, 0),
        prepared.obstacles.is_stopped,
        prepared.obstacles.collision_score,
        red.is_red,
        red.bounds,
        red.first,
        red.edges,
    ]
    return packed(parts, ORDERS)


OK, DAMAGED, NO_DRIVE = range(3)
_WHEEL_BASE = PACIFICA.wheel_base
_SHOWN = tuple(LABELLED.index(name) for name in OF_ONE_PLAN)
BEYOND_M = REAR_AXLE_TO_CENTER + CIRCUMRADIUS + 1.0  # no part of the body is that far from the rear axle


@kernel
def _score_packed(data: Bytes, poses: Array, in_batch: bool, subscores: Array, scores: Array) -> int:
    """Sub-scores (P, 8) and scores (P,) of plans (P, 40 or 8, 3) on a packed scene; what went wrong, or OK."""
    values, starts = unpacked(data, ORDERS)
    if not _is_whole(values, starts):
        return DAMAGED
    floats, n_objects = values.view(np.float64), starts[STOPPED + 1] - starts[STOPPED]
    boxes = np.empty((N_TIMES, n_objects, BOX))
    for item in range(n_objects):
        for c in range(BOX):
            for t in range(N_TIMES):
                boxes[t, item, c] = floats[starts[BOXES] + (item * BOX + c) * N_TIMES + t]
    obstacles = obstacles_of(
        boxes, values[starts[STOPPED] : starts[COLLISION]] != 0, floats[starts[COLLISION] : starts[RED_TIMES]].copy()
    )
    if len(poses) >= INDEX_FROM_ROWS:
        obstacles = with_index(obstacles)

    plans = interpolated(poses) if poses.shape[1] == COARSE_STEPS else poses
    states = np.empty((len(plans), N_TIMES, EGO_STATE_SIZE))
    ego = floats[starts[EGO] : starts[HISTORY]].copy()
    if not (follow(ego, np.empty((0, 3)), plans, True, _WHEEL_BASE, states) and _are_near(states)):
        return NO_DRIVE
    context = _context_around(values, starts, states)
    table = np.empty((N_ROWS, len(states)))
    comfort = np.empty((len(states), N_FLAGS), np.bool_)
    beside = NO_REFERENCE if in_batch else floats[starts[PLACE] + 3]
    if not score_all(context, obstacles, states, False, beside, table, comfort):
        return NO_DRIVE
    _show(table, subscores, scores)
    return OK


@kernel
def _score_answered(
    data: Bytes, states: Array, ego_boxes: Array, ego_velocities: Array, in_batch: bool,
    log: AgentStates, now: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver, yielding: Yielding | None,
    collision_score: Array, subscores: Array, scores: Array,
) -> int:  # fmt: skip
    """The same of drives (1 + P, 41, 11), the first PDM-Closed's, each among the traffic that answers to it.

    ego_boxes (P, 41, 5) and ego_velocities (P, 41, 2) of the plans' drives; collision_score (N + 1,): the last the
    ego's, who is left out of the obstacles since it touches itself.
    """
    values, starts = unpacked(data, ORDERS)
    if not _is_whole(values, starts):
        return DAMAGED
    if not _are_near(states):
        return NO_DRIVE
    context, table = _context_around(values, starts, states), np.empty((N_ROWS, len(scores)))
    nothing = empty_rows(0, len(roles.path)), empty_motion(0, len(roles.path))
    pair, of_pair = states[:2].copy(), np.empty((N_ROWS, 2))
    comfort = np.empty((2, N_FLAGS), np.bool_)
    for k in range(len(scores)):
        rows = drive(NOW, log, now, roles, paths, driver, ego_boxes[k], ego_velocities[k], yielding, nothing)[0]
        obstacles = obstacles_of_tracks(rows.boxes, rows.velocities, rows.valid, collision_score, ego_boxes[k, 0])
        pair[1] = states[1 + k]
        if not score_all(context, obstacles, pair, True, NO_REFERENCE, of_pair, comfort):
            return NO_DRIVE
        table[:, k] = of_pair[:, 1]
    if in_batch:
        add_up(table, False, NO_REFERENCE)
    _show(table, subscores, scores)
    return OK


@kernel
def _is_whole(values: Ints, starts: Ints) -> bool:
    """Whether an unpacked scene holds what it is read as: nothing beyond it is."""
    n = starts[1:] - starts[:-1]
    if len(values) == 0 or n[PLACE] != N_PLACE or n[SIZES] != N_SIZES or n[EGO] != EGO_STATE_SIZE:
        return False
    floats = values.view(np.float64)
    at, size = starts[PLACE], starts[SIZES]
    low_x, low_y, cell_m = floats[at], floats[at + 1], floats[at + 2]
    n_rows, n_columns, n_lane_words, n_words = values[size], values[size + 1], values[size + 2], values[size + 3]
    n_objects, n_lanes, n_edges = n[STOPPED], n[RED_FIRST] - 1, n[EDGE_KIND]
    if (
        not (0 < n_rows <= MOST and 0 < n_columns <= MOST // n_rows and 0 <= n_lane_words <= n_words and n_words > 0)
        or (n[HISTORY] != 0 and n[HISTORY] != HISTORY_ROWS * EGO_STATE_SIZE)
        or (n[LINE_X] < 2 or n[LINE_X] != n[LINE_Y] or n[POINT_X] != n[POINT_Y])
        or (n[EDGE_FROM] != n_edges or n[EDGE_TO] != n_edges or n[BOUNDED] % n_words != 0)
        or (n[PLAYING] != N_LAYERS * n_words or n[BOXES] != n_objects * N_TIMES * BOX or n[COLLISION] != n_objects)
        or (n_lanes < 0 or n[RED_BOUNDS] != 4 * n_lanes or n[RED_TIMES] != (N_TIMES * n_lanes if n_lanes else 0))
    ):
        return False
    high_x, high_y = low_x + n_columns * cell_m, low_y + n_rows * cell_m
    for p in range(n[POINT_X]):
        x, y = floats[starts[POINT_X] + p], floats[starts[POINT_Y] + p]
        if not (low_x <= x <= high_x and low_y <= y <= high_y and abs(x) <= LARGEST and abs(y) <= LARGEST):
            return False
    for e in range(n_edges):
        start, stop = values[starts[EDGE_FROM] + e], values[starts[EDGE_TO] + e]
        kind = values[starts[EDGE_KIND] + e]
        if not (0 <= start < n[POINT_X] and 0 <= stop < n[POINT_X] and 0 <= kind < n[BOUNDED] // n_words):
            return False
    for lane in range(n_lanes):
        first, end = values[starts[RED_FIRST] + lane], values[starts[RED_FIRST] + lane + 1]
        if not 0 <= first <= end <= n[RED_EDGES] // 4:
            return False
    return True


@kernel
def _are_near(states: Array) -> bool:
    """Whether all places of drives (K, 41, 11) are some."""
    for k in range(len(states)):
        for t in range(N_TIMES):
            if not (abs(states[k, t, X]) <= LARGEST and abs(states[k, t, Y]) <= LARGEST):
                return False
    return True


@kernel
def _context_around(values: Ints, starts: Ints, states: Array) -> RuleContext:
    """What drives (K, 41, 11) are judged against, the map as far as they reach."""
    n, floats, at, size = starts[1:] - starts[:-1], values.view(np.float64), starts[PLACE], starts[SIZES]
    n_lane_words, n_words = values[size + 2], values[size + 3]
    n_edges, n_lanes, n_red_edges = n[EDGE_KIND], n[RED_FIRST] - 1, n[RED_EDGES] // 4
    edges, bounded = np.empty((n_edges, 4)), np.empty((n_edges, n_words), np.uint64)
    for e in range(n_edges):
        start, stop = values[starts[EDGE_FROM] + e], values[starts[EDGE_TO] + e]
        kind = values[starts[EDGE_KIND] + e]
        edges[e, 0], edges[e, 1] = floats[starts[POINT_X] + start], floats[starts[POINT_Y] + start]
        edges[e, 2], edges[e, 3] = floats[starts[POINT_X] + stop], floats[starts[POINT_Y] + stop]
        for w in range(n_words):
            bounded[e, w] = np.uint64(values[starts[BOUNDED] + kind * n_words + w])
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in range(len(states)):
        for t in range(N_TIMES):
            x, y = states[k, t, X], states[k, t, Y]
            low[0], low[1], high[0], high[1] = min(low[0], x), min(low[1], y), max(high[0], x), max(high[1], y)
    low -= BEYOND_M
    high += BEYOND_M
    whole = Grid(floats[at], floats[at + 1], floats[at + 2], 0, 0, values[size], values[size + 1])
    grid = window_around(whole, low[0], low[1], high[0], high[1])
    playing = values[starts[PLAYING] : starts[BOXES]].copy().view(np.uint64).reshape(N_LAYERS, n_words)
    index = assembled(grid, touched_cells(edges, grid)[0], edges, bounded, playing, n_lane_words)
    red = RedLanes(
        (values[starts[RED_TIMES] : starts[RED_BOUNDS]] != 0).reshape(N_TIMES if n_lanes else 0, n_lanes),
        floats[starts[RED_BOUNDS] : starts[RED_FIRST]].copy().reshape(n_lanes, 4),
        values[starts[RED_FIRST] : starts[RED_EDGES]].copy(),
        floats[starts[RED_EDGES] : starts[RED_EDGES + 1]].copy().reshape(4, n_red_edges),
    )
    history = floats[starts[HISTORY] : starts[LINE_X]].copy().reshape(n[HISTORY] // EGO_STATE_SIZE, EGO_STATE_SIZE)
    line = line_through(floats[starts[LINE_X] : starts[LINE_Y]].copy(), floats[starts[LINE_Y] : starts[POINT_X]].copy())
    return RuleContext(line, index, red, history)


@kernel
def _show(table: Array, subscores: Array, scores: Array) -> None:
    for k in range(len(scores)):
        scores[k] = table[PDM_SCORE, k]
        for i in range(len(_SHOWN)):
            subscores[k, i] = table[_SHOWN[i], k]


# A folder of them: shards of some thousand scenes, each files of bytes and a head that says where its scenes are.

Reference = Literal["pdm_closed", "batch"]
Traffic = Literal["replay", "idm"]
HEAD, BODY, ANSWERING = "scenes-*.json", ".bank", ".traffic"


@dataclass(frozen=True)
class BankScores:
    """Scores of P plans on each of B scenes."""

    subscores: Array  # (B, P, 8) in the order of `names`, 0 .. 1, float64 unless the caller's own are other
    score: Array  # (B, P) EPDMS of one frame, without extended comfort
    names: tuple[str, ...] = OF_ONE_PLAN


class SceneBank:
    """Scenes by clip id, or by NAVSIM's token of the frame at T, to score plans on; what
    `factory.setup.bank.write_bank` wrote. Pickles, and may be forked.

    Raises FileNotFoundError where there are none, Damaged for a head or a body that is not as it was written.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._bodies: list[Bytes] = []
        self._place: dict[tuple[str, str], tuple[int, int, int, int]] = {}  # file, first byte, past the last, CRC-32
        self._drivers: set[IdmDriver] = set()  # of the answering traffic
        self.left_out: dict[str, str] = {}  # clip id -> why it has no scene
        self.tokens: dict[str, str] = {}  # of the log's frames at T -> clip id
        heads = sorted(self.folder.glob(HEAD))
        if not heads:
            raise FileNotFoundError(f"{folder}: no {HEAD} in it: write it by factory.setup.bank.write_bank")
        for path in heads:
            head = read_head(path)
            self._open(path, BODY, head["clip_ids"], head)
            if answering := head.get("traffic"):
                self._open(path, ANSWERING, head["clip_ids"], answering)
                self._drivers.add(idm_driver(TrafficSettings(**answering["settings"])))
            self.left_out.update(head["left_out"])
            self.tokens.update(head["tokens"])
        self.clip_ids = tuple(clip_id for clip_id, suffix in self._place if suffix == BODY)
        self._whole: set[tuple[str, str]] = set()  # whose bytes were held against their checksum

    def _open(self, head: Path, suffix: str, clip_ids: list[str], where: dict[str, Any]) -> None:
        body, ends = head.with_suffix(suffix), where["ends"]
        if not body.is_file() or body.stat().st_size != ends[-1]:
            raise Damaged(f"{body}: not {ends[-1]:,} bytes: remove {head.name} and write the bank again")
        places = zip([len(self._bodies)] * len(ends), ends, ends[1:], where["crc32"])
        self._place.update(zip(((clip_id, suffix) for clip_id in clip_ids), places, strict=False))
        self._bodies.append(np.memmap(body, np.uint8, "r") if ends[-1] else np.empty(0, np.uint8))

    def __reduce__(self) -> tuple[type["SceneBank"], tuple[Path]]:
        return type(self), (self.folder,)

    def __len__(self) -> int:
        return len(self.clip_ids)

    def n_bytes(self, clip_id: str, suffix: str = BODY) -> int:
        """Of a scene, or with ANSWERING of its traffic, in the files."""
        return len(self._bytes_of(clip_id, suffix))

    def score(
        self,
        clip_ids: Sequence[str],
        poses: Array,
        *,
        reference: Reference = "pdm_closed",
        traffic: Traffic = "replay",
        threads: int | None = None,
        out: BankScores | None = None,
    ) -> BankScores:
        """Scores of P plans made at T on each of B scenes, driven by the tracker.

        Equal to those of `tasks.trajectories.score_trajectories` to the last bit, on any number of threads (None: as
        many as this process may use); with traffic="idm", which answers to each plan, to those that
        `tasks.attempt.drive_and_judge` gives it. poses: (B, P, 40, 3) at 10 Hz or (B, P, 8, 3) at 2 Hz: x, y [m],
        heading [rad] in the ego frame at T; reference: as there. out: arrays of float32 or float64 that get the scores;
        None makes new ones of float64. Poses are never copied as a whole: what is not float64 in a row is made so a
        scene at a time.
        Raises KeyError for an unknown scene, ValueError for other shapes, poses that are no drive, another word or a
        bank without answering traffic, and Damaged where a scene's bytes are not as they were written.
        """
        plans = np.asarray(poses)
        if plans.ndim != 4 or len(plans) != len(clip_ids):
            raise ValueError(
                f"poses must be ({len(clip_ids)}, P, {HORIZON_STEPS} or {COARSE_STEPS}, 3), got {plans.shape}"
            )
        if reference not in get_args(Reference):
            raise ValueError(f"reference must be one of {get_args(Reference)}, got {reference!r}")
        if traffic not in get_args(Traffic):
            raise ValueError(f"traffic must be one of {get_args(Traffic)}, got {traffic!r}")
        n_scenes, n_plans = plans.shape[:2]
        at_ten_hz(plans[:0].reshape(-1, *plans.shape[2:]))  # its shape
        found = out or BankScores(np.empty((n_scenes, n_plans, len(OF_ONE_PLAN))), np.empty((n_scenes, n_plans)))
        if found.subscores.shape != (n_scenes, n_plans, len(OF_ONE_PLAN)) or found.score.shape != (n_scenes, n_plans):
            raise ValueError(f"out must be ({n_scenes}, {n_plans}, {len(OF_ONE_PLAN)}) and ({n_scenes}, {n_plans})")
        scenes = [self._bytes_of(clip_id) for clip_id in clip_ids]
        answering = [self._bytes_of(clip_id, ANSWERING) for clip_id in clip_ids] if traffic == "idm" else []

        def work(b: int, _: int) -> None:
            subscores, scores = np.empty((n_plans, len(OF_ONE_PLAN))), np.empty(n_plans)
            of_scene = np.require(plans[b], np.float64, ["C", "W"])
            given = scenes[b], of_scene, reference == "batch", subscores, scores
            try:
                went = self._among_answering(answering[b], *given) if answering else _score_packed(*given)
            except (Damaged, ZeroDivisionError):  # the rollout's, among numbers that no scene has
                went = DAMAGED
            if went == DAMAGED:
                raise Damaged(
                    f"{self.folder}: scene {clip_ids[b]}: not as this version writes it: write the bank again"
                )
            if went == NO_DRIVE:
                raise ValueError(f"poses[{b}] ({clip_ids[b]}): a plan or its drive is not finite or above {LARGEST:g}")
            found.subscores[b], found.score[b] = subscores, scores

        if n_plans:
            run_in_chunks(work, n_scenes, 1, threads or len(os.sched_getaffinity(0)))
        return found

    def _among_answering(
        self, answering: Bytes, data: Bytes, poses: Array, in_batch: bool, subscores: Array, scores: Array
    ) -> int:
        banked, (driver,) = unpack_traffic(answering), self._drivers
        states = np.empty((1 + len(poses), N_TIMES, EGO_STATE_SIZE))
        states[0] = banked.reference
        ego, plans = read_only(banked.reference[0]), read_only(at_ten_hz(poses))
        if not follow(ego, read_only(np.empty((0, 3))), plans, True, _WHEEL_BASE, states[1:]):
            return NO_DRIVE
        return _score_answered(
            data, states, *boxes_and_velocities(states[1:]), in_batch, banked.log, banked.now, banked.roles,
            banked.paths, driver, banked.yielding, np.append(banked.collision_score, 0.0), subscores, scores,
        )  # fmt: skip

    def _bytes_of(self, clip_id: str, suffix: str = BODY) -> Bytes:
        clip_id = self.tokens.get(clip_id, clip_id)
        if (clip_id, BODY) not in self._place:
            raise KeyError(f"{self.folder}: no scene {clip_id!r} among its {len(self):,}")
        if (clip_id, suffix) not in self._place:
            raise ValueError(
                f"{self.folder}: no traffic that answers: write it by write_bank(traffic=TrafficSettings())"
            )
        file, first, last, crc = self._place[clip_id, suffix]
        data = self._bodies[file][first:last]
        if (clip_id, suffix) not in self._whole:
            if zlib.crc32(data.tobytes()) != crc:
                raise Damaged(f"{self.folder}: scene {clip_id}: its checksum is another: write the bank again")
            self._whole.add((clip_id, suffix))
        return np.asarray(data)


def read_head(path: Path) -> dict[str, Any]:
    """A shard's head: format, clip_ids, ends (first 0), crc32, left_out, tokens, and of traffic that answers, where
    there is some, settings, ends, crc32. Raises Damaged naming the file.
    """
    try:
        head = parse_json_with_checksum(path.read_bytes())
    except Damaged as error:
        raise Damaged(f"{path}: {error}: remove it and write the bank again") from error
    if head["format"] != FORMAT:
        raise Damaged(f"{path}: format {head['format']}, this version reads {FORMAT}: write the bank again")
    return head
