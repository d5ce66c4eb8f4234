"""A scene whose file is of 16 bits is drawn as the one of 32 is, on both backends."""

from pathlib import Path

import numpy as np
import pytest
import street

from factory.stages.scene_file import read_scene, write_scene
from tasks.render.scene.asset import RenderAsset, compose_gaussians
from tasks.render.scene.engine import agents_at_time
from tasks.render.settings import SceneDtype
from tasks.render.splatting.gsplat_backend import arguments
from tasks.world.clip import Pinhole

FRONT = Pinhole(street.INTRINSICS, street.ego_pose(3.0, 0.4) @ street.EGO_FROM_CAMERA, street.WIDTH, street.HEIGHT)


@pytest.fixture
def halved(street_asset: RenderAsset, tmp_path: Path) -> RenderAsset:
    write_scene(tmp_path / "half", street_asset, SceneDtype.FLOAT16)
    return read_scene(tmp_path / "half")


def test_gsplat_is_given_float32_for_its_kernels_take_no_less(halved: RenderAsset) -> None:
    """gsplat 1.5.3 composites float (RasterizeToPixels3DGSFwd.cu) and projects float or double, no other type."""
    there = agents_at_time(street.tracks(), 0.8)
    given = arguments(compose_gaussians(halved, there.track_ids, there.kinds, there.boxes), [FRONT])
    arrays = [value for value in given.values() if isinstance(value, np.ndarray)]
    assert len(arrays) == 7 and all(array.dtype == np.float32 for array in arrays)
