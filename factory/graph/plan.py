"""What a run has to do: for every clip, what the tables already know about its walks, and whether anything is left."""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from factory.graph.steps import HUMAN_CANDIDATE, Failure, PreparedClip
from factory.readers.base import ClipRef
from factory.store.samples import (
    QUARANTINE_AFTER,
    WAYS_OUT,
    CandidateSummary,
    ChangedRun,
    ClipCandidates,
    ErrorKind,
    History,
    Kind,
    OnChange,
    Outcome,
    PastAttempt,
)
from factory.store.schema import UNLISTED, RunIdentity, Stamp, attempt_id
from tasks.stages import Rejected

# The walk of one (clip, expert) down the clip's candidate list: what to try next, given what is known.
#
# A pure function of the list and of what became of its candidates, so that a resumed walk, a longer one (`rounds=5`
# after `rounds=2`) and a fresh one are the same walk. An incident (a failed attempt) stops the walk until it is
# fixed: going on would give later samples another round than in a run without the incident, and rows must not depend
# on incidents.

TRIED_AGAIN = (ErrorKind.MACHINE, ErrorKind.SYSTEM, ErrorKind.LIMIT)  # by the next run, by itself


@dataclass(frozen=True)
class Try:
    """Attempt this candidate; if it is accepted, it is the sample of this round."""

    candidate: int
    round: int


@dataclass(frozen=True)
class Complete:
    """The walk has all samples it was asked for (an expert that is tried once: its one attempt is done)."""


@dataclass(frozen=True)
class Exhausted:
    """The list ended before the walk had all rounds."""

    n_tried: int


@dataclass(frozen=True)
class Blocked:
    """The walk stands at a failed attempt."""

    candidate: int
    reason: str


Step = Try | Complete | Exhausted | Blocked


def candidate_order(once: bool, n_candidates: int) -> Sequence[int]:
    """Candidate indices in the order in which a walk tries them; once: of an expert that is tried once."""
    return (HUMAN_CANDIDATE,) if once else range(n_candidates)


def next_step(
    once: bool,
    n_candidates: int,
    rounds: int,
    known: Mapping[int, PastAttempt],
    may_retry: Callable[[PastAttempt], bool],
) -> Step:
    """Where the walk stands. An expert that is tried `once` has one attempt in round 0 whatever `rounds` is."""
    wanted = 1 if once else rounds
    accepted = 0
    for candidate in candidate_order(once, n_candidates):
        if accepted == wanted:
            return Complete()
        past = known.get(candidate)
        if past is None:
            return Try(candidate, accepted)
        if past.kind is Kind.FAILED:
            return Try(candidate, accepted) if may_retry(past) else Blocked(candidate, "failed")
        if past.kind is Kind.ACCEPTED:
            if past.round != accepted:
                return Blocked(candidate, f"stored as round {past.round}, the walk makes it {accepted}")
            accepted += 1
    return Complete() if accepted == wanted or once else Exhausted(n_candidates)


@dataclass(frozen=True)
class AttemptBatch:
    """Attempts of a walk that one task makes: one after the other until one fails or enough are accepted."""

    n: int  # attempts at most
    samples: int  # accepted at most


def next_batch(
    once: bool, n_candidates: int, rounds: int, known: Container[int], begins: Try, most: int
) -> AttemptBatch:
    """Up to `most` attempts that nothing is known of but the first, whatever becomes of those before them."""
    if once:
        return AttemptBatch(1, 1)
    end = min(n_candidates, begins.candidate + most)
    n = next((i for i in range(begins.candidate + 1, end) if i in known), end) - begins.candidate
    return AttemptBatch(n, min(n, rounds - begins.round))


def retry_policy(retry: bool, versions_json: str) -> Callable[[PastAttempt], bool]:
    """Which failures of earlier runs this run tries again: those of machine, system and limits; with `retry`, or under
    other stage versions than the failure's, all."""

    def may_retry(past: PastAttempt) -> bool:
        return retry or past.error_kind in TRIED_AGAIN or past.stage_versions != versions_json

    return may_retry


