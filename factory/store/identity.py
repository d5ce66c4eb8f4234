"""What makes a row this run's: the digests of its settings, stage versions and inputs, and the key of an attempt."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

UNLISTED = "unlisted"  # prepare_digest of clips prepared for the log's own drive alone: no perturb work, no list


@dataclass(frozen=True)
class RunIdentity:
    """What the rows of a run depend on besides clip, candidate and expert."""

    settings: Mapping[str, object]  # flat, dotted names -> plain values; without rounds, experts, limit, executor, out
    stage_versions: Mapping[str, int]
    vocabulary_digest: str
    prepare_digest: str  # of all that `prepare` depends on besides the clip: perturb, traffic, seed, stage versions;
    # UNLISTED in a run of `human` alone

    @cached_property
    def settings_hash(self) -> str:
        """16 hex digits of the canonical JSON of `settings`."""
        return hashlib.sha256(canonical_json(self.settings).encode()).hexdigest()[:16]

    @cached_property
    def versions_json(self) -> str:
        """`stage_versions` as it stands in the tables."""
        return canonical_json(self.stage_versions)


@dataclass(frozen=True)
class Stamp:
    """What the executor writes on a row: columns that Work.label does not give."""

    attempt_id: str
    expert: str
    expert_digest: str
    round: int
    candidate_index: int
    vocabulary_digest: str
    settings_hash: str
    stage_versions: str

    def of(self, clip_id: str, candidate: int, round: int) -> "Stamp":
        """Of another attempt of the same walk."""
        key = attempt_id(clip_id, candidate, self.vocabulary_digest, self.expert, self.expert_digest)
        return replace(self, attempt_id=key, candidate_index=candidate, round=round)


def canonical_json(value: object) -> str:
    """JSON with sorted keys and no spaces; the same for equal values, on every machine."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def attempt_id(clip_id: str, candidate: int, vocabulary_digest: str, expert: str, expert_digest: str) -> str:
    """16 hex digits: the primary key of an attempt, whatever became of it."""
    key = "\x1f".join((clip_id, str(candidate), vocabulary_digest, expert, expert_digest))
    return hashlib.sha256(key.encode()).hexdigest()[:16]
