"""navhard and navtest as benchmarks of ours: samples to plan from, and scenes to drive in.

Of navhard a group of the split's `reactive_all_mapping` is a clip: its stage-one frames are the log's at T and 0.5 s
before, its pairs of synthetic scenes the follow-ups, numbered as they stand there. Nobody drove from a synthetic scene,
so the label of its sample is PDM-Closed's drive, which no score is made of.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

from factory.datasets.navsim.import_rows import (
    HISTORY_FRAMES,
    SCENE_FRAMES,
    Entry,
    Origin,
    identity_of,
    import_rows,
    label_columns_of,
    logged_label,
    pictures,
    scene_of,
    world_columns,
)
from factory.datasets.navsim.log import LogFrames, SyntheticScene, read_frames, read_scene_pickle
from factory.datasets.navsim.reader import Choice, Selection, log_files, table_at, wanted_windows
from factory.datasets.navsim.window import ego_states, road_around
from factory.files import matching
from factory.graph.execute import RunSummary
from factory.readers.apart import Apart
from factory.readers.base import BadClip, failing_as
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.stages.imaging import NO_IMAGES
from factory.store.location import SceneFiles
from factory.store.samples import Store
from factory.store.schema import RunIdentity
from tasks.caches import user_cache
from tasks.experts.pdm_closed import PdmSettings, plan_for
from tasks.hard_scenes import GivenScenes, OneStageClip
from tasks.render.settings import ImageSource
from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, HUMAN, HUMAN_BEFORE
from tasks.world.clip import Scene
from tasks.world.frames import HEADING

# A frame of NAVSIM's logs as a sample and as a world to drive in: 1.5 s before it, 4 s after it.


def logged_frame(
    log: LogFrames, token: str, maps: Path, sensors: Path | None, origin: Origin
) -> tuple[Scene, dict[str, object]]:
    """The scene at the token's frame, and the columns of its row; sensors: None for one without pictures.

    Raises BadClip where the log does not hold all of it.
    """
    at = next((i for i, frame in enumerate(log.frames) if frame.token == token), -1)
    first = at - HISTORY_FRAMES + 1
    if at < 0 or first < 0 or first + SCENE_FRAMES > len(log.frames):
        raise BadClip(log.file, f"token {token}", "not here with 1.5 s before and 4 s after it")
    frames = log.frames[first : first + SCENE_FRAMES]
    now = log.frames[at]
    road = road_around(maps, now, ego_states(frames)[:, :2], now.pose, log.file, at)
    scene = scene_of(frames, road, origin)
    seen: dict[str, object] = dict(NO_IMAGES)
    if sensors is not None:
        seen = pictures(frames[:HISTORY_FRAMES], sensors, ImageSource.PHOTO, log.file)
    return scene, {**world_columns(scene, now.command), **logged_label(scene), **seen}


NAVHARD = "navhard"
LICENCE = "CC BY-NC-SA 4.0 (NAVSIM, of nuPlan)"
NO_CANDIDATE = -1
FRAME_MS = 500


@dataclass(frozen=True)
class NavsimFolders:
    """Where NAVSIM's files lie."""

    logs: Path  # navsim_logs/<split>
    sensors: Path | None  # sensor_blobs/<split>; None: frames without pictures
    scenes: Path  # navhard_two_stage: synthetic_scene_pickles and sensor_blobs
    maps: Path


@dataclass(frozen=True)
class SceneGroup:
    """One entry of `reactive_all_mapping`."""

    now: str  # token of the stage-one frame
    before: str  # of the one 0.5 s earlier
    pairs: tuple[tuple[str, str], ...]  # of second-stage scenes, now and before

    @property
    def clip_id(self) -> str:
        return sha256("\x1f".join((NAVHARD, self.now, self.before)).encode()).hexdigest()[:16]


def groups_of(selection: Selection) -> list[SceneGroup]:
    """The groups of a split. Raises ValueError where it has none, or one is none."""
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
    return groups


