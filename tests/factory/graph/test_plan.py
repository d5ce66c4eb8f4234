"""A plan is that which walks, unpacked one by one, would make, where it asks all of them at once as well."""

from dataclasses import replace
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factory.graph.plan import ClipPlan, RunPlan, make_plan, retry_policy
from factory.store.samples import OUTCOME_STATE, OUTCOMES, SAMPLE_STATE, CandidateSummary, History, Kind, build_history
from factory.store.schema import SAMPLES, attempt_id
from tests.factory.toy import ToyWork, refs

WORK = ToyWork(n_candidates=4)
EXPERTS = ("recovery", "human")
CLIPS = refs(3)
KINDS = ("accepted", "rejected", "failed", "exhausted", "lost")  # the last: there is no row
# Of a walk's candidate: what became of it, and whether under this run's settings.
FATES = st.tuples(st.sampled_from(KINDS[:2] * 4 + KINDS), st.sampled_from([True] * 9 + [False]))
WALKS = st.lists(FATES, max_size=5)
CLIP_ROWS = st.sampled_from([None] * 6 + [Kind.REJECTED, Kind.FAILED])


def rows_of(walks: list[list[tuple[str, bool]]], whole: list[Kind | None], doubled: bool) -> History:
    """What a table holds of walks, by clip and expert; doubled: of accepted ones an older failure too."""
    samples, outcomes = list[dict[str, Any]](), list[dict[str, Any]]()
    for place, ref in enumerate(CLIPS):
        for number, expert in enumerate(EXPERTS):
            round_ = 0
            for candidate, (kind, current) in enumerate(walks[len(EXPERTS) * place + number]):
                if kind == "lost":
                    continue
                row = row_of(ref.clip_id, expert, candidate - WORK.once(expert), current)
                if kind == "accepted":
                    samples.append(row | {"round": round_})
                    round_ += 1
                if kind != "accepted" or doubled:
                    outcomes.append(row | {"kind": "failed" if kind == "accepted" else kind, "error_kind": "bug"})
        if (said := whole[place]) is not None:
            outcomes.append(row_of(ref.clip_id, "", -1, True) | {"kind": said.value, "error_kind": "bug"})
    listed = {ref.clip_id: CandidateSummary(WORK.identity.prepare_digest, "content", 4) for ref in CLIPS}
    made_by = WORK.identity.settings_hash, WORK.identity.versions_json
    digests = {expert: WORK.expert_digest(expert) for expert in EXPERTS}
    return build_history(
        table(outcomes, OUTCOMES.schema, OUTCOME_STATE),
        table(samples, SAMPLES.schema, SAMPLE_STATE),
        listed,
        made_by,
        digests,
    )


def row_of(clip_id: str, expert: str, candidate: int, current: bool) -> dict[str, Any]:
    digest = WORK.expert_digest(expert) if expert else ""
    key = attempt_id(clip_id, candidate, WORK.identity.vocabulary_digest, expert, digest)
    made = {
        "settings_hash": WORK.identity.settings_hash if current else "old",
        "stage_versions": WORK.identity.versions_json,
    }
    return {
        "attempt_id": key,
        "clip_id": clip_id,
        "expert": expert,
        "expert_digest": digest,
        "candidate_index": candidate,
        "tries": 1,
        **made,
    }


def table(rows: list[dict[str, Any]], schema: pa.Schema, names: list[str]) -> pa.Table:
    kept = pa.schema([schema.field(name) for name in names])
    return pa.Table.from_pylist(rows, kept)


def plan_of(history: History, rounds: int) -> RunPlan:
    policy = retry_policy(False, WORK.identity.versions_json)
    return make_plan(CLIPS, EXPERTS, rounds, history, WORK.identity, "keep", policy, WORK.once)


def told(clip: ClipPlan) -> tuple[object, ...]:
    walks = [(walk.expert, walk.once, walk.n_found, walk.stale, dict(walk.known)) for walk in clip.walks]
    return replace(clip, walks=()), walks


class OneByOne(History):
    """Says of no walk at once that it is complete."""

    def complete_walks(self, expert: str, first: int, wanted: int) -> dict[str, tuple[int, int]]:
        return {}


@given(
    st.lists(WALKS, min_size=6, max_size=6),
    st.lists(CLIP_ROWS, min_size=3, max_size=3),
    st.booleans(),
    st.integers(1, 3),
)
def test_walks_that_are_complete_at_once_are_those_that_are_complete_one_by_one(
    walks: list[list[tuple[str, bool]]], whole: list[Kind | None], doubled: bool, rounds: int
) -> None:
    history = rows_of(walks, whole, doubled)
    at_once, slowly = plan_of(history, rounds), plan_of(OneByOne(**vars(history)), rounds)
    assert list(map(told, at_once.todo)) == list(map(told, slowly.todo))
    assert list(map(told, at_once.done)) == list(map(told, slowly.done))
    assert (at_once.frozen, at_once.found_done) == (slowly.frozen, slowly.found_done)


@pytest.mark.parametrize("broken", ["lost", "failed", "exhausted"])
def test_a_walk_with_a_gap_is_not_complete(broken: str) -> None:
    walk = [("accepted", True), (broken, True), ("accepted", True)]
    history = rows_of([walk, []] * 3, [None] * 3, False)
    assert history.complete_walks("recovery", 0, 2) == {}
