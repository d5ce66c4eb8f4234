"""What a run has to do: for every clip, what the tables already know about its walks, and whether anything is left."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

from factory.graph.walk import Complete, Exhausted, Step, Try, candidate_order, next_step
from factory.graph.work import HUMAN_CANDIDATE
from factory.readers.base import ClipRef
from factory.store.attempts import History, Kind, Listed, Past
from factory.store.samples import WAYS_OUT, ChangedRun, OnChange
from factory.store.schema import UNLISTED, RunIdentity

Policy = Callable[[Past], bool]
CLIP_CANDIDATE = HUMAN_CANDIDATE  # of a row about the clip as a whole (its expert is empty)


@dataclass
class WalkState:
    """One (clip, expert) on its way."""

    expert: str
    once: bool  # tried once, on the log itself
    recall: Callable[[], dict[int, Past]]  # what the tables say of it
    stale: frozenset[str] = frozenset()  # redo: attempt_ids whose rows this walk replaces as a whole
    n_found: int = 0  # samples that were there when the run began
    one_by_one: bool = False  # a task that was to make several of its attempts died

    @cached_property
    def known(self) -> dict[int, Past]:
        """Candidate -> what became of it; unpacked when it is asked for, and until it is put away."""
        return self.recall()

    def put_away(self) -> None:
        """The tables tell it again; of walks that are not at work nothing is kept."""
        self.__dict__.pop("known", None)

    def step(self, n_candidates: int, rounds: int, may_retry: Policy) -> Step:
        return next_step(self.once, n_candidates, rounds, self.known, may_retry)

    def lacks_exhausted(self, step: Step) -> bool:
        """The walk stands at the end of its list and no outcome says so yet."""
        return isinstance(step, Exhausted) and step.n_tried not in self.known


@dataclass
class ClipPlan:
    """One clip on its way."""

    ref: ClipRef
    walks: tuple[WalkState, ...]
    past: Past | None  # the clip-level outcome, where there is one
    listed: Listed | None  # its row in `candidates`, where it is this run's
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
    ended = {expert: history.complete(expert, *_asked(once(expert), rounds)) for expert in experts}
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
            done.append(_complete(history, ref, listed, n_samples, once))
            continue
        walks = tuple(_walk(history, ref.clip_id, expert, on_change, once(expert)) for expert in experts)
        whole = _walk(history, ref.clip_id, "", on_change, True)
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
            walk.put_away()
    return RunPlan(tuple(todo), tuple(done), tuple(frozen), found)


def _asked(once: bool, rounds: int) -> tuple[int, int]:
    """The first candidate of a walk, and how many samples it is to have."""
    return candidate_order(once, 1)[0], 1 if once else rounds


def _complete(
    history: History, ref: ClipRef, listed: Listed, n_found: Mapping[str, int], once: Callable[[str], bool]
) -> ClipPlan:
    """A clip of which nothing is unpacked; n_found: expert -> samples."""
    walks = tuple(
        WalkState(expert, once(expert), partial(history.known, ref.clip_id, expert), n_found=n)
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


def _of_other_settings(stored: Listed, identity: RunIdentity) -> bool:
    return stored.prepare_digest not in (identity.prepare_digest, UNLISTED) and identity.prepare_digest != UNLISTED


def _walk(history: History, clip_id: str, expert: str, on_change: OnChange, once: bool) -> WalkState:
    stale = history.stale(clip_id, expert) if on_change == "redo" else frozenset()
    if stale:  # the walk is made anew from its first candidate; what an earlier redo failed at stands
        known = history.known(clip_id, expert)
        stale |= {past.attempt_id for past in known.values()}
        failed = {i: past for i, past in known.items() if past.current and past.kind is Kind.FAILED}
        return WalkState(expert, once, partial(dict, failed), stale)
    return WalkState(expert, once, partial(history.known, clip_id, expert))


def _has_work(clip: ClipPlan, rounds: int, may_retry: Policy) -> bool:
    if clip.past is not None and clip.past.kind is Kind.REJECTED:
        return False
    if clip.past is not None and clip.past.kind is Kind.FAILED:
        clip.failed = not may_retry(clip.past)
        return not clip.failed
    if clip.listed is None:
        return True
    clip.steps = {walk.expert: walk.step(clip.n_candidates, rounds, may_retry) for walk in clip.walks}
    return any(isinstance(clip.steps[w.expert], Try) or w.lacks_exhausted(clip.steps[w.expert]) for w in clip.walks)


def wants_payload(clip: ClipPlan) -> bool:
    """Some walk has an attempt to make, or preparing failed before, so that the prepared clip is needed."""
    tries = any(isinstance(step, Try) for step in clip.steps.values())
    return clip.listed is None or clip.past is not None or tries
