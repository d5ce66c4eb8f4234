"""A run that goes on after something changed: it stops and names it, keeps both, or makes the old rows anew."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc
import pytest

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.store.samples import Store, record_differences
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of
from tests.factory.toy import VERSIONS, ToyWork, executed, ran, refs


@pytest.mark.parametrize(
    ("work", "named"),
    [
        (ToyWork(threshold=0.6), "reward.threshold: 0.5 -> 0.6"),
        (ToyWork(settings={"render.size": [4, 2]}), r"render.size: not set -> \[4, 2\]"),
        (ToyWork(versions=VERSIONS | {"reward": 2}), "stage version reward: 1 -> 2"),
        (ToyWork(digests={"recovery": "table-2"}), "inputs of expert recovery: recovery-1 -> table-2"),
        (ToyWork(prepare_digest="perturb-2"), "what perturb depends on: perturb-1 -> perturb-2"),
    ],
)
def test_a_changed_run_stops_and_names_the_difference(
    tmp_path: Path, work: ToyWork, named: str, begun: Callable[..., Path]
) -> None:
    begun(rounds=1, n=1)
    before = tables_of(tmp_path / "out")
    summary = run(tmp_path / "out", work, rounds=2, n=1)
    assert summary.exit_code == BAD_CONFIG
    assert re.search(named, summary.message)
    assert tables_of(tmp_path / "out")[1:] == before[1:]


def test_another_data_set_in_an_old_folder_is_told_in_a_short_line(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1, n=1)
    settings = {f"render.{key}": {"on": True, "width": 320} for key in "abcdefgh"}
    others = [replace(ref, dataset="street") for ref in refs(1)]
    summary = executed(ToyWork(settings=settings), others, ["recovery"], 1, Store(tmp_path / "out"))
    shown = "; ".join(f"render.{key}: not set -> {{'on': True, 'width': 320}}" for key in "abc")
    told = f"{tmp_path}/out holds samples of word0, word1, made with other settings ({shown}; and 5 more)"
    assert summary.message == f"{told}: choose another out for street"


def test_a_group_of_settings_is_told_by_what_differs_in_it() -> None:
    records = [
        {"settings": {"gate": {"on": on, "width": 9}}, "stage_versions": {}, "expert_digests": {}}
        | {"vocabulary_digest": "", "prepare_digest": ""}
        for on in (True, False)
    ]
    assert record_differences(*records) == ["gate.on: True -> False"]


def test_keep_goes_on_and_records_both(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(n=2)
    changed = ToyWork(threshold=0.1)
    assert run(tmp_path / "out", changed, n=4, on_change="keep").exit_code == COMPLETE
    hashes = tables_of(tmp_path / "out")[0]["settings_hash"].unique().to_pylist()
    assert sorted(hashes) == sorted({ToyWork().identity.settings_hash, changed.identity.settings_hash})
    assert len(Store(tmp_path / "out").runs()) == 2
    assert run(tmp_path / "out", changed, n=4).exit_code == COMPLETE


@pytest.mark.slow
def test_a_redo_of_some_clips_leaves_the_others_to_be_decided(tmp_path: Path, begun: Callable[..., Path]) -> None:
    changed = ToyWork(threshold=0.3)
    begun(n=4)
    assert run(tmp_path / "out", changed, n=1, on_change="redo").exit_code == COMPLETE
    assert run(tmp_path / "out", changed, n=1).exit_code == COMPLETE
    before = tables_of(tmp_path / "out")
    stopped = run(tmp_path / "out", changed, n=4)
    assert stopped.exit_code == BAD_CONFIG
    assert f"3 of 4 clips, as clip {refs(2)[1].clip_id} of log log1, hold rows of other settings" in stopped.message
    assert_same_rows(tables_of(tmp_path / "out")[0], before[0])
    assert run(tmp_path / "out", changed, n=4, on_change="redo").exit_code == COMPLETE
    assert run(tmp_path / "out", changed, n=4).executed.attempts == 0
    run(tmp_path / "fresh", changed, n=4)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")


@pytest.mark.slow
def test_keep_holds_until_something_else_is_said(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(n=4)
    changed = ToyWork(threshold=0.3)
    run(tmp_path / "out", changed, n=1, on_change="redo")
    assert run(tmp_path / "out", changed, n=4, on_change="keep").exit_code == COMPLETE
    assert run(tmp_path / "out", changed, n=4, rounds=3).exit_code == COMPLETE
    run(tmp_path / "out", changed, n=1, on_change="redo")
    assert run(tmp_path / "out", changed, n=4).exit_code == BAD_CONFIG


def test_redo_takes_no_candidate_list_from_under_other_experts(tmp_path: Path, begun: Callable[..., Path]) -> None:
    changed = ToyWork(settings={"seed": 1}, prepare_digest="perturb-2")
    begun()
    before = tables_of(tmp_path / "out")
    refused = run(tmp_path / "out", changed, experts=["pdm_closed"], on_change="redo")
    assert refused.exit_code == BAD_CONFIG and "rows of human, recovery stand on" in refused.message
    assert tables_of(tmp_path / "out")[2] == before[2]
    assert run(tmp_path / "out", changed, n=1, on_change="redo").exit_code == COMPLETE
    assert run(tmp_path / "out", changed, experts=["another"]).exit_code == BAD_CONFIG  # it would skip clips 1 to 3


def test_a_changed_expert_is_seen_after_a_run_without_it(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1)
    changed = ToyWork(threshold=0.3)
    run(tmp_path / "out", changed, experts=["human"], on_change="redo")
    stopped = run(tmp_path / "out", replace(changed, digests={"recovery": "table-2"}))
    assert stopped.exit_code == BAD_CONFIG
    assert "inputs of expert recovery: recovery-1 -> table-2" in stopped.message


def test_keep_never_continues_a_walk_on_another_candidate_list(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(n=2, rounds=1)
    kept = tables_of(tmp_path / "out")[0]
    summary = run(tmp_path / "out", ToyWork(prepare_digest="perturb-2"), n=2, rounds=3, on_change="keep")
    assert summary.executed.attempts == 0 and "2 clips kept as they are" in summary.notes[0]
    assert_same_rows(tables_of(tmp_path / "out")[0], kept)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rounds", "changed"),
    [
        (3, ToyWork(threshold=0.3, prepare_digest="perturb-2", trouble={"log0:0": "standing"})),
        (2, ToyWork(threshold=0.3, content="other")),
    ],
    ids=["fewer rounds of other candidates", "a changed log, which is read anew in spite of the cache"],
)
def test_redo_replaces_every_row_and_is_the_same_as_a_fresh_run(
    tmp_path: Path, begun: Callable[..., Path], rounds: int, changed: ToyWork
) -> None:
    begun(rounds=rounds)
    assert run(tmp_path / "out", changed, on_change="redo").exit_code == COMPLETE
    run(tmp_path / "fresh", changed)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")
    assert run(tmp_path / "out", changed, on_change="redo").executed.attempts == 0
    assert run(tmp_path / "out", changed, rounds=3).exit_code == COMPLETE


def test_redo_replaces_the_rows_of_an_expert_whose_inputs_changed_and_no_others(
    tmp_path: Path, begun: Callable[..., Path]
) -> None:
    begun()
    changed = ToyWork(digests={"recovery": "recovery-2"}, journal=str(tmp_path / "journal"))
    assert run(tmp_path / "out", changed, on_change="redo").exit_code == COMPLETE
    assert ran(changed.journal, "attempt") == sum(
        ran(changed.journal, f"attempt {ref.log_id}:{ref.start_ms}:recovery") for ref in refs(4)
    )
    run(tmp_path / "fresh", ToyWork(digests={"recovery": "recovery-2"}))
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")


@pytest.mark.slow
def test_a_redo_that_fails_midway_keeps_the_old_walk(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=3, n=1)
    old = tables_of(tmp_path / "out")[0]
    changed = ToyWork(threshold=0.3, trouble={"log0:0:recovery:3": "bug"})  # the first of three is made by then
    assert run(tmp_path / "out", changed, rounds=3, n=1, on_change="redo").exit_code == COMPLETE_WITH_FAILURES
    mine = pc.equal(old["expert"], "recovery")
    now = tables_of(tmp_path / "out")[0]
    assert_same_rows(now.filter(pc.equal(now["expert"], "recovery")), old.filter(mine))
    again = replace(changed, journal=str(tmp_path / "journal"))
    assert run(tmp_path / "out", again, rounds=3, n=1, on_change="redo").exit_code == COMPLETE_WITH_FAILURES
    assert ran(again.journal, "attempt log0:0:recovery:3 ") == 0, (
        "what this redo failed at stands until it is asked for"
    )
    fixed = replace(changed, trouble={})
    assert run(tmp_path / "out", fixed, rounds=3, n=1, on_change="redo", retry=True).exit_code == COMPLETE
    run(tmp_path / "fresh", fixed, rounds=3, n=1)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")


@pytest.mark.parametrize(
    ("is_cached", "changed", "found"),
    [
        (True, ToyWork(content="other"), "other"),
        (False, ToyWork(content="other"), "other"),
        (False, ToyWork(content="other", tells_content=False), "other"),
        (False, ToyWork(trouble={"log0:0": "standing"}, tells_content=False), "none (ego_standing)"),
    ],
)
def test_a_changed_log_under_the_same_clip_id_is_refused_by_name(
    tmp_path: Path, is_cached: bool, changed: ToyWork, found: str, begun: Callable[..., Path]
) -> None:
    begun(rounds=1, n=1)
    before = tables_of(tmp_path / "out")
    for path in [] if is_cached else (tmp_path / "out/cache/prepared").iterdir():
        path.unlink()
    summary = run(tmp_path / "out", changed, rounds=3, n=1)
    assert summary.exit_code == COMPLETE_WITH_FAILURES
    samples, outcomes, candidates = tables_of(tmp_path / "out")
    (row,) = [o for o in outcomes if o["kind"] == "failed"]  # type: ignore[index]
    assert row["error_kind"] == "input"  # type: ignore[index]
    assert f"log log0: clip: content digest {found} where the table has content" in row["error"]  # type: ignore[index]
    assert_same_rows(samples, before[0])
    assert candidates == before[2]


def test_a_restored_log_goes_on(tmp_path: Path, begun: Callable[..., Path], plain: Callable[..., Path]) -> None:
    begun(rounds=1)
    run(tmp_path / "out", ToyWork(content="other"), rounds=3)
    assert run(tmp_path / "out", rounds=3, retry=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain(rounds=3))


@pytest.mark.slow
def test_redo_tries_again_what_a_bug_stopped_under_other_settings_and_nothing_that_it_stopped_under_these(
    tmp_path: Path,
) -> None:
    """Changed settings may be what fixes it; the same ones are tried again only when asked to."""
    out, journal = tmp_path / "out", str(tmp_path / "journal")
    bug = {"log0:0:recovery:0": "bug"}
    assert run(out, ToyWork(trouble=bug), n=1).exit_code == COMPLETE_WITH_FAILURES
    changed = ToyWork(threshold=0.4, prepare_digest="perturb-2", trouble=bug, journal=journal)
    assert run(out, changed, n=1, on_change="redo").exit_code == COMPLETE_WITH_FAILURES
    assert ran(journal, "attempt log0:0:recovery:0 ") == 1
    assert run(out, changed, n=1, on_change="redo").executed.attempts == 0
    assert ran(journal, "attempt log0:0:recovery:0 ") == 1
    fixed = replace(changed, threshold=0.6, trouble={})
    assert run(out, fixed, n=1, on_change="redo").exit_code == COMPLETE
    fresh = tmp_path / "fresh"
    run(fresh, fixed, n=1)
    assert_same_tables(out, fresh)


def test_redo_refuses_a_changed_log_whose_rows_are_to_stay(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1, n=1)
    before = tables_of(tmp_path / "out")
    changed = ToyWork(digests={"recovery": "table-2"}, content="other")
    assert run(tmp_path / "out", changed, rounds=1, n=1, on_change="redo").exit_code == COMPLETE_WITH_FAILURES
    samples, _, candidates = tables_of(tmp_path / "out")
    assert_same_rows(samples, before[0])
    assert candidates == before[2]


@pytest.mark.slow
def test_redo_makes_a_walk_of_mixed_settings_anew(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1)
    changed = ToyWork(threshold=0.1)
    run(tmp_path / "out", changed, rounds=3, on_change="keep")
    assert run(tmp_path / "out", changed, rounds=3, on_change="redo").exit_code == COMPLETE
    run(tmp_path / "fresh", changed, rounds=3)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")
