"""navhard and navtest as benchmarks of ours: samples to plan from, and scenes to drive in.

Of navhard a group of the split's `reactive_all_mapping` is a clip: its stage-one frames are the log's at T and 0.5 s
before, its pairs of synthetic scenes the follow-ups, numbered as they stand there. Nobody drove from a synthetic scene,
so the label of its sample is PDM-Closed's drive, which no score is made of.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

from factory.datasets.navsim.import_rows import (
    HISTORY_FRAMES,
    SCENE_FRAMES,
    ImportEntry,
    SceneOrigin,
    import_identity,
    import_rows,
    label_columns_of,
    logged_label_columns,
    picture_columns,
    scene_of_frames,
    world_columns,
)
from factory.datasets.navsim.log import read_frames, read_scene_pickle
from factory.datasets.navsim.reader import Selection, cached_or_read_table, log_files, scene_frames
from factory.datasets.navsim.window import ego_states, road_around
from factory.files import matching
from factory.graph.execute import RunSummary
from factory.readers.base import BadClip, failures_as_bad_clip
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.stages.rows import NO_IMAGES
from factory.store.location import SceneFiles
from factory.store.samples import Store
from factory.store.schema import RunIdentity
from tasks.experts.pdm_closed import plan_for
from tasks.hard_scenes import GivenScenes, OneStageClip
from tasks.render.settings import ImageSource
from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, HUMAN, HUMAN_BEFORE
from tasks.world.clip import Scene
from tasks.world.frames import HEADING

NAVHARD, NAVTEST = "navhard", "navtest"
LICENCE = "CC BY-NC-SA 4.0 (NAVSIM, of nuPlan)"
NO_CANDIDATE = -1
MOST_APART_US = 550_000  # between two frames whose plans are compared
Row = dict[str, object]


@dataclass(frozen=True)
class NavsimFolders:
    """Where NAVSIM's files lie."""

    logs: Path  # navsim_logs/<split>
    sensors: Path | None  # sensor_blobs/<split>; None: frames without pictures
    scenes: Path | None  # navhard_two_stage: synthetic_scene_pickles and sensor_blobs; None of navtest
    maps: Path


@dataclass(frozen=True)
class SceneGroup:
    """One entry of `reactive_all_mapping`."""

    now: str  # token of the stage-one frame
    before: str  # of the one 0.5 s earlier
    pairs: tuple[tuple[str, str], ...]  # of second-stage scenes, now and before
    log: Path | None = None  # of the stage-one frames; None: no log here has them

    @property
    def clip_id(self) -> str:
        return _clip_id(NAVHARD, self.now, self.before)

    @property
    def log_id(self) -> str:
        return self.log.stem if self.log else ""

    @property
    def frames(self) -> list[tuple[str, int]]:
        """Kind and number of each."""
        pairs = [(kind, i) for i in range(len(self.pairs)) for kind in (FOLLOW_UP, FOLLOW_UP_BEFORE)]
        return [(HUMAN, NO_CANDIDATE), (HUMAN_BEFORE, NO_CANDIDATE), *pairs]


@dataclass(frozen=True)
class OneStageFrame:
    """One frame of a benchmark of one stage."""

    token: str
    log: Path
    timestamp_us: int
    start_ms: int
    before: str | None = None  # the token up to 0.55 s earlier, if that is one of the benchmark's

    @property
    def clip_id(self) -> str:
        return _clip_id(NAVTEST, self.token)


def _clip_id(*names: str) -> str:
    return sha256("\x1f".join(names).encode()).hexdigest()[:16]