@dataclass
class GroupReader:
    """Reads a group when its first row is wanted, keeps it until the next group's, and the log of the last."""

    places: NavsimFolders
    log_of: dict[str, Path]  # token of a stage-one frame -> its log
    store: Store
    _log: LogFrames | None = None
    _group: SceneGroup | None = None
    _why: BadClip | None = None
    _rows: dict[tuple[str, str, int], dict[str, object]] = field(default_factory=dict)

    def row(self, group: SceneGroup, kind: str, number: int) -> dict[str, object]:
        """One frame's columns. The scenes of the whole group are written beside. Raises BadClip."""
        if self._group != group:
            self._group, self._why = group, None
            try:
                with failing_as(f"token {group.now}"):
                    self._rows = dict(self._read(group))
            except BadClip as error:  # all of its frames fail with it: a group counts whole or not at all
                self._why = error
        if self._why is not None:
            raise self._why
        return self._rows[group.clip_id, kind, number]

    def log_id(self, group: SceneGroup) -> str:
        """The group's log; empty where no log has it."""
        path = self.log_of.get(group.now)
        return path.stem if path else ""

    def _read(self, group: SceneGroup) -> Iterator[tuple[tuple[str, str, int], dict[str, object]]]:
        log = self._opened(group)
        logged = [self._logged(log, token, group) for token in (group.now, group.before)]
        parent = logged_label(logged[0][0])["parent_states"]
        for kind, (_, row) in zip((HUMAN, HUMAN_BEFORE), logged):
            yield (group.clip_id, kind, NO_CANDIDATE), {**row, "parent_states": parent}
        follow_ups = []
        for number, pair in enumerate(group.pairs):
            found = [self._synthetic(token, group, log.name) for token in pair]
            follow_ups.append((number, (found[0][0].clip, found[1][0].clip)))
            for kind, (_, row) in zip((FOLLOW_UP, FOLLOW_UP_BEFORE), found):
                yield (group.clip_id, kind, number), {**row, "parent_states": parent}
        scenes = GivenScenes(logged[0][0].clip, logged[1][0].clip, tuple(follow_ups))
        SceneFiles(self.store.location.child("scenes")).store(scenes)

    def _opened(self, group: SceneGroup) -> LogFrames:
        path = self.log_of.get(group.now)
        if path is None:
            raise BadClip(str(self.places.logs), f"token {group.now}", "in no log here")
        if self._log is None or self._log.file != str(path):
            self._log = read_frames(path)
        return self._log

    def _logged(self, log: LogFrames, token: str, group: SceneGroup) -> tuple[Scene, dict[str, object]]:
        origin = self._origin(log.file, log.name, group, token)
        return logged_frame(log, token, self.places.maps, self.places.sensors, origin)

    def _synthetic(self, token: str, group: SceneGroup, log: str) -> tuple[Scene, dict[str, object]]:
        path = self.places.scenes / "synthetic_scene_pickles" / f"{token}.pkl"
        found: SyntheticScene = read_scene_pickle(path)
        if found.token != token:
            raise BadClip(str(path), "scene_metadata.initial_token", f"is {found.token}, the file's name says {token}")
        history = found.frames[:HISTORY_FRAMES]
        xy, now = ego_states(history)[:, :2], history[-1]
        road = road_around(self.places.maps, now, xy, now.pose, str(path), HISTORY_FRAMES - 1)
        scene = scene_of(found.frames, road, self._origin(str(path), log, group, token), HISTORY_FRAMES)
        plan = plan_for(scene, PdmSettings())
        label = label_columns_of(scene, plan.driven[1:, : HEADING + 1])
        seen: dict[str, object] = dict(NO_IMAGES)
        if self.places.sensors is not None:
            seen = pictures(history, self.places.scenes / "sensor_blobs", ImageSource.RENDER, str(path))
        return scene, {**world_columns(scene, history[-1].command), **label, **seen}

    def _origin(self, file: str, log: str, group: SceneGroup, token: str) -> Origin:
        digest = sha256(token.encode()).hexdigest()
        return Origin(file, group.clip_id, NAVHARD, log, "test", LICENCE, digest, None)


def entries_of(groups: Sequence[SceneGroup], reader: GroupReader) -> list[Entry]:
    """Every frame of every group, group by group."""
    keys = [
        (group, kind, number)
        for group in groups
        for kind, number in (
            *((kind, NO_CANDIDATE) for kind in (HUMAN, HUMAN_BEFORE)),
            *((kind, i) for i in range(len(group.pairs)) for kind in (FOLLOW_UP, FOLLOW_UP_BEFORE)),
        )
    ]
    return [
        Entry(group.clip_id, NAVHARD, reader.log_id(group), kind, 0, number, partial(reader.row, group, kind, number))
        for group, kind, number in keys
    ]


def _tokens_in(path: Path) -> list[str]:
    return [frame.token for frame in read_frames(path).frames]


