"""What a run writes down of clips and attempts: stamps, outcomes and lists of candidates, under the run's identity."""

from collections.abc import Mapping
from dataclasses import dataclass

from factory.graph.steps import Failure
from factory.graph.walk import Exhausted, Try
from factory.graph.work import PreparedClip
from factory.readers.base import ClipRef
from factory.store.attempts import QUARANTINE_AFTER, ClipCandidates, ErrorKind, Kind, Outcome, Past
from factory.store.schema import RunIdentity, Stamp, attempt_id
from tasks.stages import Rejected


@dataclass(frozen=True)
class Records:
    """Those of one run."""

    identity: RunIdentity
    digests: Mapping[str, str]  # expert -> digest of what its attempts depend on

    def stamp(self, ref: ClipRef, expert: str, step: Try) -> Stamp:
        """Of the attempt that a walk makes next."""
        digest, vocabulary = self.digests[expert], self.identity.vocabulary_digest
        return Stamp(
            attempt_id(ref.clip_id, step.candidate, vocabulary, expert, digest),
            expert,
            digest,
            step.round,
            step.candidate,
            vocabulary,
            self.identity.settings_hash,
            self.identity.versions_json,
        )

    def outcome(
        self,
        ref: ClipRef,
        key: str,
        expert: str,
        candidate: int,
        what: Rejected | Failure | Exhausted,
        tries: int,
        subscores: dict[str, float],
        seconds: dict[str, float],
    ) -> Outcome:
        """Of what is not accepted; key: the attempt's id. A death or a limit is poison after QUARANTINE_AFTER."""
        if isinstance(what, Rejected):
            became = {"kind": Kind.REJECTED.value, "stage": what.stage, "reason": what.reason, "detail": what.detail}
        elif isinstance(what, Failure):
            tries -= what.kind is ErrorKind.MACHINE  # never counts
            poison = what.kind in (ErrorKind.SYSTEM, ErrorKind.LIMIT) and tries + 1 >= QUARANTINE_AFTER
            kind = ErrorKind.POISON if poison else what.kind
            became = {"kind": Kind.FAILED.value, "stage": what.task, "error_kind": kind.value, "error": what.error}
        else:
            became = {"kind": Kind.EXHAUSTED.value}
        return Outcome(
            attempt_id=key,
            clip_id=ref.clip_id,
            dataset=ref.dataset,
            log_id=ref.log_id,
            expert=expert,
            expert_digest=self.digests.get(expert, ""),
            candidate_index=candidate,
            settings_hash=self.identity.settings_hash,
            stage_versions=self.identity.versions_json,
            tries=tries + 1,
            n_tried=what.n_tried if isinstance(what, Exhausted) else 0,
            subscores=subscores,
            seconds=seconds,
            **became,
        )

    def candidates(self, ref: ClipRef, clip: PreparedClip) -> ClipCandidates:
        """The list of a prepared clip."""
        identity, dropped = self.identity, clip.dropped or Rejected("", "")
        read = (ref.clip_id, ref.dataset, ref.log_id, clip.content_digest)
        under = (identity.prepare_digest, identity.vocabulary_digest)
        gates = dict(clip.gate_counts)
        return ClipCandidates(*read, *under, gates, clip.candidates, dropped.stage, dropped.reason)


def past_of(outcome: Outcome) -> Past:
    """The same as the tables of a later run will tell it."""
    kind = Kind(outcome.kind)
    return Past(outcome.attempt_id, kind, True, -1, outcome.error_kind, outcome.tries, outcome.stage_versions)
