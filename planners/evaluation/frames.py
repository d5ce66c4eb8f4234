"""The frames of a benchmark: what a planner is shown, and the worlds its plans are driven in.

A clip has a logged frame now (at T) and one 0.5 s before; and for each follow-up a simulated frame now (at T+H) and one
0.5 s before. Planning reads the samples, scoring the scenes: neither needs the other.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from factory.store.reader import Sample
from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, HUMAN, HUMAN_BEFORE
from tasks.world.clip import Scene

LOGGED_KINDS = (HUMAN, HUMAN_BEFORE)
FOLLOW_UP_KINDS = (FOLLOW_UP, FOLLOW_UP_BEFORE)
KINDS = (*LOGGED_KINDS, *FOLLOW_UP_KINDS)  # as the samples' column `expert` has them
NO_CANDIDATE = -1


@dataclass(frozen=True, order=True)
class FrameKey:
    """Which frame: follow-ups by their candidate, logged frames by NO_CANDIDATE."""

    clip_id: str
    kind: str
    candidate_index: int = NO_CANDIDATE

    def __str__(self) -> str:
        follow_up = "" if self.candidate_index == NO_CANDIDATE else f" {self.candidate_index}"
        return f"clip {self.clip_id}, frame {self.kind}{follow_up}"

    @staticmethod
    def logged(clip_id: str) -> "tuple[FrameKey, FrameKey]":
        """Now, before."""
        now, before = LOGGED_KINDS
        return FrameKey(clip_id, now), FrameKey(clip_id, before)

    @staticmethod
    def follow_up(clip_id: str, candidate_index: int) -> "tuple[FrameKey, FrameKey]":
        """Now, before."""
        now, before = FOLLOW_UP_KINDS
        return FrameKey(clip_id, now, candidate_index), FrameKey(clip_id, before, candidate_index)


@dataclass(frozen=True)
class FramePair:
    """The scene now and the one 0.5 s before."""

    now: Scene
    before: Scene


@dataclass(frozen=True)
class ClipScenes:
    """The worlds of a clip's frames."""

    clip_id: str
    logged: FramePair
    follow_ups: Mapping[int, FramePair]  # candidate index -> scenes


class Benchmark(Protocol):
    """Frames to plan from and to drive in, fixed before any planner is scored."""

    @property
    def digest(self) -> str:
        """Of everything that scores depend on."""
        ...

    @property
    def keys(self) -> Sequence[FrameKey]:
        """Every frame, clip by clip."""
        ...

    def log_of(self, clip_id: str) -> str:
        """The id of the clip's log."""
        ...

    def image_source(self, key: FrameKey) -> str:
        """photo, render, map or none."""
        ...

    def stream(self, columns: Sequence[str]) -> Iterator[tuple[FrameKey, Sample]]:
        """Every frame once, in whatever order is quick, with some columns of its sample (docs/formats.md)."""
        ...

    def sample(self, key: FrameKey) -> Sample:
        """A whole row."""
        ...

    def scenes(self, clip_id: str) -> ClipScenes:
        """The worlds of a clip's frames."""
        ...
