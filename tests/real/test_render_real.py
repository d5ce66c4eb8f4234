"""The render room on KITTI raw drive 2011_09_26_0001: held-out photos of a real street."""

from pathlib import Path

import pytest

from tasks.render.scene.build import AssetSettings, build_asset
from tests.bench.kitti import read_drive


@pytest.mark.slow
def test_held_out_photos_of_a_real_street_are_recognised(shared_root: Path) -> None:
    """Every second frame of the left colour camera; all sweeps there are."""
    drive = read_drive(shared_root / "data" / "kitti_raw")
    asset = build_asset(drive.photos("image_02", range(20, 52, 2)), drive.sweeps(), None, AssetSettings())
    assert asset.n_held_out == 2  # of 16, each 2.2 m of driving from its neighbours
    assert asset.psnr_db > 18.5  # 19.3 as measured
