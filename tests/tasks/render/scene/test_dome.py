"""The sky as Gaussians: what a picture shows of it is what the map shows."""

from dataclasses import replace

import numpy as np

from tasks.render.scene.asset import RenderAsset, psnr
from tasks.render.scene.dome import sky_gaussians
from tasks.render.scene.engine import render
from tasks.render.scene.sky import COLUMNS, ROWS, SkyMap
from tasks.render.splatting.gaussians import EMPTY
from tasks.render.splatting.project import CLASSIC
from tasks.world.clip import Pinhole

K = np.array([[60.0, 0.0, 64.0], [0.0, 60.0, 40.0], [0.0, 0.0, 1.0]])


def test_a_dome_looks_like_its_sky_all_around_and_up() -> None:
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, COLUMNS), np.linspace(np.pi / 2, -np.pi / 2, ROWS))
    waves = (np.sin(azimuth), np.cos(2.0 * azimuth) * np.cos(elevation), np.sin(2.0 * elevation))
    sky = SkyMap(np.stack([0.5 + 0.3 * wave for wave in waves], axis=-1).astype(np.float32))
    ours = RenderAsset(np.zeros(3), EMPTY, {}, sky, float("nan"))
    black = SkyMap(np.zeros((ROWS, COLUMNS, 3), np.float32))
    dome = replace(ours, background=sky_gaussians(sky, np.array([10.0, 5.0, 0.0])), sky=black, screen=CLASSIC)
    for yaw, up in ((0.0, 0.0), (1.5, 0.4), (3.1, 0.2), (-2.0, 1.5)):
        pose = np.eye(4)
        ahead = np.array([np.cos(up) * np.cos(yaw), np.cos(up) * np.sin(yaw), np.sin(up)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        first, second = (render(asset, [Pinhole(K, pose, 128, 80)])[0].rgb for asset in (ours, dome))
        assert psnr(first, second) > 30.0
