"""NAVSIM's two-stage benchmark as a benchmark of ours: samples to plan from, and scenes to drive in.

A group of the split's `reactive_all_mapping` is a clip: its stage-one frames are the log's at T and 0.5 s before, its
pairs of synthetic scenes the follow-ups, numbered as they stand there. Nobody drove from a synthetic scene, so the
label of its sample is PDM-Closed's drive, which no score is made of.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from factory.datasets.navsim.filters import Selection
from factory.datasets.navsim.import_table import Entry, identity_of, import_rows
from factory.datasets.navsim.log import LogFrames, read_frames
from factory.datasets.navsim.road import road_around
from factory.datasets.navsim.scenes import (
    HISTORY_FRAMES,
    SCENE_FRAMES,
    Origin,
    label_columns_of,
    logged_label,
    pictures,
    scene_of,
    world_columns,
)
from factory.datasets.navsim.synthetic import SyntheticScene, read_scene_pickle
from factory.datasets.navsim.tracks import ego_states
from factory.files import matching
from factory.graph.execute import RunSummary
from factory.readers.apart import Apart
from factory.readers.base import BadClip, failing_as
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.stages.imaging import NO_IMAGES
from factory.store.location import SceneFiles
from factory.store.samples import Store
from factory.store.schema import RunIdentity
from tasks.experts.pdm_closed import PdmSettings, plan_for
from tasks.hard_scenes import GivenScenes
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


DATASET, LICENCE = "navhard", "CC BY-NC-SA 4.0 (NAVSIM, of nuPlan)"
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
        return sha256("\x1f".join((DATASET, self.now, self.before)).encode()).hexdigest()[:16]


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
        return Origin(file, group.clip_id, DATASET, log, "test", LICENCE, digest, None)


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
        Entry(group.clip_id, DATASET, reader.log_id(group), kind, 0, number, partial(reader.row, group, kind, number))
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
    identity = identity_of(DATASET, {"pictures": places.sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, entries_of(groups, reader))
    return summary, write_benchmark(store, groups, reader, identity)


def write_benchmark(store: Store, groups: Sequence[SceneGroup], reader: GroupReader, identity: RunIdentity) -> str:
    """benchmark.json of the groups all of whose frames are samples; a line that says what is in it."""
    made = {
        (row["clip_id"], row["expert"], row["candidate_index"])
        for row in store.samples.read(["clip_id", "expert", "candidate_index"]).to_pylist()
    }
    scenes = set(SceneFiles(store.location.child("scenes")).clip_ids())
    clips: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    for group in groups:
        named = {"clip_id": group.clip_id, "dataset": DATASET, "log_id": reader.log_id(group), "start_ms": 0}
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
