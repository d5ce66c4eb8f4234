"""Others' samples into a store: NAVSIM's frames as a scene and as columns, and the rows that are written of them.

A drive that others made is looked at as a log of its own.
The fourth frame is T, and now. What lies beyond the last frame is unknown: the ego's states are NaN there, and nobody
else is there. Between two frames everything is as `factory.datasets.navsim.window` says, what the public code makes of
it.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from factory.datasets.navsim.log import Frame
from factory.datasets.navsim.settings import FRAME_STEPS
from factory.datasets.navsim.window import (
    FRAMES_BEFORE,
    WINDOW_FRAMES,
    RoadAhead,
    cameras_with_pictures,
    ego_states,
    n_steps,
    read_jpeg,
    sensor_files,
    traffic_lights,
    window_agents,
    world_from_ego,
)
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED, calling_on_stop_signal
from factory.files import DiskFull
from factory.graph.driver import SHARD_BYTES
from factory.graph.execute import RunSummary, write_last_run
from factory.graph.progress import RateBar, RunTotals
from factory.graph.steps import Spent
from factory.readers.base import BadClip, failures_as_bad_clip
from factory.readers.pictures import BadPicture, check_size, without_exif
from factory.stages.rows import scene_columns
from factory.store.location import Shard, write_shard
from factory.store.samples import IMPORTED, ChangedRun, ErrorKind, Kind, Outcome, Store
from factory.store.schema import SAMPLES, UNLISTED, BadRow, RunIdentity, Stamp, attempt_id, sample_rows_to_table
from tasks.render.settings import ImageSource
from tasks.world.arrays import Array
from tasks.world.clip import (
    CLIP_STEPS,
    HORIZON_STEPS,
    NOW,
    PER_STEP,
    STEP_S,
    AgentTracks,
    Camera,
    Clip,
    Scene,
    scene_of_clip,
)
from tasks.world.frames import EGO_STATE_SIZE, HEADING, to_local
from tasks.world.road_map import LightState, TrafficLights

HISTORY_FRAMES = FRAMES_BEFORE + 1  # now among them
SCENE_FRAMES = HISTORY_FRAMES + 8  # with the 4 s that are driven


NO_PICTURES = "none of its pictures is in"


@dataclass(frozen=True)
class SceneOrigin:
    """What a scene is called, and what it was read from."""

    file: str  # named in errors
    clip_id: str
    dataset: str
    log_id: str
    split: str
    licence: str
    content_digest: str
    frame_tokens: tuple[str, str] | None


def scene_of_frames(frames: Sequence[Frame], road: RoadAhead, origin: SceneOrigin, driven: int | None = None) -> Scene:
    """The scene at T of 4 to 12 frames that are 0.5 s apart; the ego is known in the first `driven`, None: in all."""
    assert HISTORY_FRAMES <= len(frames) <= SCENE_FRAMES
    states, space = ego_states(frames[:driven]), world_from_ego(frames[:driven])
    known = len(states)
    after = ((0, CLIP_STEPS - known), (0, 0))
    clip = Clip(
        clip_id=origin.clip_id,
        dataset=origin.dataset,
        log_id=origin.log_id,
        split=origin.split,
        start_s=0.0,
        ego_states=np.pad(states, after, constant_values=np.nan).reshape(CLIP_STEPS, EGO_STATE_SIZE),
        world_from_ego=np.concatenate([space, np.repeat(space[-1:], CLIP_STEPS - known, axis=0)]),
        agents=_agents(frames),
        road_map=road.road_map,
        route=road.route,
        centerline=road.centerline,
        lights=_lights(frames, tuple(road.road_map.lanes)),
        licence=origin.licence,
        frame_tokens=origin.frame_tokens,
        content_digest=origin.content_digest,
    )
    return scene_of_clip(clip)


def _agents(frames: Sequence[Frame]) -> AgentTracks:
    """96 steps; those after the last frame are of a window that nobody annotated, and nobody is there."""
    unseen = replace(frames[-1], boxes=None)
    agents = window_agents([*frames, *[unseen] * (WINDOW_FRAMES - len(frames))])
    parts = {name: getattr(agents, name).copy() for name in PER_STEP}
    for name, part in parts.items():
        part[n_steps(len(frames)) :] = False if name == "valid" else np.nan
    return replace(agents, **parts)


def _lights(frames: Sequence[Frame], lane_ids: Sequence[str]) -> TrafficLights:
    """96 steps, unknown after the last frame."""
    found = traffic_lights(frames, lane_ids)
    after = ((0, CLIP_STEPS - len(found.states)), (0, 0))
    return replace(found, states=np.pad(found.states, after, constant_values=LightState.UNKNOWN))


def world_columns(scene: Scene, command: str) -> dict[str, object]:
    """A row's columns but label, scores, pictures, vocabulary labels and bookkeeping; command: as the log says it."""
    return scene_columns(scene, scene.agents, scene.clip.world_from_ego[NOW], command)


