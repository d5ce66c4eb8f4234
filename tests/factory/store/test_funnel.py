"""The funnel counts from the tables alone."""

from collections import Counter, defaultdict
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.execute import Execution
from factory.store.funnel import (
    OUTCOME_COLUMNS,
    SAMPLE_COLUMNS,
    Attempts,
    FunnelRow,
    attempts_from_tables,
    expert_rows,
    funnel_of,
    image_sources_text,
)
from factory.store.samples import OUTCOMES, ClipCandidates, Store
from factory.store.schema import SAMPLES
from tests.factory.toy import ToyWork, executed, refs

Walks = dict[str, dict[str, list[tuple[int, str]]]]  # expert -> clip -> candidate and why it fell, "": accepted
RUN = {"settings_hash": "s", "stage_versions": {}, "expert_digests": {}}
MADE = {"expert_digest": "d", "settings_hash": "s", "stage_versions": "{}"}


def attempts(walks: Walks) -> Attempts:
    """As they would stand in the tables, in any order."""
    samples, outcomes = [], []
    for expert, clips in walks.items():
        for clip, tries in clips.items():
            for candidate, why in reversed(tries):
                row = MADE | {"expert": expert, "clip_id": clip, "candidate_index": candidate}
                stage, _, reason = why.partition(".")
                kind = "exhausted" if why == "exhausted" else "failed" if stage == "failed" else "rejected"
                became = {"kind": kind, "stage": stage, "reason": reason, "error_kind": reason}
                (outcomes.append(row | became) if why else samples.append(row))
    tables = [
        pa.Table.from_pylist(rows, schema=pa.schema([spec.schema.field(name) for name in columns]))
        for rows, spec, columns in ((samples, SAMPLES, SAMPLE_COLUMNS), (outcomes, OUTCOMES, OUTCOME_COLUMNS))
    ]
    return attempts_from_tables(tables[0], tables[1], [RUN])


def slow_rows(expert: str, clips: dict[str, list[tuple[int, str]]]) -> list[FunnelRow]:
    """Attempt by attempt."""
    accepted, first_drives, reasons = Counter[int](), Counter[int](), defaultdict[int, Counter[str]](Counter)
    tried = {clip: [one for one in sorted(tries) if one[1] != "exhausted"] for clip, tries in clips.items()}
    for tries in tried.values():
        at, fresh = 0, True
        for _, why in tries:
            if why:
                reasons[at][why] += 1
                fresh = fresh and why.split(".")[0] in ("rollout", "expert")
            else:
                accepted[at] += 1
                first_drives[at] += fresh
                at, fresh = at + 1, True
    rows, before = [], len(clips)
    simulated = any(candidate >= 0 for tries in tried.values() for candidate, _ in tries)
    for number in range(max([*accepted, *reasons], default=-1) + 1):
        failed = sum(n for why, n in reasons[number].items() if why.startswith("failed."))
        counts = (accepted[number], reasons[number].total() - failed, failed, before, accepted[number], len(clips))
        rows.append(FunnelRow(expert, number, *counts, dict(reasons[number]), first_drives[number], simulated))
        before = accepted[number]
    return rows


def test_an_attempt_belongs_to_the_round_it_was_tried_for() -> None:
    clips = {
        "a": [(0, "reward.nc"), (1, ""), (2, "reward.ep"), (3, "")],
        "b": [(0, "expert.out_of_reach"), (1, ""), (2, "reward.nc")],
        "c": [(0, "failed.bug")],
    }
    first, second = expert_rows(attempts({"recovery": clips}), 0)[:2]
    reasons = {"expert.out_of_reach": 1, "failed.bug": 1, "reward.nc": 1}
    assert first == FunnelRow("recovery", 0, 2, 2, 1, 3, 2, 3, reasons, 1)
    assert second == FunnelRow("recovery", 1, 1, 2, 0, 2, 1, 3, {"reward.ep": 1, "reward.nc": 1})
    assert first.first_drive_rate == pytest.approx(1 / 3) and second.first_drive_rate == 0.0  # clip b; nobody
    assert first.attempt_rate == 0.4 and first.clip_rate == pytest.approx(2 / 3)
    assert second.clip_rate == 0.5 and second.clip_rate_of_all == pytest.approx(1 / 3)


@given(
    st.dictionaries(
        st.sampled_from(["recovery", "pdm_closed", "human"]),
        st.dictionaries(
            st.sampled_from("abcdef"),
            st.lists(
                st.sampled_from(["", "expert.no_plan", "reward.nc", "render.holes", "failed.bug", "exhausted"]),
                min_size=1,
                max_size=9,
            ),
            min_size=1,
        ),
    )
)
@settings(max_examples=50, deadline=None)
def test_the_funnel_is_that_of_a_count_attempt_by_attempt(whys: dict[str, dict[str, list[str]]]) -> None:
    walks = {
        expert: {clip: [(i - (expert == "human"), why) for i, why in enumerate(tries)] for clip, tries in clips.items()}
        for expert, clips in whys.items()
    }
    found = attempts(walks)
    for number, expert in enumerate(found.experts):
        assert expert_rows(found, number) == slow_rows(expert, walks[expert])


