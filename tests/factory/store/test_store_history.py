"""What a run reads of a store before it begins."""

import pickle
from pathlib import Path

import pytest

from factory.store.samples import CandidateSummary, Kind, OnChange, Outcome, Store
from tests.factory.toy import ToyWork, executed, refs


def test_of_candidate_lists_only_their_length_is_kept(tmp_path: Path) -> None:
    work = ToyWork(n_candidates=200, threshold=0.0)
    executed(work, refs(20), ["recovery"], 1, Store(tmp_path))
    listed = Store(tmp_path).history(work.identity, {}).candidates
    assert listed == {ref.clip_id: CandidateSummary("perturb-1", "content", 200) for ref in refs(20)}
    assert len(pickle.dumps(listed)) < 200 * len(listed)  # bytes; a list of 200 candidates takes 20 kB


@pytest.mark.parametrize(("threshold", "on_change", "stays"), [(0.0, "stop", 0), (0.1, "keep", 1)])
def test_a_failure_beside_its_sample_goes_unless_it_is_newer(
    tmp_path: Path, threshold: float, on_change: OnChange, stays: int
) -> None:
    first, later = ToyWork(threshold=0.0), ToyWork(threshold=threshold)
    executed(first, refs(1), ["recovery"], 1, Store(tmp_path))
    store = Store(tmp_path)
    store.begin_run(store.checked_records(later.identity, {"recovery": "recovery-1"}, on_change))
    (sample,) = store.samples.read(["attempt_id", "clip_id"]).to_pylist()
    made = later.identity.settings_hash, later.identity.versions_json
    key, clip_id = sample["attempt_id"], sample["clip_id"]
    failed = Outcome(key, clip_id, "toy", "log0", "recovery", "recovery-1", 0, Kind.FAILED, *made)
    store.commit([], [], [failed])
    store.begin_run(store.runs())
    assert (len(store.samples), len(store.outcomes)) == (1, stays)