def logs_of_tokens(logs: Path, tokens: frozenset[str], names: Sequence[str] | None) -> dict[str, Path]:
    """Token -> the log that has it, of the logs that are named, None: of all. Raises BadClip, and ValueError for none.

    A log that is named and not here is left out: what needs it fails by name.
    """
    paths = matching(logs, "*.pkl") if names is None else [logs / f"{name}.pkl" for name in sorted(names)]
    found: dict[str, Path] = {}
    for path in (path for path in paths if path.is_file()):
        found |= {token: path for token in Apart(_tokens_in)(path, str(path)) if token in tokens}
    if not found:
        raise ValueError(f"logs={logs}: none of the {len(tokens)} stage-one tokens is in the logs here")
    return found


def import_navhard(store: Store, selection: Selection, places: NavsimFolders) -> tuple[RunSummary, str]:
    """Every frame of the split's groups into a store, and its benchmark; how that ended, and a line about it.

    Raises ValueError and BadClip where nothing can begin, and what `import_rows` raises.
    """
    groups = groups_of(selection)
    tokens = frozenset(token for group in groups for token in (group.now, group.before))
    reader = GroupReader(places, logs_of_tokens(places.logs, tokens, selection.scene_filter.log_names), store)
    identity = identity_of(NAVHARD, {"pictures": places.sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, entries_of(groups, reader))
    return summary, write_navhard(store, groups, reader, identity)


def write_navhard(store: Store, groups: Sequence[SceneGroup], reader: GroupReader, identity: RunIdentity) -> str:
    """benchmark.json of the groups all of whose frames are samples; a line that says what is in it."""
    made = {
        (row["clip_id"], row["expert"], row["candidate_index"])
        for row in store.samples.read(["clip_id", "expert", "candidate_index"]).to_pylist()
    }
    scenes = set(SceneFiles(store.location.child("scenes")).clip_ids())
    clips: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    for group in groups:
        named = {"clip_id": group.clip_id, "dataset": NAVHARD, "log_id": reader.log_id(group), "start_ms": 0}
        wanted = {(e.clip_id, e.expert, e.candidate_index) for e in entries_of([group], reader)}
        if wanted <= made and group.clip_id in scenes:
            tokens = {"tokens": [group.now, group.before], "follow_up_tokens": [list(pair) for pair in group.pairs]}
            clips.append({**named, "follow_ups": list(range(len(group.pairs))), **tokens})
        else:
            left_out.append({**named, "why": "failed", "follow_ups": len(group.pairs)})
    document = {
        "format": FORMAT,
        "settings_hash": identity.settings_hash,
        "settings": dict(identity.settings),
        "stage_versions": dict(identity.stage_versions),
        "vocabulary_digest": identity.vocabulary_digest,
        "rounds": 1,
        "min_follow_ups": 1,
        "pair_interval_s": FRAME_MS / 1000,
        "clips": clips,
        "left_out": left_out,
    }
    store.location.write(BENCHMARK_FILE, (json.dumps(document, indent=1) + "\n").encode())
    pairs = sum(len(clip["follow_ups"]) for clip in clips)
    return f"benchmark {store.location.uri}: {len(clips)} groups, {pairs} pairs of follow-ups; left out {len(left_out)}"


# navtest, of one stage: the frames of a list of tokens, each a clip of its own.
#
# Which frames count is the public loader's choice (navsim/common/dataloader.py:24-73 at autonomousvision/navsim @
# 0a380a9). Two plans are compared (extended comfort) where the token before in the log is at most 0.55 s earlier
# (`infer_start_adjacent_mapping`, navsim/planning/script/run_pdm_score_one_stage.py), so a clip names that one's
# clip.

NAVTEST = "navtest"
MOST_APART_US = 550_000  # between two frames whose plans are compared


@dataclass(frozen=True)
class LoneToken:
    """One frame of the benchmark."""

    token: str
    log: Path
    timestamp_us: int
    start_ms: int
    before: str | None = None  # the token up to 0.55 s earlier, if that is one of the benchmark's

    @property
    def clip_id(self) -> str:
        return clip_of(self.token)


def clip_of(token: str) -> str:
    """The id of a token's clip."""
    return sha256("\x1f".join((NAVTEST, token)).encode()).hexdigest()[:16]


def lone_tokens(selection: Selection, logs: Path, cache_dir: Path) -> tuple[list[LoneToken], list[str]]:
    """The frames that the selection's scene filter chooses, log by log in time, and its tokens that are no frame here.

    A log that is named and not here is left out with its tokens. Raises BadClip for a log that is broken, and
    ValueError where nothing is chosen.
    """
    chosen = selection.scene_filter
    wanted = None if chosen.tokens is None else frozenset(chosen.tokens)
    found: list[LoneToken] = []
    for name, path in log_files(logs).items():
        if chosen.log_names is not None and name not in chosen.log_names:
            continue
        table = table_at(path, cache_dir)
        starts = table.start_ms
        for at in wanted_windows(table, Choice(1, 0, 0.0, chosen), wanted):
            found.append(LoneToken(str(table.tokens[at]), path, int(table.timestamps_us[at]), int(starts[at])))
    found = found[: chosen.max_scenes]
    if not found:
        raise ValueError(f"logs={logs}: none of the frames that {selection.name} names is in the logs here")
    for i, (last, now) in enumerate(pairwise(found), start=1):
        if now.log == last.log and 0 < now.timestamp_us - last.timestamp_us <= MOST_APART_US:
            found[i] = replace(now, before=last.token)
    return found, sorted((wanted or frozenset()) - {one.token for one in found})


@dataclass
class LoneReader:
    """Reads the frames, one log open at a time."""

    maps: Path
    sensors: Path | None
    store: Store
    _log: LogFrames | None = field(default=None)

    def row(self, one: LoneToken) -> dict[str, object]:
        """The columns of one frame. Its scene is written beside. Raises BadClip."""
        if self._log is None or self._log.file != str(one.log):
            self._log = read_frames(one.log)
        digest = sha256(one.token.encode()).hexdigest()
        origin = Origin(str(one.log), one.clip_id, NAVTEST, self._log.name, "test", LICENCE, digest, None)
        scene, columns = logged_frame(self._log, one.token, self.maps, self.sensors, origin)
        SceneFiles(self.store.location.child("scenes")).store(OneStageClip(scene.clip))
        return columns

    def entries(self, tokens: Sequence[LoneToken]) -> list[Entry]:
        """All of them."""
        return [
            Entry(one.clip_id, NAVTEST, one.log.stem, HUMAN, 0, NO_CANDIDATE, partial(self.row, one)) for one in tokens
        ]


def import_navtest(
    store: Store, selection: Selection, logs: Path, sensors: Path | None, maps: Path
) -> tuple[RunSummary, str]:
    """Every frame of a selection into a store, and its benchmark; how that ended, and a line about it.

    sensors: None for frames without pictures. Raises ValueError and BadClip where nothing can begin, and what
    `import_rows` raises.
    """
    tokens, absent = lone_tokens(selection, logs, user_cache() / "navsim")
    identity = identity_of(NAVTEST, {"pictures": sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, LoneReader(maps, sensors, store).entries(tokens))
    return summary, write_navtest(store, tokens, absent, identity)


def write_navtest(store: Store, tokens: Sequence[LoneToken], absent: Sequence[str], identity: RunIdentity) -> str:
    """benchmark.json of the frames that are samples; a line that says what is in it."""
    made = set(store.samples.read(["clip_id"]).column("clip_id").to_pylist())
    made &= set(SceneFiles(store.location.child("scenes")).clip_ids())
    clips: list[dict[str, object]] = []
    left_out: list[dict[str, object]] = [{"token": token, "why": "absent_token"} for token in absent]
    for one in tokens:
        named = {"clip_id": one.clip_id, "dataset": NAVTEST, "log_id": one.log.stem, "start_ms": one.start_ms}
        before = None if one.before is None else clip_of(one.before)
        if one.clip_id in made:
            compared = before if before in made else None
            clips.append({**named, "follow_ups": [], "tokens": [one.token], "before": compared})
        else:
            left_out.append({**named, "why": "failed", "token": one.token})
    document = {
        "format": FORMAT,
        "stages": 1,
        "settings_hash": identity.settings_hash,
        "settings": dict(identity.settings),
        "stage_versions": dict(identity.stage_versions),
        "vocabulary_digest": identity.vocabulary_digest,
        "clips": clips,
        "left_out": left_out,
    }
    store.location.write(BENCHMARK_FILE, (json.dumps(document, indent=1) + "\n").encode())
    return f"benchmark {store.location.uri}: {len(clips)} frames; left out {len(left_out)}"
