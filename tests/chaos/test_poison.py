"""Experts that do harm in a run on Ray; on this machine alone: tests/factory/graph/test_isolated.py."""

import re
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.execute import Execution, RunSummary, execute
from factory.graph.local import Limits
from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.graph.wild import WildWork
from tests.factory.toy import refs

LIMITS = Limits(seconds={"drive": 10.0, "render": 0.0, "label": 0.0})
HOW = {  # kind -> what is told of it, and a pattern in the message
    "compiled loop": ("limit", "at work for more than"),
    "segfault": ("system", r"at drive\+render\+label|worker died"),
    "sys.exit": ("bug", "SystemExit"),
    "mutate": ("bug", "read-only"),
}


def run(out: Path, work: WildWork, executor: str) -> RunSummary:
    how = Execution(executor, 2, isolated=True, limits=LIMITS)  # type: ignore[arg-type]
    return execute(work, refs(8), ["human"], 1, Store(out), how, say=str)


@pytest.mark.chaos
@pytest.mark.ray
@pytest.mark.slow
def test_experts_that_do_harm_are_told_of_and_touch_no_other(tmp_path: Path) -> None:
    clips = dict(zip(HOW, refs(8)))
    wild = tuple((f"{clip.log_id}:{clip.start_ms}:human:-1", kind) for kind, clip in clips.items())
    assert run(tmp_path / "out", WildWork(wild=wild), "ray").exit_code == COMPLETE_WITH_FAILURES
    assert run(tmp_path / "clean", WildWork(), "local").exit_code == COMPLETE
    harmed = {clip.clip_id for clip in clips.values()}
    found, clean = (
        {row["clip_id"]: repr(row) for row in Store(tmp_path / name).samples.read().to_pylist()}
        for name in ("out", "clean")
    )
    assert found == {clip: row for clip, row in clean.items() if clip not in harmed} and len(found) == 4
    failed = {
        row["clip_id"]: row for row in Store(tmp_path / "out").outcomes.read().to_pylist() if row["kind"] == "failed"
    }
    assert set(failed) == harmed
    for kind, (reason, word) in HOW.items():
        row = failed[clips[kind].clip_id]
        assert row["error_kind"] == reason and re.search(word, row["error"]), (kind, row)
    assert verify(Store(tmp_path / "out")).damage == ()
