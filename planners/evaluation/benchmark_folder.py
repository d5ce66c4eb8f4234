"""A benchmark on disk, as `python -m factory.run preset=hard_benchmark` wrote it: samples, and scenes of each clip.

benchmark.json says which clips count and with which follow-ups; what else stands in the tables is left alone.
"""

import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from factory.config.compose import ConfigError
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.store.location import Location, SceneFiles
from factory.store.reader import Sample, SampleTable
from planners.evaluation.frames import ClipScenes, FrameKey, FramePair
from tasks.hard_scenes import BenchmarkClip, GivenScenes, OneStageClip
from tasks.world.clip import Scene

IDENTITY = ("attempt_id", "clip_id", "expert", "candidate_index", "image_source", "settings_hash", "stage_versions")

HOW = "run the command that made it again, to its end"
MADE_BY = (  # of towns that no page trains on; their cameras are painted where frames are, so that no log has to be
    "python -m factory.run preset=hard_benchmark clips=synthetic_towns clips.split=test clips.first_seed=501 "
    "clips.first_window=2 'clips.settings.cameras=[]' clips.settings.lidar_beams=0 render=painter vocabulary.k=16384"
)


def how_to_make(out: str) -> str:
    """One command that makes a benchmark in a folder."""
    return f"make it, to its end: {MADE_BY} out={shlex.quote(out)}; of your own logs: docs/training.md#evaluation"


class BenchmarkFolder:
    """Frames of held-out clips, to plan from and to drive in."""

    def __init__(self, path: str) -> None:
        """path: the run's `out`. Reads ids only.

        Raises ConfigError where there is no benchmark or none of its clips counts, a frame has no sample, or a clip no
        scenes.
        """
        self.path, location = path, Location.parse(path)
        self._document = location.read(BENCHMARK_FILE) or b""
        self._listed = _listed(path, self._document)
        self._follow_ups = {clip_id: clip.follow_ups for clip_id, clip in self._listed.clips.items()}
        try:
            self.table = SampleTable(path)
        except (FileNotFoundError, ValueError) as error:
            raise ConfigError(f"benchmark={path}: {error}") from error
        rows = self.table.table(IDENTITY).to_pylist()
        found = {FrameKey(row["clip_id"], row["expert"], row["candidate_index"]): row for row in rows}
        wanted = [key for clip_id in self._listed.clips for key in self._frames_of(clip_id)]
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
        return self._listed.clips[clip_id].log_id

    @property
    def one_stage(self) -> bool:
        """Whether each clip is one logged frame."""
        return self._listed.stages == 1

    @property
    def left_out(self) -> int:
        """Clips that were asked for and do not count."""
        return self._listed.left_out

    @cached_property
    def tokens(self) -> dict[FrameKey, str]:
        """NAVSIM's tokens of the frames; none where it was not made of NAVSIM's files."""
        named = [(clip.tokens, self._frames_of(clip_id)) for clip_id, clip in self._listed.clips.items()]
        return {key: token for tokens, keys in named if tokens for key, token in zip(keys, tokens, strict=True)}

    def before_of(self, clip_id: str) -> str | None:
        """The clip whose frame is the one 0.5 s before, of a one-stage benchmark; None: there is none."""
        return self._listed.clips[clip_id].before

    def _frames_of(self, clip_id: str) -> list[FrameKey]:
        """Now and before of the log, then of each follow-up; of one stage now alone."""
        now, before = FrameKey.logged(clip_id)
        follow_ups = (key for i in self._follow_ups[clip_id] for key in FrameKey.follow_up(clip_id, i))
        return [now] if self.one_stage else [now, before, *follow_ups]

    def image_source(self, key: FrameKey) -> str:
        """photo, render, map, painter or none."""
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
        stored = self._stored(clip_id)
        try:
            if isinstance(stored, OneStageClip):
                raise ConfigError(f"benchmark={self.path} is of one stage: it has no pairs of frames")
            return ClipScenes(
                clip_id,
                FramePair(stored.stage_one(), stored.stage_one(before=True)),
                {
                    i: FramePair(stored.stage_two(i), stored.stage_two(i, before=True))
                    for i in self._follow_ups[clip_id]
                },
            )
        except (ValueError, KeyError) as error:
            if isinstance(error, ConfigError):
                raise
            raise self._damaged(clip_id, error) from error

    def scene(self, clip_id: str) -> Scene:
        """The world of the logged frame now. Raises ConfigError where the file is damaged."""
        return self._stored(clip_id).stage_one()

    def _stored(self, clip_id: str) -> BenchmarkClip | GivenScenes | OneStageClip:
        try:
            return self._scenes.load(clip_id)
        except (ValueError, KeyError) as error:
            raise self._damaged(clip_id, error) from error

    def _damaged(self, clip_id: str, error: Exception) -> ConfigError:
        return ConfigError(f"benchmark={self.path}: scenes of clip {clip_id}: {error}: {HOW}")


@dataclass(frozen=True)
class _Clip:
    """An entry of benchmark.json."""

    log_id: str
    follow_ups: tuple[int, ...]
    tokens: tuple[str, ...]  # of its frames; none where they are not of NAVSIM
    before: str | None  # of one stage


@dataclass(frozen=True)
class _Listed:
    """What benchmark.json says."""

    stages: int
    clips: Mapping[str, _Clip]
    left_out: int


def read_clip_logs(path: str) -> dict[str, str]:
    """Clip -> log of a benchmark, from its document alone. Raises ConfigError where there is none."""
    clips = _listed(path, Location.parse(path).read(BENCHMARK_FILE) or b"").clips
    return {clip_id: clip.log_id for clip_id, clip in clips.items()}


def _listed(path: str, document: bytes) -> _Listed:
    if not document:
        raise ConfigError(f"benchmark={path}: no {BENCHMARK_FILE} here: {how_to_make(path)}")
    try:
        stored: dict[str, Any] = json.loads(document)
        if stored["format"] != FORMAT:
            raise ConfigError(f"benchmark={path}: format {stored['format']}, this version reads {FORMAT}")
        clips = {str(clip["clip_id"]): _clip(clip) for clip in stored["clips"]}
        left_out = stored["left_out"]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"benchmark={path}: {BENCHMARK_FILE} cannot be read ({error}): {HOW}") from error
    if not clips:
        why = "; ".join(sorted({str(clip["why"]) for clip in left_out})) or "it read none"
        more = "raise rounds and vocabulary.k of the command that made it, or lower benchmark.min_follow_ups"
        raise ConfigError(f"benchmark={path}: none of its clips counts: {why}: {more}")
    return _Listed(int(stored.get("stages", 2)), clips, len(left_out))


def _clip(entry: Mapping[str, Any]) -> _Clip:
    pairs = entry.get("follow_up_tokens", ())
    tokens = (*entry.get("tokens", ()), *(token for pair in pairs for token in pair))
    return _Clip(str(entry["log_id"]), tuple(map(int, entry["follow_ups"])), tokens, entry.get("before"))
