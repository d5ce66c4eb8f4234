"""Walks: rounds are nested, incidents stop them, and where one stands follows from the tables alone."""

from hypothesis import given
from hypothesis import strategies as st

from factory.graph.plan import (
    AttemptBatch,
    Blocked,
    Complete,
    Exhausted,
    Step,
    Try,
    next_batch,
    next_step,
    retry_policy,
)
from factory.store.samples import ErrorKind, Kind, PastAttempt


def never(past: PastAttempt) -> bool:
    return False


def past(kind: Kind, round_: int = -1, error: str = "", versions: str = "v1") -> PastAttempt:
    return PastAttempt("id", kind, True, round_, error, 1, versions)


def walk(
    accepts: list[bool], rounds: int, known: dict[int, PastAttempt] | None = None
) -> tuple[dict[int, PastAttempt], Step, int]:
    """Walk to the end; (known, last step, attempts made)."""
    known, made = dict(known or {}), 0
    while isinstance(step := next_step(False, len(accepts), rounds, known, never), Try):
        good = accepts[step.candidate]
        known[step.candidate] = past(Kind.ACCEPTED, step.round) if good else past(Kind.REJECTED)
        made += 1
    return known, step, made


LISTS = st.lists(st.booleans(), max_size=12)


@given(LISTS, st.integers(1, 4), st.integers(0, 4))
def test_more_rounds_go_on_where_fewer_stopped(accepts: list[bool], rounds: int, more: int) -> None:
    first, _, made = walk(accepts, rounds)
    resumed, step, made_later = walk(accepts, rounds + more, first)
    direct, direct_step, made_directly = walk(accepts, rounds + more)
    assert (resumed, step, made + made_later) == (direct, direct_step, made_directly)


@given(LISTS, st.integers(1, 4), st.sets(st.integers(0, 11)))
def test_any_lost_results_are_made_again_the_same(accepts: list[bool], rounds: int, lost: set[int]) -> None:
    whole, step, _ = walk(accepts, rounds)
    kept = {candidate: p for candidate, p in whole.items() if candidate not in lost}
    assert walk(accepts, rounds, kept)[:2] == (whole, step)


@given(LISTS, st.integers(1, 4), st.integers(1, 5), st.sets(st.integers(0, 11)))
def test_in_stretches_a_walk_makes_the_attempts_that_it_makes_one_by_one(
    accepts: list[bool], rounds: int, most: int, lost: set[int]
) -> None:
    whole, end, _ = walk(accepts, rounds)
    known = {candidate: p for candidate, p in whole.items() if candidate not in lost}
    made = []
    while isinstance(step := next_step(False, len(accepts), rounds, known, never), Try):
        along = next_batch(False, len(accepts), rounds, known, step, most)
        assert 1 <= along.n <= most
        accepted = 0
        for candidate in range(step.candidate, step.candidate + along.n):
            assert candidate not in known
            made.append(candidate)
            good = accepts[candidate]
            known[candidate] = past(Kind.ACCEPTED, step.round + accepted) if good else past(Kind.REJECTED)
            accepted += good
            if accepted == along.samples:
                break
    assert (known, step) == (whole, end)
    assert made == sorted(set(whole) & lost)


def test_a_stretch_tries_a_failure_again_and_goes_on_behind_it() -> None:
    known = {0: past(Kind.ACCEPTED, 0), 1: past(Kind.FAILED, error="system"), 4: past(Kind.REJECTED)}
    assert next_batch(False, 9, 4, known, Try(1, 1), 6) == AttemptBatch(3, 3)
    assert next_batch(False, 9, 2, known, Try(1, 1), 6) == AttemptBatch(3, 1)
    assert next_batch(True, 9, 4, {}, Try(-1, 0), 6) == AttemptBatch(1, 1)


def test_a_walk_ends_complete_or_exhausted() -> None:
    assert walk([True, False, True, True], 2)[1] == Complete()
    assert walk([True, False], 2)[1] == Exhausted(2)
    assert walk([], 1)[1] == Exhausted(0)
    assert sorted(walk([True, False, True, True], 2)[0]) == [0, 1, 2]


def test_who_is_tried_once_drives_once_whatever_the_rounds() -> None:
    assert next_step(True, 9, 5, {}, never) == Try(-1, 0)
    for kind in (Kind.ACCEPTED, Kind.REJECTED):
        assert next_step(True, 9, 5, {-1: past(kind, 0)}, never) == Complete()


def test_a_failure_stops_the_walk_until_it_is_mended() -> None:
    for kind in (ErrorKind.BUG, ErrorKind.INPUT, ErrorKind.POISON):
        known = {0: past(Kind.FAILED, error=kind)}
        assert next_step(False, 3, 2, known, retry_policy(False, "v1")) == Blocked(0, "failed")
        assert next_step(False, 3, 2, known, retry_policy(True, "v1")) == Try(0, 0)
        assert next_step(False, 3, 2, known, retry_policy(False, "v2")) == Try(0, 0)
    system = {0: past(Kind.FAILED, error=ErrorKind.SYSTEM)}
    assert next_step(False, 3, 2, system, retry_policy(False, "v1")) == Try(0, 0)


def test_a_stored_round_that_the_walk_contradicts_is_not_built_upon() -> None:
    step = next_step(False, 3, 3, {0: past(Kind.REJECTED), 1: past(Kind.ACCEPTED, 1)}, never)
    assert isinstance(step, Blocked) and "round 1" in step.reason