def logged_label_columns(scene: Scene) -> dict[str, object]:
    """The columns that hold the drive from T on, of a scene whose 12 frames hold it."""
    states = scene.clip.ego_states[NOW : NOW + HORIZON_STEPS + 1]
    return {**label_columns_of(scene, states[1:, : HEADING + 1]), "parent_states": states[[0, HORIZON_STEPS]]}


def label_columns_of(scene: Scene, poses: Array) -> dict[str, object]:
    """The columns of a drive (40, 3) from T on, world frame."""
    label = to_local(scene.ego_state[: HEADING + 1], poses)
    return {"label_10hz": label, "label_2hz": label[FRAME_STEPS - 1 :: FRAME_STEPS]}


def picture_columns(frames: Sequence[Frame], folder: Path, source: ImageSource, file: str) -> dict[str, object]:
    """The columns of the pictures of frames that end now: the files' own bytes but for Exif, with the rig of now.

    Raises BadClip. file: whose frames they are, named where they have none.
    """
    images, _ = sensor_files(frames, folder)
    if not images:
        raise BadClip(file, "cams", f"{NO_PICTURES} {folder}; pictures=false imports it without")
    now_s = (len(frames) - 1) * FRAME_STEPS * STEP_S
    rig = {camera.name: camera for camera in cameras_with_pictures(frames[-1], images, file)}
    return {
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": camera.intrinsics.ravel(),
                "distortion": camera.distortion,
                "ego_from_camera": camera.ego_from_camera.ravel(),
            }
            for camera in rig.values()
        ],
        "images": [
            {
                "camera": image.sensor,
                "time_s": image.time_s - now_s,
                "ego_pose": image.world_from_ego.ravel(),
                "jpeg": _jpeg(Path(image.uri), rig[image.sensor]),
            }
            for image in images
        ],
        "image_source": str(source),
    }


def _jpeg(path: Path, camera: Camera) -> bytes:
    """A whole file, without Exif. Raises BadClip where it is no JPEG of the camera's size or is cut off."""
    data, size = read_jpeg(path)
    try:
        check_size(size, (camera.width, camera.height), camera.name)
    except BadPicture as error:
        raise BadClip(str(path), error.field, str(error)) from error
    if b"\xff\xd9" not in data[-64:]:
        raise BadClip(str(path), "image", f"{len(data)} bytes that are no whole JPEG")
    return without_exif(data)


# Rows of others' samples into a store: each once, those that are there already skipped, bad ones counted as failed.

VERSION = 1  # of what an import makes of a file; stands in stage_versions
NO_VOCABULARY = ""  # in vocabulary_digest: what perturbed the ego is not known
Make = Callable[[], Mapping[str, object]]


@dataclass(frozen=True)
class ImportEntry:
    """One row to be, named before its file is opened."""

    clip_id: str
    dataset: str
    log_id: str
    expert: str
    round: int
    candidate_index: int
    make: Make  # everything but the Stamp's columns; whatever it raises fails the row

    def stamp(self, identity: RunIdentity) -> Stamp:
        """The bookkeeping of the row."""
        source = str(identity.settings[IMPORTED])
        key = attempt_id(self.clip_id, self.candidate_index, NO_VOCABULARY, self.expert, source)
        return Stamp(
            attempt_id=key,
            expert=self.expert,
            expert_digest=source,
            round=self.round,
            candidate_index=self.candidate_index,
            vocabulary_digest=NO_VOCABULARY,
            settings_hash=identity.settings_hash,
            stage_versions=identity.versions_json,
        )


def import_identity(source: str, settings: Mapping[str, object]) -> RunIdentity:
    """What imported rows are made under: where from, and what was asked for."""
    said = {IMPORTED: source} | {f"import.{name}": value for name, value in settings.items()}
    return RunIdentity(said, {"import": VERSION}, NO_VOCABULARY, UNLISTED)