class FrameImporter:
    """Frames of logs and synthetic scenes as rows; their scenes are written beside. The last log stays open."""

    def __init__(self, dataset: str, places: NavsimFolders, store: Store) -> None:
        self.dataset, self.places = dataset, places
        self._scenes = SceneFiles(store.location.child("scenes"))
        self._open = lru_cache(maxsize=1)(read_frames)
        self._rows = lru_cache(maxsize=1)(self._read_group)

    def token_row(self, one: OneStageFrame) -> Row:
        """The columns of one frame. Raises BadClip."""
        scene, columns = self._logged(one.log, one.token, one.clip_id)
        self._scenes.store(OneStageClip(scene.clip))
        return columns

    def group_row(self, group: SceneGroup, kind: str, number: int) -> Row:
        """One frame's columns. All of a group's frames fail with one: it counts whole or not at all. Raises BadClip."""
        rows = self._rows(group)
        if isinstance(rows, BadClip):
            raise rows
        return rows[kind, number]

    def _read_group(self, group: SceneGroup) -> dict[tuple[str, int], Row] | BadClip:
        try:
            with failures_as_bad_clip(f"token {group.now}"):
                if group.log is None:
                    raise BadClip(str(self.places.logs), f"token {group.now}", "in no log here")
                logged = [self._logged(group.log, token, group.clip_id) for token in (group.now, group.before)]
                pairs = [[self._synthetic(token, group) for token in pair] for pair in group.pairs]
                rows = [row for frames in (logged, *pairs) for _, row in frames]
                (now, _), (before, _) = logged
                follow_ups = [(number, (one.clip, two.clip)) for number, ((one, _), (two, _)) in enumerate(pairs)]
                self._scenes.store(GivenScenes(now.clip, before.clip, tuple(follow_ups)))
                parent = logged_label_columns(now)["parent_states"]
                return {frame: {**row, "parent_states": parent} for frame, row in zip(group.frames, rows)}
        except BadClip as error:
            return error

    def _logged(self, path: Path, token: str, clip_id: str) -> tuple[Scene, Row]:
        """A frame as a world to drive in, 1.5 s before it and 4 s after it, and its row. Raises BadClip."""
        log = self._open(path)
        at = next((i for i, frame in enumerate(log.frames) if frame.token == token), -1)
        first = at - HISTORY_FRAMES + 1
        if at < 0 or first < 0 or first + SCENE_FRAMES > len(log.frames):
            raise BadClip(log.file, f"token {token}", "not here with 1.5 s before and 4 s after it")
        frames, now = log.frames[first : first + SCENE_FRAMES], log.frames[at]
        road = road_around(self.places.maps, now, ego_states(frames)[:, :2], now.pose, log.file, at)
        scene = scene_of_frames(frames, road, self._origin(log.file, log.name, clip_id, token))
        seen: Row = dict(NO_IMAGES)
        if self.places.sensors is not None:
            seen = picture_columns(frames[:HISTORY_FRAMES], self.places.sensors, ImageSource.PHOTO, log.file)
        return scene, {**world_columns(scene, now.command), **logged_label_columns(scene), **seen}

    def _synthetic(self, token: str, group: SceneGroup) -> tuple[Scene, Row]:
        """A scene of the second stage. Raises BadClip."""
        assert self.places.scenes is not None
        path = self.places.scenes / "synthetic_scene_pickles" / f"{token}.pkl"
        found = read_scene_pickle(path)
        if found.token != token:
            raise BadClip(str(path), "scene_metadata.initial_token", f"is {found.token}, the file's name says {token}")
        history = found.frames[:HISTORY_FRAMES]
        xy, now = ego_states(history)[:, :2], history[-1]
        road = road_around(self.places.maps, now, xy, now.pose, str(path), HISTORY_FRAMES - 1)
        origin = self._origin(str(path), group.log_id, group.clip_id, token)
        scene = scene_of_frames(found.frames, road, origin, HISTORY_FRAMES)
        label = label_columns_of(scene, plan_for(scene).driven[1:, : HEADING + 1])
        seen: Row = dict(NO_IMAGES)
        if self.places.sensors is not None:
            seen = picture_columns(history, self.places.scenes / "sensor_blobs", ImageSource.RENDER, str(path))
        return scene, {**world_columns(scene, now.command), **label, **seen}

    def _origin(self, file: str, log: str, clip_id: str, token: str) -> SceneOrigin:
        digest = sha256(token.encode()).hexdigest()
        return SceneOrigin(file, clip_id, self.dataset, log, "test", LICENCE, digest, None)


