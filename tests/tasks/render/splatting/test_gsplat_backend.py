"""The CUDA backend: what it is called with, what it says where it cannot work, and its image where it can."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import street

from tasks.render.gate import check_drive_pictures
from tasks.render.scene import on_device
from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import render, require_backend
from tasks.render.scene.movers import agents_at_time
from tasks.render.scene.on_device import Device
from tasks.render.seen import photo_sights
from tasks.render.settings import Backend, GateSettings
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.gsplat_backend import BackendMissing, require
from tasks.render.views import render_views
from tasks.world.clip import Camera, Pinhole, SensorFile
from tests.bench.by_kernels import rasterization

POSE = street.ego_pose(3.0, 0.4) @ street.EGO_FROM_CAMERA
FRONT = Pinhole(street.INTRINSICS, POSE, street.WIDTH, street.HEIGHT)


def cloud(n: int, count: int) -> Gaussians:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        (rng.uniform(-1.0, 1.0, (n, 3)) * [10.0, 5.0, 2.0] + [16.0, 0.0, 1.5]).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.log(rng.uniform(0.02, 0.5, (n, 3))).astype(np.float32),
        rng.uniform(0.05, 0.95, n).astype(np.float32),
        rng.uniform(0.2, 0.8, (n, 3)).astype(np.float32),
        rng.normal(0.0, 0.1, (n, count, 3)).astype(np.float32),
    )


def test_the_rig_s_views_of_a_sample_s_instants_are_asked_for_at_once(
    monkeypatch: pytest.MonkeyPatch, street_asset: RenderAsset
) -> None:
    """By the gate, too, whose street views share one scene; with gsplat_dense each call is told not to pack."""
    asked: list[tuple[int, int, bool]] = []

    def counted(**given: Any) -> Any:
        asked.append((*given["Ks"].shape[:2], given["packed"]))
        return rasterization(**given)

    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", counted, packed))
    rig = [Camera(n, street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA) for n in "ab"]
    poses, size = np.stack([street.ego_pose(1.5, 0.6), street.ego_pose(2.5, 0.6)]), (64, 36)
    photos = [SensorFile("a", "", 0.1 * i, pose) for i, pose in enumerate((*poses, street.ego_pose(2.0)))]
    for backend, packed in ((Backend.GSPLAT, True), (Backend.GSPLAT_DENSE, False)):
        asked.clear()
        pictures = np.stack([*render_views(street_asset, rig, poses, street.tracks(), [4, 9], *size, backend)])
        assert asked == [(2, 2, packed)]
        on_cpu = np.stack([*render_views(street_asset, rig, poses, street.tracks(), [4, 9], *size)])
        np.testing.assert_allclose(pictures.astype(int), on_cpu, atol=1)
        asked.clear()
        sights = photo_sights(street_asset, photos, rig, backend)
        assert asked == [(1, 3, packed)]
        asked.clear()
        how, shown = GateSettings(guessed_max=1.0), {"stored": [4, 9], "sights": sights}
        found = check_drive_pictures(street_asset, rig, poses, street.tracks(), [4, 9], size, how, backend, **shown)
        assert found is None and asked == [(2, 2, packed), (1, 4, packed)]


@pytest.mark.parametrize("name", ["torch", "gsplat"])
def test_an_absent_package_is_named_with_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, name: str, street_asset: RenderAsset
) -> None:
    for module in ("torch", "gsplat"):
        monkeypatch.setitem(sys.modules, module, None if module == name else sys)
    with pytest.raises(BackendMissing, match=rf"needs torch and gsplat \(import of {name} .*\[gpu\]"):
        render(street_asset, [FRONT], backend=Backend.GSPLAT)
    with pytest.raises(BackendMissing, match="needs torch and gsplat"):
        require_backend(Backend.GSPLAT_DENSE)


def test_the_cpu_needs_nothing_and_a_machine_without_gpu_is_told_so() -> None:
    require_backend(Backend.CPU)
    torch = pytest.importorskip("torch")
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    with pytest.raises(BackendMissing, match=r"needs a CUDA device; torch .* sees none"):
        require_backend(Backend.GSPLAT)


def test_the_gpu_draws_the_cpu_s_image(street_asset: RenderAsset) -> None:
    try:
        require()
    except BackendMissing as error:
        pytest.skip(str(error))
    there = agents_at_time(street.tracks(), 0.8)
    for asset in (street_asset, replace(street_asset, background=cloud(3000, 15))):
        (slow,) = render(asset, [FRONT], there)
        for backend in (Backend.GSPLAT, Backend.GSPLAT_DENSE):
            for fast in render(asset, [FRONT, FRONT], there, backend):
                assert np.abs(slow.rgb - fast.rgb).max() <= 2.0 / 255.0
                np.testing.assert_allclose(fast.alpha, slow.alpha, atol=2.0 / 255.0)
                solid = slow.alpha > 0.5
                np.testing.assert_allclose(fast.depth[solid], slow.depth[solid], rtol=0.01)
