"""A run in the local executor: resume, nested rounds, failures, changed settings; the store is real."""

import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pyarrow.compute as pc
import pytest

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.graph import execute as execution
from factory.graph.execute import RunSummary, execute
from factory.graph.work import Built, Driven, Dropped, Halted, PreparedClip, Stopped, never
from factory.readers.base import ClipRef
from factory.store.identity import UNLISTED
from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of
from tests.factory.toy import VERSIONS, ToyWork, ran, refs

EXPERTS = ["recovery", "pdm_closed", "human"]


def run(
    out: Path,
    work: ToyWork | None = None,
    rounds: int = 2,
    n: int = 4,
    experts: Sequence[str] = EXPERTS,
    **options: object,
) -> RunSummary:
    return execute(
        work or ToyWork(),
        refs(n),
        experts,
        rounds,
        Store(out),
        "local",
        say=lambda line: None,
        **options,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder that an undisturbed run leaves, made once: to compare with."""

    @cache
    def made(rounds: int, n: int) -> Path:
        out = tmp_path_factory.mktemp("plain") / "out"
        run(out, rounds=rounds, n=n)
        return out

    return lambda rounds=2, n=4: made(rounds, n)


@pytest.fixture
def begun(plain: Callable[..., Path], tmp_path: Path) -> Callable[..., Path]:
    """A copy of such a folder, to go on in."""

    def copied(rounds: int = 2, n: int = 4) -> Path:
        return shutil.copytree(plain(rounds, n), tmp_path / "out")

    return copied


def test_when_minutes_are_up_nothing_new_begins_and_the_same_command_goes_on(
    plain: Callable[..., Path], tmp_path: Path
) -> None:
    cut = run(tmp_path / "out", minutes=0.0)
    assert cut.exit_code == INTERRUPTED and "run the same command again" in cut.message
    assert run(tmp_path / "out", minutes=60.0).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_the_same_command_again_executes_nothing(tmp_path: Path) -> None:
    journal = str(tmp_path / "journal")
    first = run(tmp_path / "out", ToyWork(journal=journal))
    tasks = ran(journal, "")
    second = run(tmp_path / "out", ToyWork(journal=journal))
    assert first.exit_code == second.exit_code == COMPLETE
    assert ran(journal, "") == tasks and second.executed.attempts == 0
    assert second.executed.found_done == first.executed.attempts
    assert second.counts == first.counts


@pytest.mark.slow
def test_five_rounds_after_two_are_five_rounds_and_perturb_nothing_again(tmp_path: Path) -> None:
    journal = str(tmp_path / "journal")
    run(tmp_path / "nested", ToyWork(journal=journal), rounds=2)
    assert ran(journal, "prepare") == 4
    later = run(tmp_path / "nested", ToyWork(journal=journal), rounds=5)
    assert ran(journal, "prepare") == 4 and later.executed.prepared == 0
    direct = run(tmp_path / "direct", rounds=5)
    assert later.executed.attempts + later.executed.found_done == direct.executed.attempts
    assert_same_tables(tmp_path / "nested", tmp_path / "direct")


def test_a_lost_cache_is_prepared_again_and_said(
    tmp_path: Path, begun: Callable[..., Path], plain: Callable[..., Path]
) -> None:
    begun(rounds=1)
    for path in (tmp_path / "out/cache/prepared").iterdir():
        path.write_bytes(path.read_bytes()[:50])
    later = run(tmp_path / "out", rounds=3)
    assert later.executed.prepared > 0
    assert any("prepared again" in note for note in later.notes)
    assert_same_tables(tmp_path / "out", plain(rounds=3))


def test_every_attempt_has_one_row_in_one_table(tmp_path: Path) -> None:
    summary = run(tmp_path / "out", rounds=5)
    samples, outcomes, _ = tables_of(tmp_path / "out")
    keys = samples["attempt_id"].to_pylist() + [o["attempt_id"] for o in outcomes]  # type: ignore[index]
    assert len(keys) == len(set(keys)) == sum(summary.counts.values())
    assert verify(Store(tmp_path / "out")).damage == ()


def test_a_walk_that_runs_out_of_candidates_is_exhausted_once(tmp_path: Path) -> None:
    run(tmp_path / "out", ToyWork(threshold=0.99), rounds=1)
    run(tmp_path / "out", ToyWork(threshold=0.99), rounds=3)
    _, outcomes, _ = tables_of(tmp_path / "out")
    exhausted = [o for o in outcomes if o["kind"] == "exhausted"]  # type: ignore[index]
    assert len(exhausted) == 8 and {o["n_tried"] for o in exhausted} == {6}  # type: ignore[index]
    before = Store(tmp_path / "out")
    run(tmp_path / "out", ToyWork(threshold=0.99), rounds=3)
    after = Store(tmp_path / "out")
    claimed = (after.candidates.version or 0) - (before.candidates.version or 0)
    assert (after.outcomes.version or 0) - (before.outcomes.version or 0) == claimed, "nothing is said twice"


def test_a_clip_without_candidates_still_gives_its_human_sample(tmp_path: Path) -> None:
    summary = run(tmp_path / "out", ToyWork(trouble={"log0:0": "no_candidates", "log1:1000": "standing"}), n=2)
    samples, outcomes, candidates = tables_of(tmp_path / "out")
    assert samples["expert"].to_pylist() == ["human"] and summary.exit_code == COMPLETE
    assert [c["reason"] for c in candidates] == ["no_gated_candidate"]  # type: ignore[index]
    assert sorted((o["kind"], o["reason"]) for o in outcomes) == [  # type: ignore[index]
        ("exhausted", ""),
        ("exhausted", ""),
        ("rejected", "ego_standing"),
    ]


def test_broken_input_and_bugs_are_rows_with_a_reason_and_hurt_nobody_else(
    tmp_path: Path, plain: Callable[..., Path]
) -> None:
    work = ToyWork(trouble={"log0:0": "bad", "log1:1000:recovery:0": "bug"})
    summary = run(tmp_path / "out", work)
    assert summary.exit_code == COMPLETE_WITH_FAILURES
    _, outcomes, _ = tables_of(tmp_path / "out")
    failed = {o["error_kind"]: o["error"] for o in outcomes if o["kind"] == "failed"}  # type: ignore[index]
    assert "toy.feather: tx_m" in failed["input"] and "ZeroDivisionError: a bug in a stage" in failed["bug"]
    again = run(tmp_path / "out", work)
    assert again.exit_code == COMPLETE_WITH_FAILURES and again.executed.attempts == 0
    fixed = run(tmp_path / "out", ToyWork(), retry=True)
    assert fixed.exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_a_system_failure_is_tried_by_the_next_run_and_quarantined_after_three(
    tmp_path: Path, plain: Callable[..., Path]
) -> None:
    work = ToyWork(trouble={"log0:0:recovery:0": "disk"})
    for tries in (1, 2, 3):
        assert run(tmp_path / "out", work).exit_code == COMPLETE_WITH_FAILURES
        (row,) = [o for o in tables_of(tmp_path / "out")[1] if o["kind"] == "failed"]  # type: ignore[index]
        assert (row["tries"], row["error_kind"]) == (tries, "poison" if tries == 3 else "system")  # type: ignore[index]
    assert run(tmp_path / "out", work).executed.attempts == 0
    assert run(tmp_path / "out", retry=True).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


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


def test_redo_replaces_every_row_and_is_the_same_as_a_fresh_run(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=3)
    changed = ToyWork(threshold=0.3, prepare_digest="perturb-2", trouble={"log0:0": "standing"})
    assert run(tmp_path / "out", changed, rounds=2, on_change="redo").exit_code == COMPLETE
    run(tmp_path / "fresh", changed, rounds=2)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")
    assert run(tmp_path / "out", changed, rounds=2, on_change="redo").executed.attempts == 0


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


def test_redo_reads_a_changed_log_anew_in_spite_of_the_cache(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=2)
    changed = ToyWork(threshold=0.3, content="other")
    assert run(tmp_path / "out", changed, on_change="redo").exit_code == COMPLETE
    run(tmp_path / "fresh", changed)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")
    assert run(tmp_path / "out", changed, rounds=3).exit_code == COMPLETE


def test_redo_refuses_a_changed_log_whose_rows_are_to_stay(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1, n=1)
    before = tables_of(tmp_path / "out")
    changed = ToyWork(digests={"recovery": "table-2"}, content="other")
    assert run(tmp_path / "out", changed, rounds=1, n=1, on_change="redo").exit_code == COMPLETE_WITH_FAILURES
    samples, _, candidates = tables_of(tmp_path / "out")
    assert_same_rows(samples, before[0])
    assert candidates == before[2]


def test_redo_makes_a_walk_of_mixed_settings_anew(tmp_path: Path, begun: Callable[..., Path]) -> None:
    begun(rounds=1)
    changed = ToyWork(threshold=0.1)
    run(tmp_path / "out", changed, rounds=3, on_change="keep")
    assert run(tmp_path / "out", changed, rounds=3, on_change="redo").exit_code == COMPLETE
    run(tmp_path / "fresh", changed, rounds=3)
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")


def test_zero_inputs_and_double_ones_write_nothing(tmp_path: Path) -> None:
    double = execute(ToyWork(), refs(2) * 2, EXPERTS, 1, Store(tmp_path / "out"), "local")
    assert double.exit_code == BAD_CONFIG and refs(1)[0].clip_id in double.message
    assert run(tmp_path / "out", n=0).exit_code == BAD_CONFIG
    assert run(tmp_path / "out", rounds=0).exit_code == BAD_CONFIG
    assert not (tmp_path / "out").exists()


def test_a_stopped_run_goes_on_where_it_was(tmp_path: Path, plain: Callable[..., Path]) -> None:
    timer = threading.Timer(0.6, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    summary = run(tmp_path / "out", ToyWork(seconds=0.05))
    timer.join()
    assert summary.exit_code == INTERRUPTED
    assert run(tmp_path / "out").exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_nothing_new_begins_once_a_run_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a cluster, where tasks that were handed over end; in this process those that wait are left undone too."""
    local = execution.LocalGraph
    monkeypatch.setattr(execution, "LocalGraph", lambda work, out, stopped, fuse: local(work, out, never, fuse))

    class Stopping(ToyWork):
        def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> Driven | Dropped:
            if not Path(self.journal).read_text().count("attempt"):  # a second signal would end the run at once
                os.kill(os.getpid(), signal.SIGTERM)
            return super().drive(prepared, candidate, expert)

    journal = tmp_path / "journal"
    assert run(tmp_path / "out", Stopping(journal=str(journal))).exit_code == INTERRUPTED
    walks = re.findall(r"^attempt (\S+):-?\d+ on", journal.read_text(), re.M)  # log:start:expert
    assert walks and len(walks) == len(set(walks)), "what was in hand ends, and no walk tries once more"


def test_a_signal_reaches_a_block_that_is_being_built_in_this_process(tmp_path: Path) -> None:
    class Building(ToyWork):
        def reconstruct(self, ref: ClipRef, threads: int, stopped: Stopped = never) -> Built:
            if ref.log_id == "log0":
                return super().reconstruct(ref, threads)
            assert not stopped()
            os.kill(os.getpid(), signal.SIGTERM)
            end = time.monotonic() + 20.0
            while not stopped():
                assert time.monotonic() < end, "nobody told the task"
            raise Halted("half of it is done")

    stopped = run(tmp_path / "out", Building(blocks=True))
    assert stopped.exit_code == INTERRUPTED
    assert [note.split(";")[0] for note in stopped.notes] == ["block log1 is not finished"]
    committed = set(Store(tmp_path / "out").samples)
    assert committed, "what was in hand is finished and committed"
    run(tmp_path / "plain", ToyWork(blocks=True))
    assert run(tmp_path / "out", ToyWork(blocks=True)).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", tmp_path / "plain")


def test_a_run_that_is_overtaken_stops_and_loses_nothing(tmp_path: Path, plain: Callable[..., Path]) -> None:
    overtaken = Store(tmp_path / "out")

    class Overtaking(ToyWork):
        def warm(self) -> None:
            pass

        def drive(self, prepared, candidate, expert):  # type: ignore[no-untyped-def]
            if expert == "human" and prepared.payload["name"] == "log1:1000":
                run(tmp_path / "out")  # the same command, started a second time meanwhile
            return super().drive(prepared, candidate, expert)

    summary = execute(Overtaking(), refs(4), EXPERTS, 2, overtaken, "local", shard_seconds=0.0, say=lambda line: None)
    assert summary.exit_code == INTERRUPTED and "another run has taken over" in summary.message
    assert_same_tables(tmp_path / "out", plain())


def test_shards_close_by_size_and_commits_are_groups(tmp_path: Path, plain: Callable[..., Path]) -> None:
    run(tmp_path / "out", shard_bytes=1)
    many, one = Store(tmp_path / "out").samples, Store(plain()).samples
    assert len(many.live_files()) > len(one.live_files())
    assert len(one.live_files()) == 5  # partitions: two rounds of two experts, and human
    assert one.version == 3  # created, claimed, licences named, one group
    assert_same_tables(tmp_path / "out", plain())


def test_simulated_experts_after_the_log_s_own_drive_leave_what_one_run_leaves(
    tmp_path: Path, plain: Callable[..., Path]
) -> None:
    """A run of `human` alone lists no candidates; whoever comes after lists them, and says when the log was changed."""
    alone = ToyWork(prepare_digest=UNLISTED)
    assert run(tmp_path, alone, experts=["human"]).exit_code == COMPLETE
    again = run(tmp_path, alone, experts=["human"])
    assert (again.executed.prepared, again.executed.attempts) == (0, 0), "nothing is left of it"
    changed = run(tmp_path, ToyWork(content="another"))
    assert changed.exit_code == COMPLETE_WITH_FAILURES and changed.counts["failed"] == 4
    assert run(tmp_path, retry=True).exit_code == COMPLETE
    assert_same_tables(tmp_path, plain())
    journal = tmp_path / "journal"
    after = run(tmp_path, replace(alone, journal=str(journal)), experts=["human"])
    assert after.exit_code == COMPLETE and ran(journal, "prepare") == 0, "the lists stay"
    assert_same_tables(tmp_path, plain())
