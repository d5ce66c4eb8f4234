"""One item of a command's work: all drives of a clip that see the same, made where the clip's world is at hand."""

import hashlib
import json
import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any

import pyarrow as pa

from factory.readers.base import BadClip, ClipReader, ClipRef, painter_of, read_clip
from factory.store.location import Location, write_shard
from factory.store.schema import TableSpec, canonical_json, schema_of
from factory.store.table import KeyedTable
from planners.drive.alpasim_score import AlpasimColumns, failure_reason, logged_rollout, score_drive
from planners.drive.cameras import DriveCameras, NoCameras, PaintedCameras, RenderedCameras, open_rendered_cameras
from planners.drive.contract import (
    WIRE,
    Ask,
    DriverSession,
    Peer,
    ask_over_the_wire,
    peer_in_process,
    planner_over_the_wire,
    version_of,
)
from planners.drive.films import Rig, write_film
from planners.drive.loop import DRIVE_VERSION, ClosedLoopDrive, drive
from planners.drive.renderer import ServedCameras, cached_renderer
from planners.drive.settings import DriveSettings, Pictures
from planners.drive.starts import LOGGED, DriveStart, extend_clip, logged_start, perturbed_starts
from planners.evaluation.planner_names import EvaluatedPlanner, find_planner
from tasks.perturb import Perturbation, perturb
from tasks.rollout.simulate import traffic_record
from tasks.stages import stage_versions
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, random_stream
from tasks.world.vocabulary import Vocabulary

# The table `drives` under `out`: one row a drive, committed as they end, so that no drive is made twice.

COMMIT_EVERY_S = 10.0  # a killed command drives as much again


