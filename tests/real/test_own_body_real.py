"""What the cameras of a nuPlan rig see of their own car: by eye a strip of the flanks, a fender, a post."""

from pathlib import Path

import pytest

from factory.stages.sensors import own_body_masks
from tasks.world.clip import SensorFile
from tests.bench.sidecars import read_openscene

# Pixels (x, y as shares of the picture) that show the car, and the street close by.
ON_THE_CAR = {
    "CAM_L0": [(0.05, 0.97), (0.3, 0.985), (0.72, 0.96)],
    "CAM_R0": [(0.95, 0.985), (0.28, 0.96)],
    "CAM_L2": [(0.03, 0.98)],
    "CAM_R2": [(0.97, 0.98)],
    "CAM_F0": [(0.01, 0.97)],
}
WITHOUT = {"CAM_L1", "CAM_B0"}
MOST = 0.05  # of any picture


@pytest.mark.slow
def test_the_own_car_is_found_and_nothing_of_the_street(shared_root: Path) -> None:
    drive = read_openscene(shared_root / "data" / "openscene_0101")
    found = own_body_masks("", drive.block.images, drive.cameras)
    for name, places in ON_THE_CAR.items():
        height, width = found[name].shape
        assert all(found[name][int(y * height), int(x * width)] for x, y in places), name
    assert not WITHOUT & found.keys()
    for mask in found.values():
        assert mask.mean() <= MOST and not mask[: mask.shape[0] // 2].any()


@pytest.mark.slow
def test_of_a_rig_that_stands_nothing_is_masked(shared_root: Path) -> None:
    """All keeps its place in each of its photos."""
    drive = read_openscene(shared_root / "data" / "openscene_0101")
    cameras, files = drive.cameras, drive.block.images
    standing = [SensorFile(file.sensor, file.uri, file.time_s, files[0].world_from_ego) for file in files[:16]]
    assert own_body_masks("", standing, cameras[:1]) == {}
