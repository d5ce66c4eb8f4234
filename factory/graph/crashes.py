"""A run that died at a task: the next one counts it against that clip or attempt, and comes to it last."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from factory.graph.guard import CRASHED, read_note
from factory.graph.plan import CLIP_CANDIDATE, ClipPlan, RunPlan
from factory.graph.records import Records, past_of
from factory.graph.steps import Failure
from factory.graph.walk import Try, tries_before
from factory.store.attempts import ErrorKind, Outcome, Past
from factory.store.schema import attempt_id


def crash_of(folder: Path) -> Mapping[str, Any]:
    """What was in hand when the last run died, as its guard wrote it; empty where none did."""
    return read_note(folder / CRASHED) or {}


def counted(
    crash: Mapping[str, Any], plan: RunPlan, records: Records, may_retry: Callable[[Past], bool]
) -> tuple[RunPlan, list[Outcome]]:
    """The plan that knows of a crash, and the outcome to be stored before anything is begun."""
    suspect = next((clip for clip in plan.todo if _is_of(crash, clip, records)), None)
    if suspect is None:
        return plan, []
    what = Failure(ErrorKind.SYSTEM, f"the run died at it: {crash['what']}")
    others = tuple(clip for clip in plan.todo if clip is not suspect)
    if "expert" in crash:
        walk = next(walk for walk in suspect.walks if walk.expert == crash["expert"])
        candidate, key = crash["candidate"], crash["attempt_id"]
        tries = tries_before(walk.known.get(candidate))
        outcome = records.outcome(suspect.ref, key, walk.expert, candidate, what, tries, {}, {})
        walk.known[candidate] = past_of(outcome)
        return replace(plan, todo=(*others, suspect)), [outcome]
    key = attempt_id(suspect.ref.clip_id, CLIP_CANDIDATE, records.identity.vocabulary_digest, "", "")
    tries = tries_before(suspect.past)
    outcome = records.outcome(suspect.ref, key, "", CLIP_CANDIDATE, what, tries, {}, {})
    suspect.past = past_of(outcome)
    if may_retry(suspect.past):
        return replace(plan, todo=(*others, suspect)), [outcome]
    suspect.failed = True
    return replace(plan, todo=others, done=(*plan.done, suspect)), [outcome]


def _is_of(crash: Mapping[str, Any], clip: ClipPlan, records: Records) -> bool:
    if "expert" not in crash:
        return bool(crash.get("clip_id") == clip.ref.clip_id)
    if crash["expert"] not in records.digests:
        return False
    stamp = records.stamp(clip.ref, crash["expert"], Try(crash["candidate"], 0))
    return bool(stamp.attempt_id == crash["attempt_id"])
