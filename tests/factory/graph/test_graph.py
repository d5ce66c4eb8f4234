"""A run in the local executor: resume, nested rounds, failures, ends; the store is real."""

import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import pytest

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.graph import execute as execution
from factory.graph.execute import Execution, execute
from factory.graph.steps import (
    AcceptedDrive,
    BlockReport,
    PreparedClip,
    RejectedAttempt,
    StopCheck,
    TaskStopped,
    never_stop,
)
from factory.readers.base import ClipRef
from factory.store.location import BadCacheFile
from factory.store.samples import Store
from factory.store.schema import UNLISTED
from factory.store.verify import verify
from tests.factory.graph.runs import EXPERTS, run
from tests.factory.tables import assert_same_tables, tables_of
from tests.factory.toy import ToyWork, executed, ran, refs


def test_when_minutes_are_up_nothing_new_begins_and_the_same_command_goes_on(
    plain: Callable[..., Path], tmp_path: Path
) -> None:
    cut = run(tmp_path / "out", minutes=0.0)
    assert cut.exit_code == INTERRUPTED and "run the same command again" in cut.message
    assert run(tmp_path / "out", minutes=60.0).exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", plain())


def test_the_same_command_again_executes_nothing(tmp_path: Path) -> None:
    journal = str(tmp_path / "journal")
    first = run(tmp_path / "out", ToyWork(journal=journal), rounds=5)
    tasks = ran(journal, "")
    second = run(tmp_path / "out", ToyWork(journal=journal), rounds=5)
    assert first.exit_code == second.exit_code == COMPLETE
    assert ran(journal, "") == tasks and second.executed.attempts == 0
    assert second.executed.found_done == first.executed.attempts
    assert second.counts == first.counts
    samples, outcomes, _ = tables_of(tmp_path / "out")
    keys = samples["attempt_id"].to_pylist() + [o["attempt_id"] for o in outcomes]  # type: ignore[index]
    assert len(keys) == len(set(keys)) == sum(first.counts.values()), "one row in one table for every attempt"
    assert verify(Store(tmp_path / "out")).damage == ()


def test_a_prepared_clip_under_another_s_name_is_named_and_prepared_again(
    tmp_path: Path, begun: Callable[..., Path], plain: Callable[..., Path]
) -> None:
    begun(rounds=1)
    paths = sorted((tmp_path / "out/cache/prepared").iterdir())
    whole, cache = [path.read_bytes() for path in paths], Store(tmp_path / "out").cache
    assert len(paths) == 4 and verify(Store(tmp_path / "out")).damage == ()
    for one, other in permutations(range(4), 2):
        paths[one].write_bytes(whole[other])
        with pytest.raises(BadCacheFile, match="under this name"):
            cache.load(paths[one].stem)
        paths[one].write_bytes(whole[one])
        assert cache.load(paths[one].stem) is not None
    paths[0].write_bytes(whole[1])
    paths[1].write_bytes(whole[0])
    damage = verify(Store(tmp_path / "out")).damage
    assert [line.partition(": ")[0] for line in damage] == [f"cache/prepared/{path.name}" for path in paths[:2]]
    later = run(tmp_path / "out", rounds=3)
    assert later.executed.prepared == 2 and sum("prepared again" in note for note in later.notes) == 2
    assert verify(Store(tmp_path / "out")).damage == () and [path.read_bytes() for path in paths] == whole
    assert_same_tables(tmp_path / "out", plain(rounds=3))


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_zero_inputs_and_double_ones_write_nothing(tmp_path: Path) -> None:
    double = execute(ToyWork(), refs(2) * 2, EXPERTS, 1, Store(tmp_path / "out"), Execution("local"))
    assert double.exit_code == BAD_CONFIG and refs(1)[0].clip_id in double.message
    assert run(tmp_path / "out", n=0).exit_code == BAD_CONFIG
    assert run(tmp_path / "out", rounds=0).exit_code == BAD_CONFIG
    assert not (tmp_path / "out").exists()


def test_nothing_new_begins_once_a_run_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a cluster, where tasks that were handed over end; in this process those that wait are left undone too."""
    local = execution.LocalGraph
    monkeypatch.setattr(execution, "LocalGraph", lambda work, out, stopped: local(work, out, never_stop))

    class Stopping(ToyWork):
        def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
            if not Path(self.journal).read_text().count("attempt"):  # a second signal would end the run at once
                os.kill(os.getpid(), signal.SIGTERM)
            return super().drive(prepared, candidate, expert)

    journal = tmp_path / "journal"
    assert run(tmp_path / "out", Stopping(journal=str(journal))).exit_code == INTERRUPTED
    walks = re.findall(r"^attempt (\S+):-?\d+ on", journal.read_text(), re.M)  # log:start:expert
    assert walks and len(walks) == len(set(walks)), "what was in hand ends, and no walk tries once more"


@pytest.mark.slow
def test_a_signal_reaches_a_block_that_is_being_built_in_this_process(tmp_path: Path) -> None:
    class Building(ToyWork):
        def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
            if ref.log_id == "log0":
                return super().reconstruct(ref, threads)
            assert not stopped()
            os.kill(os.getpid(), signal.SIGTERM)
            end = time.monotonic() + 20.0
            while not stopped():
                assert time.monotonic() < end, "nobody told the task"
            raise TaskStopped("half of it is done")

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

    summary = executed(Overtaking(), refs(4), EXPERTS, 2, overtaken, Execution("local", shard_seconds=0.0))
    assert summary.exit_code == INTERRUPTED and "another run has taken over" in summary.message
    assert_same_tables(tmp_path / "out", plain())


@pytest.mark.slow
def test_shards_close_by_size_and_commits_are_groups(tmp_path: Path, plain: Callable[..., Path]) -> None:
    run(tmp_path / "out", shard_bytes=1)
    many, one = Store(tmp_path / "out").samples, Store(plain()).samples
    assert len(many.live_files()) > len(one.live_files())
    assert len(one.live_files()) == 5  # partitions: two rounds of two experts, and human
    assert one.version == 3  # created, claimed, licences named, one group
    assert_same_tables(tmp_path / "out", plain())


def test_the_first_rows_are_in_the_table_long_before_a_batch_is_old(tmp_path: Path) -> None:
    class Slow(ToyWork):
        def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
            time.sleep(0.02)
            return super().drive(prepared, candidate, expert)

    run(tmp_path / "out", Slow(), shard_seconds=1.5)
    assert Store(tmp_path / "out").samples.version >= 4, "a group after a tenth of a second, and one at the end"


@pytest.mark.slow
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