def import_rows(store: Store, identity: RunIdentity, entries: Sequence[ImportEntry]) -> RunSummary:
    """Write the rows that the store has not, in files of up to 128 MB, each committed with the failures before it.

    Raises ChangedRun where the store holds rows of anything else.
    """
    began_ms = int(time.time() * 1000)
    stamps = [entry.stamp(identity) for entry in entries]
    if (known := store.runs()) and known[-1]["settings_hash"] != identity.settings_hash and len(store.samples):
        raise ChangedRun(f"{store.location.uri} holds rows of another run or import: choose another out")
    records = store.checked_records(identity, {stamp.expert: stamp.expert_digest for stamp in stamps}, "stop")
    waiting = [pair for pair in zip(entries, stamps) if pair[1].attempt_id not in store.samples]
    summary = RunSummary(COMPLETE, executed=RunTotals(found_done=len(entries) - len(waiting)), began_ms=began_ms)
    counts = dict.fromkeys((kind.value for kind in Kind), 0)
    stopped: list[bool] = []
    began = Spent.now()
    try:
        store.begin_run(records)
        batch = _Batch(store)
        with calling_on_stop_signal(lambda: stopped.append(True)), RateBar("imported", len(waiting)) as progress:
            for done, (entry, stamp) in enumerate(waiting, start=1):
                failed = _import_fails(batch, entry, stamp)
                counts[Kind.FAILED if failed else Kind.ACCEPTED] += 1
                progress.show(done, f"{counts[Kind.FAILED]} failed")
                summary.executed.attempts += 1
                if stopped:
                    break
            batch.commit()
        if stopped:
            summary.exit_code, summary.message = INTERRUPTED, "interrupted; run the same command again to go on"
        elif counts[Kind.FAILED]:
            summary.exit_code = COMPLETE_WITH_FAILURES
    except DiskFull as error:
        summary.exit_code, summary.message = INTERRUPTED, f"{error}; free disk space and run the same command again"
    summary.counts = counts
    summary.seconds = {"import": (summary.executed.attempts, Spent.now() - began)}
    write_last_run(store, summary)
    return summary


class _Batch:
    """What the next commit holds."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._rows: dict[tuple[int, str], list[pa.Table]] = defaultdict(list)
        self._bytes: dict[tuple[int, str], int] = defaultdict(int)  # of them; Arrow counts anew whenever it is asked
        self._failed: list[Outcome] = []
        self._licences: set[str] = set()

    def add(self, rows: pa.Table, partition: tuple[int, str], licence: str) -> None:
        """Commits where the partition is large enough for a file."""
        self._rows[partition].append(rows)
        self._bytes[partition] += rows.nbytes
        self._licences.add(licence)
        if self._bytes[partition] >= SHARD_BYTES:
            self.commit()

    def fail(self, outcome: Outcome) -> None:
        self._failed.append(outcome)

    def commit(self) -> None:
        """Everything gathered. Raises DiskFull and the store's errors."""
        shards: list[Shard] = [
            write_shard(self._store.samples.location, SAMPLES, pa.concat_tables(rows).combine_chunks())
            for _, rows in sorted(self._rows.items())
        ]
        self._store.commit([], shards, self._failed, licences=self._licences)
        self._rows.clear()
        self._bytes.clear()
        self._failed, self._licences = [], set()


def _import_fails(batch: _Batch, entry: ImportEntry, stamp: Stamp) -> bool:
    """Whether it failed, as an outcome of its own."""
    try:
        with failures_as_bad_clip(f"log {entry.log_id}"):
            row = entry.make()
        batch.add(sample_rows_to_table([{**row, **asdict(stamp)}]), (entry.round, entry.expert), str(row["licence"]))
        return False
    except (BadClip, BadRow) as error:
        batch.fail(
            Outcome(
                attempt_id=stamp.attempt_id,
                clip_id=entry.clip_id,
                dataset=entry.dataset,
                log_id=entry.log_id,
                expert=entry.expert,
                expert_digest=stamp.expert_digest,
                candidate_index=entry.candidate_index,
                kind=Kind.FAILED,
                settings_hash=stamp.settings_hash,
                stage_versions=stamp.stage_versions,
                error_kind=ErrorKind.INPUT,
                error=str(error),
            )
        )
        return True
