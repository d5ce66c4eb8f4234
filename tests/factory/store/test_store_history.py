"""What a run reads of a store before it begins."""

import pickle
from pathlib import Path

from factory.execute import execute
from factory.store.candidates import Listed
from factory.store.samples import Store
from tests.factory.toy import ToyWork, refs


def test_of_candidate_lists_only_their_length_is_kept(tmp_path: Path) -> None:
    work = ToyWork(n_candidates=200, threshold=0.0)
    execute(work, refs(20), ["recovery"], 1, Store(tmp_path), "local", say=lambda line: None)
    listed = Store(tmp_path).history(work.identity, {}).candidates
    assert listed == {ref.clip_id: Listed("perturb-1", "content", 200) for ref in refs(20)}
    assert len(pickle.dumps(listed)) < 200 * len(listed)  # bytes; a list of 200 candidates takes 20 kB