def import_navhard(store: Store, selection: Selection, places: NavsimFolders) -> tuple[RunSummary, str]:
    """Every frame of the split's groups into a store, and its benchmark; how that ended, and a line about it.

    Raises ValueError and BadClip where nothing can begin, and what `import_rows` raises.
    """
    groups, reader = scene_groups(selection, places.logs), FrameImporter(NAVHARD, places, store)
    entries = [
        ImportEntry(
            group.clip_id, NAVHARD, group.log_id, kind, 0, number, partial(reader.group_row, group, kind, number)
        )
        for group in groups
        for kind, number in group.frames
    ]
    identity = import_identity(NAVHARD, {"pictures": places.sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, entries)
    names = ["clip_id", "expert", "candidate_index"]
    made = {tuple(row.values()) for row in store.samples.read(names).select(names).to_pylist()}
    scenes = set(SceneFiles(store.location.child("scenes")).clip_ids())
    whole = {g for g in groups if g.clip_id in scenes and all((g.clip_id, *frame) in made for frame in g.frames)}
    clips: list[Row] = []
    left_out: list[Row] = []
    for group in groups:
        named = {"clip_id": group.clip_id, "dataset": NAVHARD, "log_id": group.log_id, "start_ms": 0}
        if group in whole:
            tokens = {"tokens": [group.now, group.before], "follow_up_tokens": [list(pair) for pair in group.pairs]}
            clips.append({**named, "follow_ups": list(range(len(group.pairs))), **tokens})
        else:
            left_out.append({**named, "why": "failed", "follow_ups": len(group.pairs)})
    _write_benchmark(store, identity, {"rounds": 1, "min_follow_ups": 1, "pair_interval_s": 0.5}, clips, left_out)
    counted = f"{len(clips)} groups, {sum(len(group.pairs) for group in whole)} pairs of follow-ups"
    return summary, f"benchmark {store.location.uri}: {counted}; left out {len(left_out)}"


def scene_groups(selection: Selection, logs: Path) -> list[SceneGroup]:
    """The groups of a split and their logs. Raises ValueError where it has none, one is none, or no token is here.

    A log that is named and not here is left out: what needs it fails by name. Raises BadClip for a broken one.
    """
    if not selection.reactive_all_mapping:
        raise ValueError(f"split={selection.name}: no reactive_all_mapping: it names no scenes of a second stage")
    groups = []
    for i, entry in enumerate(selection.reactive_all_mapping):
        try:
            now, before, pairs = entry
            group = SceneGroup(now, before, tuple((first, second) for first, second in pairs))
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{selection.name}: reactive_all_mapping[{i}] is not [now, before, [pairs]]") from error
        if not group.pairs or not all(isinstance(t, str) for t in (now, before, *sum(group.pairs, ()))):
            raise ValueError(f"{selection.name}: reactive_all_mapping[{i}]: expected tokens as text, one pair or more")
        groups.append(group)
    tokens = frozenset(token for group in groups for token in (group.now, group.before))
    names = selection.scene_filter.log_names
    paths = matching(logs, "*.pkl") if names is None else [logs / f"{name}.pkl" for name in sorted(names)]
    log_of: dict[str, Path] = {}
    for path in (path for path in paths if path.is_file()):
        log_of |= {token: path for token in cached_or_read_table(path).tokens.tolist() if token in tokens}
    if not log_of:
        raise ValueError(f"logs={logs}: none of the {len(tokens)} stage-one tokens is in the logs here")
    return [replace(group, log=log_of.get(group.now)) for group in groups]


def import_navtest(store: Store, selection: Selection, places: NavsimFolders) -> tuple[RunSummary, str]:
    """Every frame of a selection into a store, and its benchmark; how that ended, and a line about it.

    Which frames count is the public loader's choice (navsim/common/dataloader.py:24-73 at autonomousvision/navsim @
    0a380a9). Two plans are compared (extended comfort) where the token before in the log is at most 0.55 s earlier
    (`infer_start_adjacent_mapping`, navsim/planning/script/run_pdm_score_one_stage.py), so a clip names that one's
    clip. Raises ValueError and BadClip where nothing can begin, and what `import_rows` raises.
    """
    tokens, absent = one_stage_frames(selection, places.logs)
    reader = FrameImporter(NAVTEST, places, store)
    entries = [
        ImportEntry(one.clip_id, NAVTEST, one.log.stem, HUMAN, 0, NO_CANDIDATE, partial(reader.token_row, one))
        for one in tokens
    ]
    identity = import_identity(NAVTEST, {"pictures": places.sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, entries)
    made = set(store.samples.read(["clip_id"]).column("clip_id").to_pylist())
    made &= set(SceneFiles(store.location.child("scenes")).clip_ids())
    clips: list[Row] = []
    left_out: list[Row] = [{"token": token, "why": "absent_token"} for token in absent]
    for one in tokens:
        named = {"clip_id": one.clip_id, "dataset": NAVTEST, "log_id": one.log.stem, "start_ms": one.start_ms}
        before = None if one.before is None else _clip_id(NAVTEST, one.before)
        if one.clip_id in made:
            compared = before if before in made else None
            clips.append({**named, "follow_ups": [], "tokens": [one.token], "before": compared})
        else:
            left_out.append({**named, "why": "failed", "token": one.token})
    _write_benchmark(store, identity, {"stages": 1}, clips, left_out)
    return summary, f"benchmark {store.location.uri}: {len(clips)} frames; left out {len(left_out)}"


def one_stage_frames(selection: Selection, logs: Path) -> tuple[list[OneStageFrame], list[str]]:
    """The frames that the selection's scene filter chooses, log by log in time, and its tokens that are no frame here.

    A log that is named and not here is left out with its tokens. Raises BadClip for a log that is broken, and
    ValueError where nothing is chosen.
    """
    found: list[OneStageFrame] = []
    for path, table, frames in scene_frames(selection.scene_filter, log_files(logs)):
        starts = table.start_ms
        found += [
            OneStageFrame(str(table.tokens[at]), path, int(table.timestamps_us[at]), int(starts[at])) for at in frames
        ]
    if not found:
        raise ValueError(f"logs={logs}: none of the frames that {selection.name} names is in the logs here")
    for i, (last, now) in enumerate(pairwise(found), start=1):
        if now.log == last.log and 0 < now.timestamp_us - last.timestamp_us <= MOST_APART_US:
            found[i] = replace(now, before=last.token)
    return found, sorted(set(selection.scene_filter.tokens or ()) - {one.token for one in found})


def _write_benchmark(
    store: Store, identity: RunIdentity, stages: Row, clips: Sequence[Row], left_out: Sequence[Row]
) -> None:
    """benchmark.json of the clips all of whose frames are samples."""
    document = {
        "format": FORMAT,
        "settings_hash": identity.settings_hash,
        "settings": dict(identity.settings),
        "stage_versions": dict(identity.stage_versions),
        "vocabulary_digest": identity.vocabulary_digest,
        **stages,
        "clips": clips,
        "left_out": left_out,
    }
    store.location.write(BENCHMARK_FILE, (json.dumps(document, indent=1) + "\n").encode())
