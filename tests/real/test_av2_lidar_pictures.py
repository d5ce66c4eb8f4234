"""The Argoverse 2 log without photographs: nine cameras drawn from two lidar sweeps, as bright as their returns."""

from pathlib import Path

import numpy as np
import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.stages.assets import Sensing, asset_for, sensing
from factory.stages.sensors import block_of, load_sweeps
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.build import grey_of
from tasks.render.scene.engine import render, vehicles_at
from tasks.render.scene.sensed import Sweep, on_ego
from tasks.render.settings import RenderSettings
from tasks.world.clip import Camera, Clip, Pinhole

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
SETTINGS = RenderSettings()


@pytest.fixture(scope="module")
def clip(shared_root: Path) -> Clip:
    reader = AV2Reader(shared_root / "data" / "av2" / "sensor" / "val" / LOG)
    clips = (reader.read(ref) for ref in reader.index().refs)
    return next(clip for clip in clips if block_of(clip).sweeps)


@pytest.fixture(scope="module")
def asset(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> RenderAsset:
    made = asset_for(clip, SETTINGS, tmp_path_factory.mktemp("cache"))
    assert made is not None
    return made


def eye_of(camera: Camera, sweep: Sweep) -> Pinhole:
    small = camera.resized(SETTINGS.width, SETTINGS.height)
    return Pinhole(small.intrinsics, sweep.world_from_ego @ small.ego_from_camera, small.width, small.height)


def test_all_nine_cameras_show_the_street_as_bright_as_its_returns(clip: Clip, asset: RenderAsset) -> None:
    assert sensing(clip, SETTINGS) is Sensing.LIDAR_ONLY and len(clip.cameras) == 9
    sweep = load_sweeps(block_of(clip).sweeps, with_intensity=True)[0]
    assert sweep.intensity is not None
    there = vehicles_at(block_of(clip).agents, sweep.time_s)
    views = render(asset, [eye_of(camera, sweep) for camera in clip.cameras], there)
    keep = ~on_ego(sweep.points)
    points, grey = sweep.points[keep], grey_of(sweep.intensity[keep])[:, 0]
    for camera, view in zip(clip.cameras, views):
        small = camera.resized(SETTINGS.width, SETTINGS.height)
        local = (points - small.ego_from_camera[:3, 3]) @ small.ego_from_camera[:3, :3]
        u, v, z = (local @ small.intrinsics.T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / z, v / z
        inside = np.flatnonzero((z > 1.0) & (u > 0) & (u < small.width) & (v > 0) & (v < small.height))
        rows, columns = v[inside].astype(int), u[inside].astype(int)
        shown = np.abs(view.depth[rows, columns] - z[inside]) < 0.3 + 0.05 * z[inside]  # not behind something
        assert shown.sum() > 5000, camera.name
        alike = np.corrcoef(view.rgb[rows, columns, 0][shown], grey[inside][shown])[0, 1]
        assert alike > 0.45, f"{camera.name}: {alike:.2f}"  # 0.51 (rear left) to 0.92
        assert view.alpha[view.alpha.shape[0] // 2 :].mean() > 0.3, camera.name
        assert view.rgb.min() > 0.05 and view.rgb.std() > 0.1, camera.name
