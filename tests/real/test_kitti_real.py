"""KITTI raw drive 2011_09_26_0001 is read as its repacker says it is."""

import json
from pathlib import Path

import numpy as np

from tests.bench.kitti import read_drive

FRAMES = [0, 50, 107]


def test_photos_stand_where_the_reference_cameras_do(shared_root: Path) -> None:
    root = shared_root / "data" / "kitti_raw"
    derived = json.loads((root / "2011_09_26" / "derived" / "cameras.json").read_text())
    expected = {(view["camera"], view["frame"]): np.array(view["c2w"]) for view in derived["frames"]}
    drive = read_drive(root)
    for camera in ("image_02", "image_03"):
        for frame, photo in zip(FRAMES, drive.photos(camera, FRAMES)):
            np.testing.assert_allclose(photo.world_from_camera, expected[camera, frame], atol=1e-6)
            assert photo.rgb.shape == (120, 397, 3)
            np.testing.assert_allclose(photo.intrinsics[[0, 1], [0, 1]], [230.636, 230.892], atol=1e-3)


def test_sweeps_lie_on_the_fused_cloud(shared_root: Path) -> None:
    drive = read_drive(shared_root / "data" / "kitti_raw")
    sweeps, (fused,) = drive.sweeps(), drive.fused()
    assert [round(s.time_s / 0.1035) for s in sweeps] == list(range(0, 108, 12))
    occupied = {tuple(cell) for cell in np.floor(fused.points / 0.3).astype(int)}
    points = sweeps[4].points[::50] @ sweeps[4].world_from_ego[:3, :3].T + sweeps[4].world_from_ego[:3, 3]
    near = [tuple(cell) in occupied for cell in np.floor(points / 0.3).astype(int)]
    assert np.mean(near) > 0.8
