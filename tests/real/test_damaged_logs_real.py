"""A few of the damaged logs of tests.chaos.damaged_logs."""

from pathlib import Path

import pytest

from tests.chaos.damaged_logs.__main__ import data_sets
from tests.chaos.damaged_logs.comparison import damaged
from tests.chaos.damaged_logs.damages import ALL, INJECTIONS

SEEDS = {"av2": (3, 8), "nuscenes": (2, 5), "navsim": (0, 1)}


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEDS)
def test_damage_stays_where_it_is_and_is_told(name: str, shared_root: Path, tmp_path: Path) -> None:
    ((_, data),) = data_sets(shared_root, tmp_path, [name], to_export=1)
    said = list[str]()
    table = damaged(data, SEEDS[name], said.append)
    assert not said, "\n".join(said)
    assert table.keys() <= {ALL, *INJECTIONS} and table[ALL].damages > len(SEEDS[name])
    assert all(told.is_fine for told in table.values()) and table[ALL].repaired