def tries_so_far(past: PastAttempt | None) -> int:
    """Runs that already failed at this attempt and count against it."""
    return past.tries if past is not None and past.error_kind in TRIED_AGAIN else 0


Policy = Callable[[PastAttempt], bool]
CLIP_CANDIDATE = HUMAN_CANDIDATE  # of a row about the clip as a whole (its expert is empty)


@dataclass(slots=True)
class WalkState:
    """One (clip, expert) on its way; of a large run there are millions."""

    expert: str
    once: bool  # tried once, on the log itself
    load_known: Callable[[], dict[int, PastAttempt]]  # what the tables say of it
    stale: frozenset[str] = frozenset()  # redo: attempt_ids whose rows this walk replaces as a whole
    n_found: int = 0  # samples that were there when the run began
    wanted: int = 0  # samples that the run is still to make, or to find that it cannot
    one_by_one: bool = False  # a task that was to make several of its attempts died
    _known: dict[int, PastAttempt] | None = None

    @property
    def known(self) -> dict[int, PastAttempt]:
        """Candidate -> what became of it; unpacked when it is asked for, and until it is put away."""
        if self._known is None:
            self._known = self.load_known()
        return self._known

    def forget(self) -> None:
        """The tables tell it again; of walks that are not at work nothing is kept."""
        self._known = None

    def step(self, n_candidates: int, rounds: int, may_retry: Policy) -> Step:
        return next_step(self.once, n_candidates, rounds, self.known, may_retry)

    def needs_exhausted_row(self, step: Step) -> bool:
        """The walk stands at the end of its list and no outcome says so yet."""
        return isinstance(step, Exhausted) and step.n_tried not in self.known


@dataclass(slots=True)
class ClipPlan:
    """One clip on its way."""

    ref: ClipRef
    walks: tuple[WalkState, ...]
    past: PastAttempt | None  # the clip-level outcome, where there is one
    listed: CandidateSummary | None  # its row in `candidates`, where it is this run's
    stale: frozenset[str]  # redo: clip-level rows to replace
    n_candidates: int
    content: str | None  # digest that the rows which are to stay were made from
    failed: bool = False  # the clip as a whole, in this run or for good
    steps: dict[str, Step] = field(default_factory=dict)


@dataclass(frozen=True)
class RunPlan:
    """All clips of a run: those with something left to do, in order, and the others."""

    todo: tuple[ClipPlan, ...]
    done: tuple[ClipPlan, ...]
    frozen: tuple[ClipRef, ...]  # clips whose candidate list comes from other settings: kept, never continued
    found_done: int  # attempts that an earlier run settled


