"""What a finished run's benchmark is: which clips count, with which follow-ups, and why the others are left out.

Written before any planner is scored, so that no planner's result can choose its clips.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from factory.config.run import BenchmarkSettings
from factory.graph.steps import HUMAN_CANDIDATE
from factory.readers.base import ClipRef
from factory.store.samples import MADE_UNDER, Store
from factory.store.schema import RunIdentity
from tasks.hard_scenes import BEFORE_STEPS
from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, FRAMES, HUMAN, HUMAN_BEFORE
from tasks.world.clip import STEP_S

BENCHMARK_FILE = "benchmark.json"
NEEDED = frozenset({HUMAN, *FRAMES})  # samples of each clip
FORMAT = 1


def write_benchmark(
    store: Store, refs: Sequence[ClipRef], identity: RunIdentity, rounds: int, settings: BenchmarkSettings
) -> str:
    """benchmark.json of a complete run, and a line that says what is in it."""
    document = describe_benchmark(store, refs, identity, rounds, settings)
    store.location.write(BENCHMARK_FILE, (json.dumps(document, indent=1) + "\n").encode())
    clips, left_out = document["clips"], document["left_out"]
    whys = ", ".join(f"{why} {n}" for why, n in Counter(clip["why"] for clip in left_out).most_common())
    said = f"{len(clips)} clips, {sum(len(clip['follow_ups']) for clip in clips)} follow-ups"
    return f"benchmark {store.location.uri}/{BENCHMARK_FILE}: {said}; left out {len(left_out)} clips ({whys or 'none'})"


def describe_benchmark(
    store: Store, refs: Sequence[ClipRef], identity: RunIdentity, rounds: int, settings: BenchmarkSettings
) -> dict[str, Any]:
    """The document: clips by id with the candidate indices of their follow-ups, and what is left out and why.

    `follow_ups` of a clip that is left out is how many it has.
    """
    rows = _RunRows.read(store, identity)
    clips: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    for ref in sorted(refs):
        named = {"clip_id": ref.clip_id, "dataset": ref.dataset, "log_id": ref.log_id, "start_ms": ref.start_ms}
        pairs = sorted(rows.made[ref.clip_id, FOLLOW_UP] & rows.made[ref.clip_id, FOLLOW_UP_BEFORE])
        why = rows.why_not(ref.clip_id) or ("few_follow_ups" if len(pairs) < settings.min_follow_ups else "")
        if why:
            left_out.append({**named, "why": why, "follow_ups": len(pairs)})
        else:
            clips.append({**named, "follow_ups": pairs})
    return {
        "format": FORMAT,
        "settings_hash": identity.settings_hash,
        "settings": dict(identity.settings),
        "stage_versions": dict(identity.stage_versions),
        "vocabulary_digest": identity.vocabulary_digest,
        "rounds": rounds,
        "min_follow_ups": settings.min_follow_ups,
        "pair_interval_s": BEFORE_STEPS * STEP_S,
        "clips": clips,
        "left_out": left_out,
    }


@dataclass(frozen=True)
class _RunRows:
    """What the tables say of this run's settings."""

    made: Mapping[tuple[str, str], set[int]]  # clip, expert -> candidates with a sample
    dropped: Mapping[str, str]  # clip -> why it has no sample, or no candidate, at all

    @classmethod
    def read(cls, store: Store, identity: RunIdentity) -> "_RunRows":
        made: dict[tuple[str, str], set[int]] = defaultdict(set)
        for row in store.samples.read([*MADE_UNDER, "clip_id", "candidate_index"]).to_pylist():
            made_by = row["settings_hash"], row["stage_versions"]
            if made_by == (identity.settings_hash, identity.versions_json):
                made[row["clip_id"], row["expert"]].add(row["candidate_index"])
        lists = store.candidates.read(["clip_id", "stage", "reason"]).to_pylist()
        outcomes = store.outcomes.read(["clip_id", "expert", "stage", "reason"]).to_pylist()
        dropped = [*(row for row in lists if row["reason"]), *(row for row in outcomes if not row["expert"])]
        return cls(made, {row["clip_id"]: f"{row['stage']}.{row['reason']}" for row in dropped})

    def why_not(self, clip_id: str) -> str:
        if clip_id in self.dropped:
            return self.dropped[clip_id]
        logged = all(HUMAN_CANDIDATE in self.made[clip_id, expert] for expert in (HUMAN, HUMAN_BEFORE))
        return "" if logged else "no_logged_frames"