@dataclass(frozen=True)
class DriveKey:
    """What a drive is: the same key, the same drive."""

    clip_id: str
    content_digest: str  # of the log, "" where its reader does not say
    start: int  # number of the clip's perturbed start; -1: from the log at T
    planner_digest: str
    pictures: str  # truth, engine, renderer, none
    settings: str  # all that it depends on beside, canonical JSON

    @property
    def drive_id(self) -> str:
        """16 hex digits."""
        return hashlib.sha256(canonical_json(asdict(self)).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class DriveRow(AlpasimColumns):
    """One drive in the table."""

    drive_id: str
    clip_id: str
    dataset: str
    log_id: str
    content_digest: str
    licence: str
    start: int  # number of the clip's perturbed start; -1: from the log at T
    candidate_index: int  # that led there; -1: from the log at T
    start_step: int  # of the clip, 0.1 s
    planner: str
    planner_digest: str
    pictures: str
    psnr_db: float  # of the scene's held-out photos; NaN: no scene, or none was held out
    duration_s: float  # shorter than the recording where the planner had no plan any more
    failure_reason: str  # the column that makes the score 0, "": none
    film: str  # file under `out`, "": none
    settings: str
    ego_states: tuple[tuple[float, ...], ...]  # (S + 1, 11) at 10 Hz, world
    plans: tuple[tuple[float, ...], ...]  # (P, 120) x, y, heading at 0.1 .. 4.0 s of the plans at 2 Hz, world


SCHEMA = schema_of(DriveRow)
DRIVES = TableSpec("drives", SCHEMA, "drive_id")
FACTS = [field.name for field in fields(DriveRow) if field.name not in ("ego_states", "plans")]


def open_drives(out: Location) -> KeyedTable:
    """The table, which need not be there yet."""
    return KeyedTable(out.child("drives"), DRIVES)


def write_rows(table: KeyedTable, rows: Sequence[DriveRow]) -> None:
    """One commit. Raises DuplicateKey, and AnotherWriter where a later command has taken the table over."""
    spec = table.spec
    columns = [pa.array([getattr(row, field.name) for row in rows], field.type) for field in spec.schema]
    table.commit([write_shard(table.location, spec, pa.Table.from_arrays(columns, schema=spec.schema))])


class RowCommitter:
    """Gathers rows and writes them, a commit each time, every COMMIT_EVERY_S and when it is closed."""

    def __init__(self, table: KeyedTable) -> None:
        self._table, self._rows, self._last = table, list[DriveRow](), time.monotonic()

    def add(self, rows: Iterable[DriveRow]) -> None:
        """Rows to be committed."""
        self._rows += rows
        if time.monotonic() - self._last > COMMIT_EVERY_S:
            self.close()

    def close(self) -> None:
        """Commit what is gathered."""
        if self._rows:
            write_rows(self._table, self._rows)
        self._rows, self._last = [], time.monotonic()


@dataclass(frozen=True)
class DrivingPlanner:
    """Someone who drives, as workers are told of them."""

    label: str
    spec: str
    digest: str


@dataclass(frozen=True)
class DriveItem:
    """Drives of one clip."""

    ref: ClipRef
    pictures: Pictures
    keys: tuple[tuple[DrivingPlanner, DriveKey], ...]  # not driven yet

    def missing(self, done: Collection[str]) -> tuple[tuple[DrivingPlanner, DriveKey], ...]:
        """The drives whose ids are not among those that are done, each once: two trainings may be the same planner."""
        first = {key.drive_id: (who, key) for who, key in reversed(self.keys) if key.drive_id not in done}
        return tuple(reversed(first.values()))

    def __str__(self) -> str:
        return f"clip {self.ref.clip_id} of {self.ref.log_id}, pictures={self.pictures}"


@dataclass(frozen=True)
class FailedDrive:
    """A drive that could not be made: tried again by the same command."""

    clip_id: str
    why: str
    planner: str | None = None  # None: nobody could drive there

    def __str__(self) -> str:
        return self.why if self.planner is None else f"{self.planner}: {self.why}"


@dataclass(frozen=True)
class DriveWork:
    """What makes drives of items; picklable."""

    reader: ClipReader
    vocabulary: Vocabulary
    settings: DriveSettings
    out: Location

    def key_of(self, ref: ClipRef, start: int, who: DrivingPlanner, pictures: Pictures) -> DriveKey:
        """Of one drive, without opening the clip."""
        digest = getattr(self.reader, "digest", None)
        content = "" if digest is None else str(digest(ref))
        told = canonical_json(self._depends_on(start, who, pictures))
        return DriveKey(ref.clip_id, content, start, who.digest, pictures, told)

    def _depends_on(self, start: int, who: DrivingPlanner, pictures: Pictures) -> Mapping[str, Any]:
        s = self.settings
        found: dict[str, Any] = {
            "drive": DRIVE_VERSION,
            "stages": stage_versions(),
            "loop": {"seconds": s.seconds, "controller": s.controller},
            "traffic": traffic_record(s.traffic),
        }
        if start != LOGGED:
            found |= {"seed": s.seed, "vocabulary": self.vocabulary.digest, "perturb": asdict(s.perturb)}
        if pictures != "none":
            found["render"] = asdict(s.render)
        if pictures == "renderer":
            found["renderer"] = version_of(self._renderer)[1]
        return found

    def __call__(self, item: DriveItem) -> list[DriveRow | FailedDrive]:
        """Drive all of it. What is wrong with a clip, its pictures or a planner's answer is told of each drive."""
        try:
            return list(self._driven(item))
        except (BadClip, ValueError) as error:
            return [FailedDrive(item.ref.clip_id, str(error))]

    def _driven(self, item: DriveItem) -> Iterator[DriveRow | FailedDrive]:
        clip = self._clip(item)
        starts = self._starts(clip, {key.start for _, key in item.keys})
        cameras = self._cameras(clip, item.pictures)
        for who, key in item.keys:
            if key.start not in starts:
                continue  # the clip has fewer
            try:
                with DriverSession(self._peer(who), starts[key.start].scene, cameras.rig) as driver:
                    made = drive(starts[key.start], driver, self.settings.rules, cameras)
                if not made.n_steps:
                    raise ValueError("the driver ended the session before it had driven")
                row = self._row(who, key, made, cameras)
            except ValueError as error:
                yield FailedDrive(clip.clip_id, str(error), who.label)
            else:
                yield row

    def _clip(self, item: DriveItem) -> Clip:
        last = NOW + HORIZON_STEPS if any(key.start != LOGGED for _, key in item.keys) else NOW
        clip, n_steps = read_clip(self.reader, item.ref), self.settings.rules.clip_steps(last)
        painter = painter_of(self.reader)
        return extend_clip(clip, n_steps, None if painter is None else painter.lights(clip, n_steps))

    def _starts(self, clip: Clip, wanted: set[int]) -> dict[int, DriveStart]:
        found = [logged_start(clip)] if LOGGED in wanted else []
        at_most = max(wanted) + 1
        if at_most > 0:
            rng = random_stream(self.settings.seed, clip.clip_id, "perturb")
            s = self.settings
            listed = perturb(clip, self.vocabulary, s.perturb, s.traffic, rng)
            found += perturbed_starts(clip, listed, at_most, s.traffic) if isinstance(listed, Perturbation) else []
        return {start.number: start for start in found}

    def _cameras(self, clip: Clip, pictures: Pictures) -> DriveCameras:
        """Of all drives of a clip. Raises BadClip where the engine has no scene of it."""
        if pictures == "engine":
            from factory.setup.settings import cache_folder

            cache_dir = self.settings.cache or cache_folder(self.out.uri)
            return open_rendered_cameras(clip, self.settings.render, cache_dir)
        if pictures == "renderer":
            return ServedCameras(clip, self.settings.render, self._renderer)
        if pictures == "truth":
            painter = painter_of(self.reader)
            assert painter is not None, "pictures=truth goes with a reader that has a painter"
            return PaintedCameras(clip, self.settings.render, painter)
        return NoCameras()

    @property
    def _renderer(self) -> Ask:
        s = self.settings
        assert s.renderer is not None, "settings without it are refused"
        return cached_renderer(s.renderer, s.render.backend)

    def _peer(self, who: DrivingPlanner) -> Peer:
        s = self.settings
        return cached_peer(who, canonical_json(s.settings), s.device)

    def _film(
        self, who: DrivingPlanner, key: DriveKey, made: ClosedLoopDrive, columns: AlpasimColumns, rig: Rig
    ) -> str:
        """One drive in so many has one, chosen by its id."""
        one_in = self.settings.one_film_in
        if one_in == 0 or int(key.drive_id, 16) % one_in:
            return ""
        start = "log" if key.start == LOGGED else f"start {key.start}"
        return write_film(self.out, key.drive_id, made, columns, rig, f"{who.label}, {key.pictures}, {start}")

    def _row(self, who: DrivingPlanner, key: DriveKey, made: ClosedLoopDrive, cameras: DriveCameras) -> DriveRow:
        clip, columns = made.start.scene.clip, score_drive(logged_rollout(made, self.settings.seconds))
        return DriveRow(
            **vars(columns),
            drive_id=key.drive_id,
            clip_id=clip.clip_id,
            dataset=clip.dataset,
            log_id=clip.log_id,
            content_digest=key.content_digest,
            licence=clip.licence,
            start=key.start,
            candidate_index=made.start.candidate_index,
            start_step=made.start.scene.step,
            planner=who.label,
            planner_digest=who.digest,
            pictures=key.pictures,
            psnr_db=cameras.asset.psnr_db if isinstance(cameras, RenderedCameras) else math.nan,
            duration_s=made.n_steps * STEP_S,
            failure_reason=failure_reason(vars(columns)) or "",
            film=self._film(who, key, made, columns, cameras.rig),
            settings=key.settings,
            ego_states=tuple(map(tuple, made.ego_states.tolist())),
            plans=tuple(map(tuple, made.plans.reshape(len(made.plans), -1).tolist())),
        )


@lru_cache(maxsize=8)
def cached_peer(who: DrivingPlanner, changed: str, device: str) -> Peer:
    """A worker's own, read once. Raises ValueError where it is another than was named when the command began."""
    if not who.spec.startswith(WIRE):
        settings = json.loads(changed)
        return peer_in_process(_same(find_planner(who.spec, who.label, settings), who), settings, device)
    address = who.spec.removeprefix(WIRE)
    _same(planner_over_the_wire(address), who)
    return Peer(ask_over_the_wire(address), needs_pictures=True)


def _same(one: EvaluatedPlanner, who: DrivingPlanner) -> EvaluatedPlanner:
    if one.digest != who.digest:
        raise ValueError(f"{who.spec} has changed since the command began: run it again when its training is through")
    return one