def make_plan(
    refs: Sequence[ClipRef],
    experts: Sequence[str],
    rounds: int,
    history: History,
    identity: RunIdentity,
    on_change: OnChange,
    may_retry: Policy,
    once: Callable[[str], bool],
) -> RunPlan:
    """Hold what is asked for against the tables; once: whether an expert is tried once.

    Rows of other settings: under `redo` they count as absent and are replaced, under `keep` they count as done. Raises
    ChangedRun where there are some under `stop`, and where `redo` would replace the candidate list of other rows.
    """
    _refuse_mixing(refs, experts, history, identity, on_change)
    todo: list[ClipPlan] = []
    done: list[ClipPlan] = []
    frozen: list[ClipRef] = []
    found = 0
    others = history.clips_of({*history.experts} - {"", *experts})
    whole_clips = history.clips_of([""])
    ended = {
        expert: history.complete_walks(expert, candidate_order(once(expert), 1)[0], 1 if once(expert) else rounds)
        for expert in experts
    }
    for ref in refs:
        stored = listed = history.candidates.get(ref.clip_id)
        if stored is not None and _of_other_settings(stored, identity):
            if on_change != "redo":
                frozen.append(ref)
                continue
            stored = listed = None
        if stored is not None and UNLISTED == stored.prepare_digest != identity.prepare_digest:
            listed = None  # its drive is stored, its candidates are to be found
        if listed is not None and ref.clip_id not in whole_clips and all(ref.clip_id in ended[e] for e in experts):
            found += sum(ended[expert][ref.clip_id][1] for expert in experts)
            n_samples = {expert: ended[expert][ref.clip_id][0] for expert in experts}
            done.append(_completed_clip(history, ref, listed, n_samples, once))
            continue
        walks = tuple(_walk_state(history, ref.clip_id, expert, on_change, once(expert)) for expert in experts)
        whole = _walk_state(history, ref.clip_id, "", on_change, True)
        stays = on_change != "redo" or any(walk.known and not walk.stale for walk in walks) or ref.clip_id in others
        clip = ClipPlan(
            ref,
            walks,
            whole.known.get(CLIP_CANDIDATE),
            listed,
            whole.stale,
            listed.n_candidates if listed is not None else 0,
            stored.content_digest if stored is not None and stays else None,
        )
        for walk in clip.walks:
            kinds = [past.kind for past in walk.known.values()]
            walk.n_found = kinds.count(Kind.ACCEPTED)
            found += walk.n_found + kinds.count(Kind.REJECTED)
        (todo if _has_work(clip, rounds, may_retry) else done).append(clip)
        for walk in clip.walks:
            walk.forget()
    return RunPlan(tuple(todo), tuple(done), tuple(frozen), found)


def _completed_clip(
    history: History, ref: ClipRef, listed: CandidateSummary, n_found: Mapping[str, int], once: Callable[[str], bool]
) -> ClipPlan:
    """A clip of which nothing is unpacked; n_found: expert -> samples."""
    walks = tuple(
        WalkState(expert, once(expert), partial(history.past_attempts, ref.clip_id, expert), n_found=n)
        for expert, n in n_found.items()
    )
    steps: dict[str, Step] = dict.fromkeys(n_found, Complete())
    return ClipPlan(ref, walks, None, listed, frozenset(), listed.n_candidates, listed.content_digest, steps=steps)


def _refuse_mixing(
    refs: Sequence[ClipRef], experts: Sequence[str], history: History, identity: RunIdentity, on_change: OnChange
) -> None:
    relisted = {clip_id for clip_id, row in history.candidates.items() if _of_other_settings(row, identity)}
    if on_change == "stop":
        old = history.clips_of({"", *experts}, stale=True) | relisted
        mixed = [ref for ref in refs if ref.clip_id in old]
        if mixed:
            where = f"clip {mixed[0].clip_id} of log {mixed[0].log_id}"
            raise ChangedRun(f"{len(mixed)} of {len(refs)} clips, as {where}, hold rows of other settings. {WAYS_OUT}")
    if on_change == "redo":
        wanted = {ref.clip_id for ref in refs} & relisted
        left = sorted(history.experts_of(wanted) - {"", *experts})
        if left:
            raise ChangedRun(
                f"redo replaces candidate lists that rows of {', '.join(left)} stand on: name these experts too, or "
                "choose another out"
            )


def _of_other_settings(stored: CandidateSummary, identity: RunIdentity) -> bool:
    return stored.prepare_digest not in (identity.prepare_digest, UNLISTED) and identity.prepare_digest != UNLISTED


def _walk_state(history: History, clip_id: str, expert: str, on_change: OnChange, once: bool) -> WalkState:
    stale = history.stale_ids(clip_id, expert) if on_change == "redo" else frozenset()
    if stale:  # the walk is made anew from its first candidate; what an earlier redo failed at stands
        known = history.past_attempts(clip_id, expert)
        stale |= {past.attempt_id for past in known.values()}
        failed = {i: past for i, past in known.items() if past.current and past.kind is Kind.FAILED}
        return WalkState(expert, once, partial(dict, failed), stale)
    return WalkState(expert, once, partial(history.past_attempts, clip_id, expert))


