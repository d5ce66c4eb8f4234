"""A block is built once, before its clips, and nobody waits for another's."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.driver import BlockBuild, ClipQueue
from factory.graph.plan import ClipPlan
from factory.readers.base import ClipRef
from factory.store.samples import Store
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, executed, refs


def plans(logs: str) -> list[ClipPlan]:
    """A clip for each letter, which names its log."""
    return [ClipPlan(ClipRef("toy", log, 1000 * i), (), None, None, frozenset(), 0, None) for i, log in enumerate(logs)]


def handed_out(queue: ClipQueue, wanted: bool = True) -> list[str]:
    """What the queue gives until it has nothing for now: clips as log and second, blocks in brackets."""
    out = []
    while (what := queue.next(wanted)) is not None:
        out.append(
            f"[{what.block}]" if isinstance(what, BlockBuild) else f"{what.ref.log_id}{what.ref.start_ms // 1000}"
        )
    return out


def test_clips_wait_for_their_block_while_those_of_built_ones_go_on() -> None:
    queue = ClipQueue(plans("abaabc"), lambda ref: ref.log_id, workers=2)
    assert handed_out(queue) == ["[a]", "[b]"]
    queue.mark_built("b")
    assert handed_out(queue) == ["b1", "b4", "[c]"]
    queue.mark_built("a")
    queue.mark_built("c")
    assert handed_out(queue, wanted=False) == [] and queue
    assert handed_out(queue) == ["a0", "a2", "a3", "c5"] and not queue


def test_clips_without_a_block_wait_for_nothing() -> None:
    queue = ClipQueue(plans("aba"), lambda ref: None if ref.log_id == "a" else "b", workers=2)
    assert handed_out(queue) == ["a0", "[b]", "a2"]
    queue.mark_built("b")
    assert handed_out(queue) == ["b1"] and not queue


@pytest.mark.parametrize(("logs", "workers", "at_once"), [("aaa", 4, 1), ("abcd", 2, 2), ("aab", 8, 2)])
def test_as_many_are_built_at_once_as_there_are_blocks_and_workers(logs: str, workers: int, at_once: int) -> None:
    assert ClipQueue(plans(logs), lambda ref: ref.log_id, workers).at_once == at_once


def done(out: Path, work: ToyWork, rounds: int = 2, n: int = 4) -> int:
    experts: Sequence[str] = ["recovery", "human"]
    return executed(work, refs(n), experts, rounds, Store(out)).exit_code


def test_a_run_builds_every_block_once_and_first(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    assert done(tmp_path / "blocks", ToyWork(blocks=True, journal=str(journal))) == COMPLETE
    lines = journal.read_text().splitlines()
    for log in ("log0", "log1"):
        assert lines.count(f"reconstruct {log}") == 1
        first = min(i for i, line in enumerate(lines) if line.startswith(f"prepare {log}"))
        assert lines.index(f"reconstruct {log}") < first
    assert done(tmp_path / "none", ToyWork()) == COMPLETE
    assert_same_tables(tmp_path / "blocks", tmp_path / "none")

    assert done(tmp_path / "blocks", ToyWork(blocks=True, journal=str(journal))) == COMPLETE
    assert journal.read_text().splitlines()[len(lines) :] in ([], ["warm"]), "nothing to prepare, nothing to build"


def test_a_block_that_fails_keeps_no_clip_of_another_from_its_samples(tmp_path: Path) -> None:
    work = ToyWork(blocks=True, trouble={"log0": "bad", "log0:0": "bad", "log0:2000": "bad"})
    assert done(tmp_path / "out", work) == COMPLETE_WITH_FAILURES
    sound = ToyWork(trouble={"log0:0": "bad", "log0:2000": "bad"})
    assert done(tmp_path / "none", sound) == COMPLETE_WITH_FAILURES
    assert_same_tables(tmp_path / "out", tmp_path / "none")
