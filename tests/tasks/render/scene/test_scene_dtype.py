"""A scene whose file is of 16 bits is drawn as the one of 32 is, on both backends."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import street
import torch

from factory.stages.scene_file import read_scene, write_scene
from tasks.render.scene.asset import Instant, RenderAsset
from tasks.render.scene.movers import agents_at_time
from tasks.render.scene.on_device import Device, views
from tasks.render.settings import SceneDtype
from tasks.world.clip import Pinhole
from tests.bench.by_kernels import rasterization

FRONT = Pinhole(street.INTRINSICS, street.ego_pose(3.0, 0.4) @ street.EGO_FROM_CAMERA, street.WIDTH, street.HEIGHT)


@pytest.fixture
def halved(street_asset: RenderAsset, tmp_path: Path) -> RenderAsset:
    write_scene(tmp_path / "half", street_asset, SceneDtype.FLOAT16)
    return read_scene(tmp_path / "half")


def test_gsplat_is_given_float32_for_its_kernels_take_no_less(halved: RenderAsset) -> None:
    """gsplat 1.5.3 composites float (RasterizeToPixels3DGSFwd.cu) and projects float or double, no other type."""
    there = agents_at_time(street.tracks(), 0.8)
    asked: list[dict[str, Any]] = []

    def listened(**given: Any) -> Any:
        asked.append(given)
        return rasterization(**given)

    next(views(Device("cpu", listened), halved, [Instant([FRONT], there, [np.eye(3, 4, dtype=np.float32)])]))
    arrays = [value for value in asked[0].values() if isinstance(value, torch.Tensor)]
    assert len(arrays) == 7 and all(array.dtype == torch.float32 for array in arrays)
