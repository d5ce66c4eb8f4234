"""The same rows on real clips from this process and from Ray workers."""

from pathlib import Path

import pytest

from factory.config.run import load_config
from factory.exits import COMPLETE
from factory.graph.execute import Execution, execute
from factory.setup.settings import assemble
from factory.store.samples import Store
from tests.factory.tables import assert_same_tables


@pytest.mark.ray
@pytest.mark.slow
def test_local_and_ray_make_the_same_rows_of_real_clips(shared_root: Path, tmp_path: Path) -> None:
    overrides = ["clips=av2", f"clips.root={shared_root / 'data/av2/sensor/val'}", "vocabulary.k=400"]
    outs = {}
    for executor in ("local", "ray"):
        outs[executor] = tmp_path / executor
        run = assemble(load_config([*overrides, f"out={outs[executor]}", "experts=[pdm_closed,human]"]))
        store = Store(outs[executor])
        summary = execute(
            run.work, run.index.refs[:2], run.config.experts, 2, store, Execution(executor, 2), say=lambda line: None
        )
        assert summary.exit_code == COMPLETE and summary.counts["accepted"] >= 4
    assert_same_tables(outs["local"], outs["ray"])