def test_the_funnel_adds_up_to_the_tables(tmp_path: Path) -> None:
    work = ToyWork(trouble={"log0:0": "standing", "log1:1000": "no_candidates", "log0:2000:recovery:1": "bug"})
    store = Store(tmp_path)
    summary = executed(work, refs(6), ["recovery", "human"], 3, store)
    funnel = funnel_of(store)
    assert funnel == summary.funnel
    assert sum(row.accepted for row in funnel.rows) == summary.counts["accepted"] == len(store.samples)
    assert sum(row.rejected for row in funnel.rows) == summary.counts["rejected"] - 1
    assert sum(row.failed for row in funnel.rows) == summary.counts["failed"] == 1
    assert funnel.clip_outcomes == {"clip.ego_standing": 1}
    assert funnel.clips_without_candidates == {"perturb.no_gated_candidate": 1}
    assert funnel.clips_prepared == 5 and funnel.candidates == 24 and funnel.gates == {"heading": 35, "lateral": 15}
    (human,) = [row for row in funnel.rows if row.expert == "human"]
    assert (human.accepted, human.clips_total) == (5, 5)
    wide = funnel.text(width=200)
    assert "nc " in wide and "failed.bug 1" in wide
    assert funnel_of(store, []).rows == ()


def test_image_sources_are_counted_over_the_clips_asked_for(tmp_path: Path) -> None:
    store, clips = Store(tmp_path), refs(4)
    executed(ToyWork(), clips, ["human"], 1, store)
    counted = [
        sum(int(part.rsplit(" ", 1)[1]) for part in image_sources_text(store, ids).removeprefix("images: ").split(", "))
        for ids in ([ref.clip_id for ref in clips], [clips[0].clip_id])
    ]
    assert counted == [4, 1]
    assert image_sources_text(store, []) == "images: no samples"


def test_a_candidate_counts_once_though_its_failure_was_mended_with_other_inputs(tmp_path: Path) -> None:
    broken = ToyWork(trouble={"log0:0:pdm_closed:0": "bug"})
    fixed = ToyWork(digests={"pdm_closed": "pdm_closed-2"})
    executed(broken, refs(1), ["pdm_closed"], 2, Store(tmp_path))
    store = Store(tmp_path)
    executed(fixed, refs(1), ["pdm_closed"], 9, store, Execution("local", on_change="keep", retry=True))
    tried = sum(row.accepted + row.rejected + row.failed for row in funnel_of(store).rows)
    assert tried == fixed.n_candidates
    assert "failed" not in store.outcomes.read(["kind"])["kind"].to_pylist()


def test_a_redo_that_failed_is_seen_and_not_mended_by_the_next_run(tmp_path: Path) -> None:
    def run(work: ToyWork, **options: object) -> int:
        how = Execution("local", **options)  # type: ignore[arg-type]
        summary = executed(work, refs(1), ["recovery"], 2, Store(tmp_path), how)
        return summary.exit_code

    run(ToyWork(threshold=0.3))
    first = min(Store(tmp_path).samples.read(["candidate_index"])["candidate_index"].to_pylist())
    broken = ToyWork(threshold=0.29, trouble={f"log0:0:recovery:{first}": "bug"})
    for _ in range(2):
        assert run(broken, on_change="redo") == COMPLETE_WITH_FAILURES
        assert sum(row.failed for row in funnel_of(Store(tmp_path)).rows) == 1
    for _ in range(2):
        assert run(broken) == BAD_CONFIG
    assert run(broken, on_change="keep") == COMPLETE_WITH_FAILURES
    assert run(ToyWork(threshold=0.29), on_change="redo", retry=True) == COMPLETE
    assert sum(row.failed for row in funnel_of(Store(tmp_path)).rows) == 0


def test_clips_without_candidates_are_counted_over_files_of_different_reasons(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for number, reason in enumerate(("gate", "speed", "", "speed")):
        made = {"clip_id": f"c{number}", "stage": "perturb" if reason else "", "reason": reason}
        rest = dict.fromkeys(("dataset", "log_id", "content_digest", "prepare_digest", "vocabulary_digest"), "x")
        store.commit([ClipCandidates(**made, **rest, gate_counts={"lateral": 2}, candidates=())], [], [])
    funnel = funnel_of(store)
    assert funnel.clips_without_candidates == {"perturb.speed": 2, "perturb.gate": 1}
    assert funnel.clips_prepared == 4 and funnel.gates == {"lateral": 8}
