"""Vocabularies and recovery tables out of a data set's own TRAIN logs, and their files.

Both artefacts carry a digest of their trajectories. They are made from ALL train clips of the root, whatever part of
them a run later reads, so that a run's `limit` never changes what the experts know.
"""

import hashlib
import json
import os
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factory.files import atomic_file
from factory.readers.base import BadClip, ClipReader, read_clip
from factory.wording import one_line
from tasks.caches import append_checksum
from tasks.experts.recovery import RecoveryTable
from tasks.world.arrays import Array
from tasks.world.clip import CLIP_STEPS, HORIZON_STEPS, STEP_S
from tasks.world.vocabulary import (
    Vocabulary,
    checked_trajectories,
    cluster,
    human_windows,
    refuse_other_meaning,
    trajectories_digest,
)

STEP_MS = round(STEP_S * 1000)
TABLE_KEYS = ("trajectories", "digest")
START_COLUMNS = ("clip_id", "trajectory")
MOST_EXPANDED = 16  # of an archive that is packed


@dataclass(frozen=True)
class TrainWindows:
    """What human drivers of the train logs did."""

    trajectories: Array  # (W, 40, 3) ego frame of each window's start, 0.1 .. 4.0 s
    logs: tuple[str, ...]  # train logs read, sorted
    clips_of_split: dict[str, int]  # clips read, by split
    broken: dict[str, str]  # clip id or log -> why it could not be read
    takes_split: bool = False  # whether clips.split= can say that they are train logs


def train_windows(reader: ClipReader, every_s: float = 0.5) -> TrainWindows:
    """Every 4 s window of the reader's train clips, each instant of a log once however many clips share it.

    Raises ValueError where `every_s` is no multiple of 0.1 s, or the root holds no data.
    """
    every_ms = round(every_s * 1000)
    if every_ms < STEP_MS or every_ms % STEP_MS:
        raise ValueError(f"every_s = {every_s} is no multiple of {STEP_S} s")
    index = reader.index()
    broken = {ref.log_id: reason for ref, reason in index.broken.items()}
    windows: list[Array] = []
    taken: set[tuple[str, int]] = set()
    splits: Counter[str] = Counter()
    logs: set[str] = set()
    for ref in index.refs:
        try:
            clip = read_clip(reader, ref)
        except BadClip as error:
            broken[ref.clip_id] = str(error)
            continue
        splits[clip.split] += 1
        if clip.split != "train":
            continue
        logs.add(ref.log_id)
        starts = [
            step
            for step in range(CLIP_STEPS - HORIZON_STEPS)
            if (ref.start_ms + step * STEP_MS) % every_ms == 0
            and (ref.log_id, ref.start_ms + step * STEP_MS) not in taken
        ]
        taken |= {(ref.log_id, ref.start_ms + step * STEP_MS) for step in starts}
        windows.append(human_windows(clip.ego_states, np.array(starts, dtype=np.intp)))
    trajectories = np.concatenate(windows) if windows else np.zeros((0, HORIZON_STEPS, 3))
    return TrainWindows(trajectories, tuple(sorted(logs)), dict(splits), broken, hasattr(reader, "split"))


def build_vocabulary(windows: TrainWindows, k: int, seed: int) -> Vocabulary:
    """k human trajectories that stand for all train windows. Raises ValueError where there are too few."""
    if len(windows.trajectories) == 0:
        raise ValueError(_no_train_log(windows))
    return Vocabulary(cluster(windows.trajectories, k, seed), source="train windows")


def build_recovery_table(windows: Sequence[TrainWindows], vocabularies: Sequence[Vocabulary]) -> RecoveryTable:
    """All train windows, then all trajectories of the vocabularies. Raises ValueError where there is none at all."""
    parts = [part.trajectories for part in windows] + [vocabulary.trajectories for vocabulary in vocabularies]
    if not sum(map(len, parts)):
        reasons = "; ".join(map(_no_train_log, windows))
        raise ValueError(f"a recovery table needs train logs or a vocabulary file: {reasons or 'neither was given'}")
    return RecoveryTable(np.concatenate(parts))


def _no_train_log(windows: TrainWindows) -> str:
    found = ", ".join(f"{count} {split}" for split, count in sorted(windows.clips_of_split.items()))
    how = ": clips.split=train takes them as such" if windows.takes_split else ""
    unread = [f"{reason} ({len(windows.broken)} cannot be read)" for reason in windows.broken.values()][:1]
    return "; ".join([*unread, *([f"no train log, the clips are {found}{how}"] if found else [])]) or "no clip"


def load_vocabulary(path: str | Path, first: int | None = None) -> Vocabulary:
    """The vocabulary in a .npy file (K, 40, 3), or its first entries. Raises ValueError that names the file.

    What another meaning of the numbers gives away is refused too (`refuse_other_meaning`).
    """
    values = _load(path)
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{path}: expected one .npy array (K, {HORIZON_STEPS}, 3), found an archive of several")
    if first is not None and not 1 <= first <= len(values):
        raise ValueError(f"{path}: the first {first} of {len(values)} trajectories were asked for")
    vocabulary = Vocabulary(values, source=str(path))
    refuse_other_meaning(vocabulary.trajectories, vocabulary.source)  # of all: the first few may tell nothing
    return vocabulary if first is None else Vocabulary(vocabulary.trajectories[:first], source=str(path))


