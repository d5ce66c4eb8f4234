"""What is learnt beside planning is the public target builder's, cell by cell (see the record's origin).

`python -m experiments.parity <public checkout> --python <its interpreter> --what targets --record
tests/planners/published/recorded` writes it anew.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from planners.data.bev import BevClass, bev_raster, nearest_vehicles
from tests.planners.published.targets import PUBLIC, differences_in_targets, street_sample

RECORD = Path(__file__).parent / "recorded" / "targets.npz"


def test_the_map_from_above_and_the_vehicles_are_the_public_builder_s() -> None:
    origin, rows = differences_in_targets(RECORD)
    assert "SimScale commit f51ad645" in origin
    assert [row for row in rows if not row.is_within(1e-4)] == []


def test_as_ours_are_drawn_they_are_others() -> None:
    with np.load(RECORD, allow_pickle=False) as stored:
        bev, there = stored["bev"], stored["there"]
    ours = replace(PUBLIC, public=False)
    assert (bev_raster(street_sample(), ours)[0, ::-1, ::-1] != bev).mean() > 0.05
    assert not (bev == BevClass.CROSSING).any() and there.all()
    assert nearest_vehicles(street_sample(), ours, len(there))[1].sum() < len(there)
