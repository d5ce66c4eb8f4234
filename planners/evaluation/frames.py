"""The frames of a benchmark: what a planner is shown, and the worlds its plans are driven in.

A clip has a logged frame now (at T) and one 0.5 s before; and for each follow-up a simulated frame now (at T+H) and one
0.5 s before. In a one-stage benchmark it is a logged frame alone, and the one 0.5 s before is another clip's, if any's.
Planning reads the samples, scoring the scenes: neither needs the other.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, HUMAN, HUMAN_BEFORE
from tasks.world.clip import Scene

LOGGED_KINDS = (HUMAN, HUMAN_BEFORE)
FOLLOW_UP_KINDS = (FOLLOW_UP, FOLLOW_UP_BEFORE)
KINDS = (*LOGGED_KINDS, *FOLLOW_UP_KINDS)  # as the samples' column `expert` has them
NO_CANDIDATE = -1
T = TypeVar("T")


class Pair(NamedTuple, Generic[T]):
    """Something of a frame now, and of the one 0.5 s before."""

    now: T
    before: T


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
    def logged(clip_id: str) -> "Pair[FrameKey]":
        """Of the log."""
        return Pair(*(FrameKey(clip_id, kind) for kind in LOGGED_KINDS))

    @staticmethod
    def follow_up(clip_id: str, candidate_index: int) -> "Pair[FrameKey]":
        """Of one follow-up."""
        return Pair(*(FrameKey(clip_id, kind, candidate_index) for kind in FOLLOW_UP_KINDS))


FramePair = Pair[Scene]


@dataclass(frozen=True)
class ClipScenes:
    """The worlds of a clip's frames."""

    clip_id: str
    logged: FramePair
    follow_ups: Mapping[int, FramePair]  # candidate index -> scenes
