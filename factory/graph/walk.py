"""The walk of one (clip, expert) down the clip's candidate list: what to try next, given what is known.

A pure function of the list and of what became of its candidates, so that a resumed walk, a longer one (`rounds=5` after
`rounds=2`) and a fresh one are the same walk. An incident (a failed attempt) stops the walk until it is fixed: going
on would give later samples another round than in a run without the incident, and rows must not depend on incidents.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass

from factory.graph.work import HUMAN_CANDIDATE
from factory.store.attempts import ErrorKind, Kind, Past

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
    once: bool, n_candidates: int, rounds: int, known: Mapping[int, Past], may_retry: Callable[[Past], bool]
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
class Stretch:
    """Attempts of a walk that one task makes: one after the other until one fails or enough are accepted."""

    n: int  # attempts at most
    samples: int  # accepted at most


def stretch(once: bool, n_candidates: int, rounds: int, known: Container[int], begins: Try, most: int) -> Stretch:
    """Up to `most` attempts that nothing is known of but the first, whatever becomes of those before them."""
    if once:
        return Stretch(1, 1)
    end = min(n_candidates, begins.candidate + most)
    n = next((i for i in range(begins.candidate + 1, end) if i in known), end) - begins.candidate
    return Stretch(n, min(n, rounds - begins.round))


def retry_policy(retry: bool, versions_json: str) -> Callable[[Past], bool]:
    """Which failures of earlier runs this run tries again: those of machine, system and limits; with `retry`, or under
    other stage versions than the failure's, all."""

    def may_retry(past: Past) -> bool:
        return retry or past.error_kind in TRIED_AGAIN or past.stage_versions != versions_json

    return may_retry


def tries_before(past: Past | None) -> int:
    """Runs that already failed at this attempt and count against it."""
    return past.tries if past is not None and past.error_kind in TRIED_AGAIN else 0
