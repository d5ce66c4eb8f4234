"""A benchmark on disk, as `python -m factory.run preset=hard_benchmark` wrote it: samples, and scenes of each clip.

benchmark.json says which clips count and with which follow-ups; what else stands in the tables is left alone.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

from factory.config.compose import ConfigError
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.store.cache import SceneFiles
from factory.store.location import Location
from factory.store.reader import Sample, SampleTable
from planners.evaluation.frames import ClipScenes, FrameKey, FramePair

IDENTITY = ("attempt_id", "clip_id", "expert", "candidate_index", "image_source", "settings_hash", "stage_versions")
HOW = "make it with python -m factory.run preset=hard_benchmark, to its end"


class BenchmarkFolder:
    """Frames of held-out clips; satisfies planners.evaluation.frames.Benchmark."""

    def __init__(self, path: str) -> None:
        """path: the run's `out`. Reads ids only.

        Raises ConfigError where there is no benchmark or none of its clips counts, a frame has no sample, or a clip no
        scenes.
        """
        self.path, location = path, Location.parse(path)
        self._document = location.read(BENCHMARK_FILE) or b""
        self._follow_ups, self._logs = _clips_of(path, self._document)
        try:
            self.table = SampleTable(path)
        except (FileNotFoundError, ValueError) as error:
            raise ConfigError(f"benchmark={path}: {error}") from error
        rows = self.table.table(IDENTITY).to_pylist()
        found = {FrameKey(row["clip_id"], row["expert"], row["candidate_index"]): row for row in rows}
        wanted = [key for clip_id in self._follow_ups for key in _frames_of(clip_id, self._follow_ups[clip_id])]
        if lacking := [key for key in wanted if key not in found]:
            raise ConfigError(f"benchmark={path}: {lacking[0]} has no sample: {HOW}")
        self._rows = {key: found[key] for key in wanted}
        self._scenes = SceneFiles(location.child("scenes"))
        if without := sorted(set(self._follow_ups) - set(self._scenes.clip_ids())):
            raise ConfigError(
                f"benchmark={path}: no scenes of {len(without)} clips, such as {without[0]}, "
                f"and plans cannot be driven in samples alone: {HOW}"
            )

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Every frame, clip by clip."""
        return tuple(self._rows)

    @cached_property
    def digest(self) -> str:
        """Of benchmark.json, the samples' identity and the scene files."""
        found = hashlib.sha256(self._document)
        for row in self._rows.values():
            found.update(json.dumps(row, sort_keys=True).encode())
        for clip_id in self._follow_ups:
            found.update(self._scenes.location.read(f"{clip_id}.npz") or b"")
        return found.hexdigest()[:16]

    def log_of(self, clip_id: str) -> str:
        """The id of the clip's log."""
        return self._logs[clip_id]

    def image_source(self, key: FrameKey) -> str:
        """photo, render, map or none."""
        return str(self._rows[key]["image_source"])

    def stream(self, columns: Sequence[str]) -> Iterator[tuple[FrameKey, Sample]]:
        """Every frame once, in the order of the files, with some columns of its sample."""
        which = ("clip_id", "expert", "candidate_index")
        for sample in self.table.iterate(list(dict.fromkeys([*which, *columns]))):
            key = FrameKey(*(sample[name] for name in which))
            if key in self._rows:
                yield key, sample

    def sample(self, key: FrameKey) -> Sample:
        """One whole row."""
        return self.table[str(self._rows[key]["attempt_id"])]

    def scenes(self, clip_id: str) -> ClipScenes:
        """The worlds of a clip's frames. Raises ConfigError where the file is damaged or lacks one."""
        try:
            stored = self._scenes.load(clip_id)
            return ClipScenes(
                clip_id,
                FramePair(stored.stage_one(), stored.stage_one(before=True)),
                {
                    i: FramePair(stored.stage_two(i), stored.stage_two(i, before=True))
                    for i in self._follow_ups[clip_id]
                },
            )
        except (ValueError, KeyError) as error:
            raise ConfigError(f"benchmark={self.path}: scenes of clip {clip_id}: {error}: {HOW}") from error


def logs_of(path: str) -> dict[str, str]:
    """Clip -> log of a benchmark, from its document alone. Raises ConfigError where there is none."""
    return _clips_of(path, Location.parse(path).read(BENCHMARK_FILE) or b"")[1]


def _clips_of(path: str, document: bytes) -> tuple[dict[str, list[int]], dict[str, str]]:
    """Clip -> candidate indices of its follow-ups, clip -> its log."""
    if not document:
        raise ConfigError(f"benchmark={path}: no {BENCHMARK_FILE} here: {HOW}")
    try:
        stored: dict[str, Any] = json.loads(document)
        if stored["format"] != FORMAT:
            raise ConfigError(f"benchmark={path}: format {stored['format']}, this version reads {FORMAT}")
        clips = {str(clip["clip_id"]): [int(i) for i in clip["follow_ups"]] for clip in stored["clips"]}
        logs = {str(clip["clip_id"]): str(clip["log_id"]) for clip in stored["clips"]}
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"benchmark={path}: {BENCHMARK_FILE} cannot be read ({error}): {HOW}") from error
    if not clips:
        why = "; ".join(sorted({str(clip["why"]) for clip in stored["left_out"]})) or "it read none"
        raise ConfigError(f"benchmark={path}: none of its clips counts: {why}")
    return clips, logs


def _frames_of(clip_id: str, follow_ups: Sequence[int]) -> list[FrameKey]:
    """Now and before of the log, then of each follow-up."""
    return [*FrameKey.logged(clip_id), *(key for i in follow_ups for key in FrameKey.follow_up(clip_id, i))]
