"""What was planned adds up from the tables alone, whatever happened to a run."""

from dataclasses import replace
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED
from factory.store.counts.funnel import funnel_of
from factory.store.samples import Store
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
    human = next(one for one in found.stages if one.expert == "human")
    assert counts(human) == (6, 4, 1, 1, 0)
    assert found.samples["planned"] == 6 * (2 + 2 + 1) and found.samples["pending"] == found.walks_pending == 0
    assert found.samples["failed"] == 5 + 2  # all of the clip's, and the walk's from its first round on
    healed = replace(TROUBLED, trouble={"log0:0": "standing", "log0:2000": "no_candidates"})
    assert run(out, healed, n=6, retry=True).exit_code == COMPLETE
    assert balance(out).samples["failed"] == 0 and balance(out).samples["pending"] == 0


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
    assert found.samples["planned"] == 4 * (2 + 2 + 1) and found.samples["pending"] > 0 and found.walks_pending > 0
    assert run(out, ToyWork()).exit_code == COMPLETE
    assert balance(out).samples["pending"] == balance(out).walks_pending == 0


def test_plans_grow_and_are_written_once(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for rounds, n, experts, plans in ((2, 3, EXPERTS, 1), (2, 3, EXPERTS, 1), (1, 4, ["recovery"], 2)):
        run(out, rounds=rounds, n=n, experts=experts)
        assert len(Store(out).plans) == plans
    planned = {(one.expert, one.round): one.planned for one in balance(out).stages if one.expert}
    assert planned == {
        ("recovery", 0): 4,
        ("recovery", 1): 3,
        ("pdm_closed", 0): 3,
        ("pdm_closed", 1): 3,
        ("human", 0): 3,
    }
    some = funnel_of(Store(out), [refs(4)[3].clip_id]).balance
    assert [(one.expert, one.planned) for one in some.stages if one.planned] == [("", 1), ("", 1), ("recovery", 1)]


def test_settings_that_made_nothing_leave_no_plan(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out, ToyWork(threshold=1.0), n=5, experts=["recovery"])
    run(out, ToyWork(threshold=0.5), n=2, experts=["recovery"])
    assert balance(out).stages[0].planned == 2
