"""What was planned adds up from the tables alone, whatever happened to a run."""

from dataclasses import replace
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.store.funnel import funnel_of
from factory.store.samples import Store
from tasks.stages import ATTEMPT
from tests.factory.graph.balanced import balance, counts
from tests.factory.graph.runs import EXPERTS, run
from tests.factory.toy import ToyWork, refs

TROUBLED = ToyWork(
    trouble={
        "log0:0": "standing",
        "log1:1000": "bad",
        "log0:2000": "no_candidates",
        "log1:3000:recovery:1": "bug",
    }
)


def test_what_fails_and_falls_adds_up_and_a_retry_moves_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(out, TROUBLED, n=6).exit_code == COMPLETE_WITH_FAILURES
    found = balance(out)
    assert [counts(one) for one in found.stages[:2]] == [(6, 4, 1, 1, 0), (4, 3, 1, 0, 0)]
    human = {one.stage: counts(one) for one in found.stages if one.expert == "human"}
    assert human["write"] == (6, 4, 1, 1, 0)
    assert all(human[task] == (4, 4, 0, 0, 0) for task in ATTEMPT), "the log's own drive passes every task too"
    assert found.samples["planned"] == 6 * (2 + 2 + 1) and found.samples["pending"] == 0
    assert found.samples["failed"] == 5 + 2  # all of the clip's, and the walk's from its first round on
    healed = replace(TROUBLED, trouble={"log0:0": "standing", "log0:2000": "no_candidates"})
    assert run(out, healed, n=6, retry=True).exit_code == COMPLETE
    assert balance(out).samples["failed"] == 0 and balance(out).samples["pending"] == 0


def test_every_attempt_counts_at_the_task_that_it_ended_in(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out, ToyWork(threshold=0.0), n=4, experts=["recovery"], rounds=2)
    names = [f"{ref.log_id}:{ref.start_ms}:recovery:0" for ref in refs(4)]
    faults = {"": "bug", ":render": "unfit", ":label": "bug"}
    trouble = {name + task: fault for name, (task, fault) in zip(names, faults.items())}
    trouble[f"{names[3]}:render"] = "bug"
    troubled = tmp_path / "troubled"
    run(troubled, ToyWork(threshold=0.0, trouble=trouble), n=4, experts=["recovery"], rounds=2)
    assert [counts(one) for one in balance(out).stages if one.stage in ATTEMPT] == [(8, 8, 0, 0, 0)] * 3
    found = {one.stage: counts(one) for one in balance(troubled).stages if one.stage in ATTEMPT}
    # The second clip goes on after its rejected picture; the others stand at their first attempts.
    assert found == {"drive": (6, 5, 0, 1, 0), "render": (5, 3, 1, 1, 0), "label": (3, 2, 0, 1, 0)}
    failed = [row for row in Store(troubled).outcomes.read().to_pylist() if row["kind"] == "failed"]
    assert sorted(row["stage"] for row in failed) == ["drive", "label", "render"]


def test_a_clip_that_is_poison_stays_failed(tmp_path: Path) -> None:
    out, work = tmp_path / "out", ToyWork(trouble={"log0:0": "disk"})
    for _ in range(4):
        assert run(out, work).exit_code == COMPLETE_WITH_FAILURES
        assert counts(balance(out).stages[0]) == (4, 3, 0, 1, 0)
    assert Store(out).outcomes.read(["error_kind"])["error_kind"].to_pylist().count("poison") == 1


@pytest.mark.parametrize("minutes", [0.0, 0.003])
def test_what_a_stopped_run_left_is_pending(tmp_path: Path, minutes: float) -> None:
    out = tmp_path / "out"
    assert run(out, ToyWork(seconds=0.01), minutes=minutes).exit_code == INTERRUPTED
    found = balance(out)
    assert found.samples["planned"] == 4 * (2 + 2 + 1) and found.samples["pending"] > 0
    assert run(out, ToyWork()).exit_code == COMPLETE
    assert balance(out).samples["pending"] == 0


def test_plans_grow_and_are_written_once(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for rounds, n, experts, plans in ((2, 3, EXPERTS, 1), (2, 3, EXPERTS, 1), (1, 4, ["recovery"], 2)):
        run(out, rounds=rounds, n=n, experts=experts)
        assert len(Store(out).plans) == plans
    planned = {(one.expert, one.round): one.planned for one in balance(out).stages if one.stage == "write"}
    assert planned == {
        ("recovery", 0): 4,
        ("recovery", 1): 3,
        ("pdm_closed", 0): 3,
        ("pdm_closed", 1): 3,
        ("human", 0): 3,
    }
    some = funnel_of(Store(out), [refs(4)[3].clip_id]).balance
    clip = [(one.stage, one.expert) for one in some.stages if one.planned == 1 and one.stage not in ATTEMPT]
    assert clip == [("clip", ""), ("perturb", ""), ("write", "recovery")] and some.samples["planned"] == 1


def test_settings_that_made_nothing_leave_no_plan(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out, ToyWork(threshold=1.0), n=5, experts=["recovery"])
    run(out, ToyWork(threshold=0.5), n=2, experts=["recovery"])
    assert balance(out).stages[0].planned == 2