def _has_work(clip: ClipPlan, rounds: int, may_retry: Policy) -> bool:
    if clip.past is not None and clip.past.kind is Kind.REJECTED:
        return False
    if clip.past is not None and clip.past.kind is Kind.FAILED:
        clip.failed = not may_retry(clip.past)
        return not clip.failed
    if clip.listed is None:
        return True
    clip.steps = {walk.expert: walk.step(clip.n_candidates, rounds, may_retry) for walk in clip.walks}
    return any(isinstance(clip.steps[w.expert], Try) or w.needs_exhausted_row(clip.steps[w.expert]) for w in clip.walks)


def needs_prepared_clip(clip: ClipPlan) -> bool:
    """Some walk has an attempt to make, or preparing failed before, so that the prepared clip is needed."""
    tries = any(isinstance(step, Try) for step in clip.steps.values())
    return clip.listed is None or clip.past is not None or tries


# What a run writes down of clips and attempts: stamps, outcomes and lists of candidates, under the run's identity.


@dataclass(frozen=True)
class RunRecords:
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
        why_none, repaired = (dropped.stage, dropped.reason), (clip.repairs, clip.repair_records)
        return ClipCandidates(*read, *under, dict(clip.gate_counts), clip.candidates, *why_none, *repaired)


def past_from_outcome(outcome: Outcome) -> PastAttempt:
    """The same as the tables of a later run will tell it."""
    kind = Kind(outcome.kind)
    return PastAttempt(outcome.attempt_id, kind, True, -1, outcome.error_kind, outcome.tries, outcome.stage_versions)


# A run that died at a task: the next one counts it against that clip or attempt, and comes to it last.


def plan_after_crash(
    crash: Mapping[str, Any], plan: RunPlan, records: RunRecords, may_retry: Callable[[PastAttempt], bool]
) -> tuple[RunPlan, list[Outcome]]:
    """The plan that knows of a crash, and the outcome to be stored before anything is begun."""
    suspect = next((clip for clip in plan.todo if _is_crash_of(crash, clip, records)), None)
    if suspect is None:
        return plan, []
    what = Failure(ErrorKind.SYSTEM, f"the run died at it: {crash['what']}")
    others = tuple(clip for clip in plan.todo if clip is not suspect)
    if "expert" in crash:
        walk = next(walk for walk in suspect.walks if walk.expert == crash["expert"])
        candidate, key = crash["candidate"], crash["attempt_id"]
        tries = tries_so_far(walk.known.get(candidate))
        outcome = records.outcome(suspect.ref, key, walk.expert, candidate, what, tries, {}, {})
        walk.known[candidate] = past_from_outcome(outcome)
        return replace(plan, todo=(*others, suspect)), [outcome]
    key = attempt_id(suspect.ref.clip_id, CLIP_CANDIDATE, records.identity.vocabulary_digest, "", "")
    tries = tries_so_far(suspect.past)
    outcome = records.outcome(suspect.ref, key, "", CLIP_CANDIDATE, what, tries, {}, {})
    suspect.past = past_from_outcome(outcome)
    if may_retry(suspect.past):
        return replace(plan, todo=(*others, suspect)), [outcome]
    suspect.failed = True
    return replace(plan, todo=others, done=(*plan.done, suspect)), [outcome]


def _is_crash_of(crash: Mapping[str, Any], clip: ClipPlan, records: RunRecords) -> bool:
    if "expert" not in crash:
        return bool(crash.get("clip_id") == clip.ref.clip_id)
    if crash["expert"] not in records.digests:
        return False
    stamp = records.stamp(clip.ref, crash["expert"], Try(crash["candidate"], 0))
    return bool(stamp.attempt_id == crash["attempt_id"])
