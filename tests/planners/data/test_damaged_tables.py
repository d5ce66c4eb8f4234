"""A training refuses a damaged shard with its name, or what it reads of it is what was written."""

from pathlib import Path

from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tests.factory.damage import damaged
from tests.planners.data.test_loader import BATCH, NEEDS, assert_same, rows
from tests.planners.samples import write_table


def test_a_damaged_shard_is_refused_by_name(tmp_path: Path) -> None:
    write_table(tmp_path / "out", rows(BATCH, 0))
    (path,) = (tmp_path / "out").rglob("*.parquet")

    def batch() -> object:
        return next(Loader(open_data(DataSettings(real=str(tmp_path / "out"))), NEEDS, MixSettings(), BATCH).epoch(0))

    whole, expected, refused = path.read_bytes(), batch(), 0
    for content in damaged(whole, every=len(whole) // 40):
        path.unlink()
        path.write_bytes(content)
        try:
            assert_same(batch(), expected)  # type: ignore[arg-type]
        except OSError as error:
            assert path.name in str(error), error
            refused += 1
    assert refused >= 20