@dataclass(frozen=True)
class StartTrajectories:
    """Trajectories that lead single clips into states of somebody's choice, such as where a planner drove itself."""

    of_clip: Mapping[str, Array]  # clip_id -> (S, 40, 3) ego frame at T, 0.1 .. 4.0 s, in the order of the file
    digest: str  # 16 hex digits of all of it, whatever the order of the clips


def load_start_trajectories(path: str) -> StartTrajectories:
    """Those of a Parquet file: a row each, of clip_id and trajectory (40, 3). Raises ValueError that names the file."""
    where = f"perturb.starts={path}"
    try:
        file = pq.ParquetFile(path)
        if missing := [name for name in START_COLUMNS if name not in file.schema_arrow.names]:
            raise ValueError(f"no column {missing[0]}; it has {', '.join(file.schema_arrow.names)}")
        rows = file.read(columns=list(START_COLUMNS)).to_pydict()
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ValueError(f"{where}: {str(error).splitlines()[0]}") from error
    if not all(isinstance(clip_id, str) for clip_id in rows["clip_id"]):
        raise ValueError(f"{where}: clip_id must be text in every row")
    try:
        values = np.array(rows["trajectory"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: every trajectory must be {HORIZON_STEPS} times x, y, heading") from error
    trajectories, of_clip = checked_trajectories(values, where), dict[str, list[Array]]()
    refuse_other_meaning(trajectories, where, human=False)
    for clip_id, trajectory in zip(rows["clip_id"], trajectories, strict=True):
        of_clip.setdefault(clip_id, []).append(trajectory)
    found = {clip_id: np.array(of_clip[clip_id]) for clip_id in sorted(of_clip)}
    named = "\x1f".join(f"{clip_id} {trajectories_digest(starts)}" for clip_id, starts in found.items())
    return StartTrajectories(found, hashlib.sha256(named.encode()).hexdigest()[:16])


def load_recovery_table(path: str | Path) -> RecoveryTable:
    """The table in a .npz file. Raises ValueError that names the file, also where it does not match its digest."""
    archive = _load(path)
    if isinstance(archive, np.ndarray) or sorted(archive) != sorted(TABLE_KEYS):
        raise ValueError(f"{path}: expected a .npz archive of {' and '.join(TABLE_KEYS)}")
    table = RecoveryTable(checked_trajectories(archive["trajectories"], str(path)))
    if str(archive["digest"]) != table.digest:
        raise ValueError(
            f"{path}: digest says {archive['digest']}, the trajectories are {table.digest}: build it again"
        )
    return table


def _load(path: str | Path) -> np.ndarray | dict[str, np.ndarray]:
    try:
        _refuse_bombs(path)
        loaded = np.load(path, allow_pickle=False)
        return loaded if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    except OSError as error:
        raise ValueError(f"{path}: not readable as a numpy file: {error.strerror or error}") from error
    except Exception as error:  # numpy takes what it does not know for a pickle, zipfile and zlib have errors of theirs
        why = "it holds no plain numbers" if "pickled (object)" in str(error) else one_line(error)
        raise ValueError(f"{path}: not readable as a numpy file: {why}") from error


def _refuse_bombs(path: str | Path) -> None:
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            return
        with zipfile.ZipFile(file) as packed:
            if sum(member.file_size for member in packed.infolist()) > MOST_EXPANDED * (os.stat(path).st_size + 2**16):
                raise ValueError(f"its members are packed to less than 1/{MOST_EXPANDED} of their size")


def save_vocabulary(path: str | Path, vocabulary: Vocabulary, origin: dict[str, object]) -> None:
    """Writes the .npy, and a .json beside it with the digest, k and `origin`."""
    with atomic_file(Path(path), vocabulary.trajectories.nbytes) as draft, draft.open("wb") as file:
        np.save(file, vocabulary.trajectories, allow_pickle=False)
    _describe(Path(path), {"digest": vocabulary.digest, "k": len(vocabulary)} | origin)


def save_recovery_table(path: str | Path, table: RecoveryTable, origin: dict[str, object], key: str = "") -> None:
    """Writes the .npz, and a .json beside it with the digest, the number of trajectories and `origin`.

    key: that it is sealed with, of a file in a cache.
    """
    with atomic_file(Path(path), table.trajectories.nbytes) as draft:
        with draft.open("wb") as file:
            np.savez(file, allow_pickle=False, trajectories=table.trajectories, digest=np.array(table.digest))
        if key:
            append_checksum(draft, key)
    _describe(Path(path), {"digest": table.digest, "trajectories": len(table)} | origin)


def _describe(path: Path, content: dict[str, object]) -> None:
    text = json.dumps(content, indent=2, sort_keys=True) + "\n"
    with atomic_file(path.with_suffix(".json"), len(text)) as draft:
        draft.write_text(text, encoding="utf-8")
