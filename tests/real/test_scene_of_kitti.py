"""A real street from KITTI's photos and lidar alone, written as a sidecar: no log, no map, no boxes."""

from pathlib import Path

import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.stages.scene_file import read_scene
from tests.bench.kitti import read_drive, steadied
from tests.bench.sidecars import write_kitti_sidecar

SMALL = "width=200 render.fit.iterations=400 render.fit.start_every=4 render.fit.start_gaussians=40000"
SMALL += " render.fit.most_gaussians=45000"


@pytest.mark.slow
def test_a_street_is_built_of_photos_and_sweeps_and_stands_where_the_drive_was(
    shared_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = steadied(read_drive(shared_root / "data" / "kitti_raw"))
    sidecar = write_kitti_sidecar(drive, tmp_path / "kitti")
    assert COMMANDS["scene"].load()(["build", str(sidecar), f"to={tmp_path / 'street'}", *SMALL.split()]) == 0
    said = capsys.readouterr().out
    assert "made of     108 photos of 1 cameras, 9 sweeps, in " in said
    street = read_scene(tmp_path / "street")
    assert street.n_held_out == 13 and street.psnr_db > 24.5  # 25.2
    assert street.block is not None
    places = drive.world_from_imu[:, :2, 3]
    np.testing.assert_allclose([street.block.low, street.block.high], [places.min(0), places.max(0)], atol=0.1)
    road = street.background.means[np.abs(street.background.means[:, :2] + street.origin[:2] - places[50]).max(1) < 2.0]
    assert np.median(road[:, 2] + street.origin[2]) == pytest.approx(drive.world_from_imu[50, 2, 3] - 0.93, abs=0.15)
