"""Settings that made no sample may be corrected without on_change; what one sample stands on may not."""

from pathlib import Path

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.execute import RunSummary
from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, executed, refs

BROKEN = {f"{ref.log_id}:{ref.start_ms}": "bug" for ref in refs(4)}


def run(work: ToyWork, out: Path, n_clips: int = 4) -> RunSummary:
    return executed(work, refs(n_clips), ["recovery"], 1, Store(out))


def test_a_run_without_a_sample_takes_corrected_settings_as_a_fresh_one_does(tmp_path: Path) -> None:
    failed = run(ToyWork(threshold=0.9, prepare_digest="other", trouble=BROKEN), tmp_path / "out")
    assert failed.exit_code == COMPLETE_WITH_FAILURES and not len(Store(tmp_path / "out").samples)
    none_good_enough = run(ToyWork(threshold=1.1), tmp_path / "out", n_clips=2)
    assert none_good_enough.exit_code == COMPLETE and len(Store(tmp_path / "out").outcomes)
    assert run(ToyWork(), tmp_path / "out").exit_code == COMPLETE
    assert run(ToyWork(), tmp_path / "fresh").exit_code == COMPLETE
    assert_same_tables(tmp_path / "out", tmp_path / "fresh")
    assert Store(tmp_path / "out").runs() == Store(tmp_path / "fresh").runs()
    assert verify(Store(tmp_path / "out")).damage == ()


def test_the_same_settings_keep_what_they_rejected(tmp_path: Path) -> None:
    run(ToyWork(threshold=1.1), tmp_path)
    again = run(ToyWork(threshold=1.1), tmp_path)
    assert again.executed.attempts == 0 and again.executed.found_done > 0


def test_one_sample_pins_the_settings(tmp_path: Path) -> None:
    assert run(ToyWork(threshold=0.0), tmp_path, n_clips=1).exit_code == COMPLETE
    refused = run(ToyWork(threshold=0.5), tmp_path)
    assert refused.exit_code == BAD_CONFIG and "reward.threshold: 0.0 -> 0.5" in refused.message
