"""A training from MCAP shards sees the batches of one from Parquet, to the byte."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.store.location import Location
from factory.store.mcap_files import McapTable, write_mcap_shard
from factory.store.samples import Store
from planners.data.batch import BevLayout, Needs
from planners.data.files import files_of
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.planners.data.test_loader import BATCH, PICTURE, assert_same, rows, windows
from tests.planners.samples import write_table

__all__ = ["windows"]

NEEDS = Needs(image=PICTURE, bev=BevLayout(), labels="vocabulary-1")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A table in several shards and row groups, in both forms."""
    path = tmp_path_factory.mktemp("mcap") / "out"
    seen = {"agent_kinds": ["VEHICLE"] * 3, "agent_boxes": np.ones((3, 56, 5), np.float32)}
    found = [row | seen for row in rows()]
    write_table(path, found, shard_rows=10, group_rows=4)
    location, store = Location.parse(path), Store(path)
    table = McapTable(location)
    table.claim()
    live = store.samples.live_files()
    table.keep_up(store.samples, [write_mcap_shard(location, name, part) for name, part in live.items()])
    return str(path)


def loader(out: str, form: Any, **options: Any) -> Loader:
    settings = DataSettings(real=out, sim=out, format=form, **options.pop("data", {}))
    return Loader(open_data(settings), NEEDS, MixSettings(sim_ratio=options.pop("ratio", "natural")), BATCH, **options)


@pytest.mark.usefixtures("windows")
def test_batches_are_the_same_from_either_form(out: str, ratio: float = 0.3) -> None:
    for epoch in (0, 1):
        expected = list(loader(out, "parquet", ratio=ratio).epoch(epoch))
        for workers in (0, 2):
            found = loader(out, "mcap", ratio=ratio, workers=workers).epoch(epoch)
            for a, b in zip(expected, found, strict=True):
                assert_same(a, b)


def test_what_the_loader_plans_by_is_the_same(out: str) -> None:
    parquet, mcap = loader(out, "parquet"), loader(out, "mcap")
    assert parquet.dataset.digest == mcap.dataset.digest
    assert (parquet._feed.size == mcap._feed.size).all() and parquet._digest == mcap._digest
    names = [[Path(file.path).name[:37] for file in files_of(out, format=form)] for form in ("parquet", "mcap")]  # type: ignore[arg-type]
    assert names[0] == names[1]


def test_a_damaged_mcap_shard_is_refused_by_name(out: str) -> None:
    path = min(Path(out, "samples_mcap").rglob("*.mcap"))
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(OSError, match=path.name):
            list(loader(out, "mcap").epoch(0))
    finally:
        path.write_bytes(whole)
