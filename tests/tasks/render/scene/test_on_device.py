"""What is drawn and finished on a device of torch's is what the kernels draw, here with the kernels as rasteriser."""

import gc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import street
import torch

from tasks.render.scene import on_device
from tasks.render.scene.asset import Exposure, OwnBody, RenderAsset
from tasks.render.scene.engine import encode_jpeg, render, render_instants, render_jpegs, render_pictures
from tasks.render.scene.movers import PlacedAgents, agents_at_time
from tasks.render.scene.on_device import Device, finished
from tasks.render.scene.sky import SkyMap
from tasks.render.settings import Backend
from tasks.render.splatting.gaussians import EMPTY, Gaussians
from tasks.render.views import instants_of_views, render_views
from tasks.world.arrays import F32
from tasks.world.clip import AgentKind, AgentTracks, Camera, Pinhole
from tests.bench.by_kernels import rasterization

STEP = 1.0 / 255.0


@pytest.fixture(autouse=True)
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU that is this CPU."""
    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", rasterization, packed))


@pytest.fixture
def rich(street_asset: RenderAsset) -> RenderAsset:
    """The street with a sky of noise, colours of cameras that change, light that depends on the side, an own body."""
    rng = np.random.default_rng(0)

    def lit(part: Gaussians, count: int) -> Gaussians:
        return replace(part, sh_rest=rng.normal(0.0, 0.05, (len(part), count, 3)).astype(np.float32))

    sky = SkyMap(rng.uniform(0.0, 1.2, street_asset.sky.rgb.shape).astype(np.float32))
    affines = [(np.eye(3, 4) + rng.normal(0.0, 0.08, (3, 4))).astype(np.float32) for _ in range(4)]
    exposures = tuple(Exposure(n, t, a) for (n, t), a in zip([("a", 0.0), ("a", 2.0), ("b", 0.0), ("b", 2.0)], affines))
    body = np.zeros((36, 64, 4), np.uint8)
    body[24:] = rng.integers(0, 255, (12, 64, 4))
    nodes = {name: lit(node, 3) for name, node in street_asset.nodes.items()}
    assert nodes
    scene = {"background": lit(street_asset.background, 15), "nodes": nodes, "sky": sky}
    return replace(street_asset, **scene, exposures=exposures, bodies=(OwnBody("b", body),))


def turned(degrees: float) -> np.ndarray:
    """A mount that looks to the left by this, and up a little."""
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    mount = street.EGO_FROM_CAMERA.copy()
    up = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.3), -np.sin(0.3)], [0.0, np.sin(0.3), np.cos(0.3)]])
    mount[:3, :3] = turn @ mount[:3, :3] @ up
    return mount


def two_that_come_and_go() -> AgentTracks:
    """The street's car, beside it from step 8 on somebody of whom there are no photos, and nobody from step 12 on."""
    car = street.tracks()
    boxes = np.concatenate([car.boxes, car.boxes + np.array([0.0, -2.0, 0.0, -2.0, -1.0])], axis=1)
    twice = {name: np.repeat(getattr(car, name), 2, axis=1) for name in ("velocities", "valid", "center_z")}
    twice["valid"][:8, 1] = twice["valid"][12:] = False
    kinds = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN)
    return replace(
        car, track_ids=("car", "nobody knows it"), kinds=kinds, boxes=boxes, heights=np.repeat(car.heights, 2), **twice
    )


def test_samples_pictures_are_the_kernels_to_a_step_of_8_bits(rich: RenderAsset) -> None:
    """Two cameras, one of which sees its own car, at three instants: a vehicle with Gaussians of its own drives along,
    with another one after a while, and then both are gone."""
    rig = [
        Camera(n, street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), turned(k))
        for n, k in (("a", 0.0), ("b", 170.0))
    ]
    poses = np.stack([street.ego_pose(x, 0.6) for x in (1.5, 2.5, 3.0)])
    both = two_that_come_and_go()
    drawn = [
        np.stack([*render_views(rich, rig, poses, both, [4, 9.5, 14], 96, 54, by)])
        for by in (Backend.CPU, Backend.GSPLAT)
    ]
    assert drawn[0].shape == drawn[1].shape == (3, 2, 54, 96, 3)
    apart = np.abs(drawn[0].astype(int) - drawn[1])
    assert apart.max() <= 1 and (apart > 0).mean() < 0.01
    assert (np.abs(drawn[0][:, 1].astype(int) - drawn[0][:, 0]) > 30).mean() > 0.2, "both look at something else"


def test_views_of_instants_drawn_together_are_those_of_each_alone(
    rich: RenderAsset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit, and to less than a step the kernels': cameras of two sizes, of the background what is near alone, at
    instants with two, one and no vehicles; in as many calls as memory asks for."""
    calls: list[tuple[int, ...]] = []

    def counted(**given: Any) -> Any:
        calls.append(tuple(given["Ks"].shape[:2]))
        return rasterization(**given)

    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", counted, packed))
    rig = [Camera(n, 96, 54, street.INTRINSICS, np.zeros(5), turned(k)) for n, k in (("a", 0.0), ("b", 170.0))]
    poses = np.stack([street.ego_pose(x, 0.6) for x in (1.5, 2.5, 3.0)])
    asked, _ = instants_of_views(rich, rig, poses, two_that_come_and_go(), [9.5, 4, 14], 96, 54, reach_m=16.0)
    assert [len(one.vehicles.track_ids) for one in asked] == [2, 1, 0]
    half = [[e if i else replace(e, width=48) for i, e in enumerate(one.cameras)] for one in asked]
    asked = [replace(one, cameras=eyes) for one, eyes in zip(asked, half)]
    together = [*render_instants(rich, asked, Backend.GSPLAT)]
    assert calls == [(3, 1)] * 2, "one call a size"
    for one, views in zip(asked, together, strict=True):
        (alone,), (slow,) = (render_instants(rich, [one], by) for by in (Backend.GSPLAT, Backend.CPU))
        for mine, own, kernels in zip(views, alone, slow, strict=True):
            for name in ("rgb", "depth", "alpha"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(own, name))
            assert mine.rgb.shape == kernels.rgb.shape and np.abs(mine.rgb - kernels.rgb).max() < STEP
            np.testing.assert_allclose(mine.alpha, kernels.alpha, atol=1e-3)
    whole = len(rich.background) + len(rich.nodes["car"])
    for bound, value, expected in (
        ("BATCH_GAUSSIANS", 2 * whole, [2, 2, 1, 1]),
        ("BATCH_PAIRS", 2 * whole, [1] * 6),
        ("BATCH_PIXELS", 2 * (96 + 48) * 54, [2, 2, 1, 1]),
    ):
        calls.clear()
        with monkeypatch.context() as less:
            less.setattr(on_device, bound, value)
            again = [*render_instants(rich, asked, Backend.GSPLAT)]
        assert [instants for instants, _ in calls] == expected, bound
        np.testing.assert_array_equal(again[2][1].rgb, together[2][1].rgb)


def test_all_instants_are_asked_for_before_the_first_comes_back_alone(
    rich: RenderAsset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that JPEGs of one are made while the next are drawn."""
    told: list[str] = []

    def drawn(**given: Any) -> Any:
        told.append("asked")
        return rasterization(**given)

    def fetch(tensor: torch.Tensor) -> np.ndarray:
        told.append("fetched")
        return tensor.numpy()

    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", drawn, packed, fetch))
    monkeypatch.setattr(on_device, "BATCH_PIXELS", 2 * 96 * 54)
    rig = [Camera("a", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), turned(0.0))]
    poses = np.stack([street.ego_pose(x, 0.6) for x in (1.5, 2.5, 3.5)])
    for pictures in render_views(rich, rig, poses, street.tracks(), [4, 9, 14], 96, 54, Backend.GSPLAT):
        told.append(f"encoded {len(pictures)}")
    assert told == ["asked"] * 2 + ["fetched", "encoded 1"] * 3, "two instants at once, then one"


@pytest.mark.parametrize("by", ["threads", "the device"])
def test_jpegs_are_those_of_the_pictures_in_their_order(
    rich: RenderAsset, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """A device that makes them has no picture come back, and makes those of one call at once."""
    encoded: list[int] = []

    def encode(pictures: list[torch.Tensor], quality: int) -> list[bytes]:
        encoded.append(len(pictures))
        assert all(picture.is_contiguous() and picture.dtype == torch.uint8 for picture in pictures)
        return [encode_jpeg(picture.permute(1, 2, 0).numpy(), quality) for picture in pictures]

    def fetch(tensor: torch.Tensor) -> np.ndarray:
        raise AssertionError("nothing else is asked for")

    rig = [
        Camera(n, street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), turned(k))
        for n, k in (("a", 0.0), ("b", 170.0))
    ]
    poses = np.stack([street.ego_pose(x, 0.6) for x in (1.5, 2.5, 3.0)])
    asked = instants_of_views(rich, rig, poses, two_that_come_and_go(), [4, 9.5, 14], 96, 54)
    pictures = [*render_pictures(rich, *asked, Backend.GSPLAT)]
    if by == "the device":
        monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", rasterization, packed, fetch, encode))
    monkeypatch.setattr(on_device, "BATCH_PIXELS", 2 * 2 * 96 * 54)
    jpegs = render_jpegs(rich, *asked, 90, Backend.GSPLAT)
    assert encoded == ([4, 2] if by == "the device" else [])
    assert jpegs == [[encode_jpeg(picture, 90) for picture in of_instant] for of_instant in pictures]


def test_views_of_cameras_of_any_size_in_their_order(rich: RenderAsset) -> None:
    """Turned vehicles, one of them plain, by colours, depth and alpha."""
    pose = street.ego_pose(3.0, 0.4)
    eyes = [
        Pinhole(street.INTRINSICS, pose @ turned(0.0), 128, 72),
        Pinhole(street.INTRINSICS * [[0.5], [0.5], [1.0]], pose @ turned(40.0), 64, 36),
        Pinhole(street.INTRINSICS, pose @ turned(-90.0), 128, 72),
    ]
    boxes = np.stack([street.car_box(0.4), street.car_box(1.5)])
    boxes[:, 3] = 0.7, -2.0
    there = PlacedAgents(("car", "nobody knows it"), (AgentKind.VEHICLE, AgentKind.PEDESTRIAN), boxes)
    for by in (Backend.GSPLAT, Backend.GSPLAT_DENSE):
        for slow, fast in zip(render(rich, eyes, there), render(rich, eyes, there, by), strict=True):
            assert slow.rgb.shape == fast.rgb.shape and np.abs(slow.rgb - fast.rgb).max() < STEP
            np.testing.assert_allclose(fast.alpha, slow.alpha, atol=1e-3)
            solid = slow.alpha > 0.5
            np.testing.assert_allclose(fast.depth[solid], slow.depth[solid], rtol=1e-3)


def test_an_empty_scene_is_the_sky(rich: RenderAsset) -> None:
    bare = replace(rich, background=EMPTY)
    eye = Pinhole(street.INTRINSICS, street.ego_pose(0.0) @ turned(10.0), 64, 36)
    (slow,), (fast,) = render(bare, [eye]), render(bare, [eye], backend=Backend.GSPLAT)
    assert not fast.alpha.any() and not fast.depth.any() and np.abs(slow.rgb - fast.rgb).max() < STEP


@pytest.mark.parametrize("pitch", [-1.5, -0.4, 0.0, 0.9, 1.57])
def test_the_sky_behind_a_picture_is_the_kernel_s_wherever_it_looks(pitch: float) -> None:
    """A smooth sky, at the poles and at the seam, with a wide lens, through every alpha and a camera's own colours."""
    rng = np.random.default_rng(1)
    small = rng.uniform(0.0, 1.0, (16, 64, 3)).astype(np.float32)
    sky = SkyMap(np.ascontiguousarray(np.repeat(np.repeat(small, 16, axis=0), 16, axis=1)))
    k = np.array([[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(pitch), np.sin(pitch)
    for yaw in (0.0, 3.1, -1.0):
        pose = np.eye(4)
        ahead = np.array([c * np.cos(yaw), c * np.sin(yaw), s])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        rgb, alpha = (
            rng.uniform(-0.1, 1.0, (64, 96, 3)).astype(np.float32),
            rng.uniform(0, 1, (64, 96)).astype(np.float32),
        )
        affine = (np.eye(3, 4) + rng.normal(0.0, 0.1, (3, 4))).astype(np.float32)
        expected: F32 = rgb.copy()
        sky.finish(expected, alpha, affine, k, pose)
        tensors = [torch.as_tensor(a.astype(np.float32))[None] for a in (k, pose[:3, :3], affine)]
        found = finished(torch.as_tensor(rgb)[None], torch.as_tensor(alpha)[None], torch.as_tensor(sky.cells), *tensors)
        off = np.abs(found[0].numpy() - expected)
        assert off.max() < 8 * STEP and (off > STEP).mean() < 0.003, "blocks of noise end within a pixel"


def test_what_lies_on_the_device_is_sent_once_and_goes_with_its_scene(
    rich: RenderAsset, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    whole = Device.sent

    def counted(self: Device, array: object) -> torch.Tensor:
        tensor = whole(self, array)
        sent.append(tensor.numel())
        return tensor

    monkeypatch.setattr(Device, "sent", counted)
    gc.collect()
    before = set(on_device._HELD)
    mine = replace(rich, background=rich.background.take(slice(0, 500)), nodes={}, sky=SkyMap(rich.sky.rgb.copy()))
    eye = [Pinhole(street.INTRINSICS, street.ego_pose(0.0) @ turned(10.0), 64, 36)]
    render(mine, eye, backend=Backend.GSPLAT)
    held = set(on_device._HELD) - before
    assert max(sent) == mine.sky.rgb.size and len(held) == 2
    sent.clear()
    render(replace(mine, exposures=()), eye, agents_at_time(street.tracks(), 0.4), Backend.GSPLAT)
    render(mine, eye, backend=Backend.GSPLAT)
    of_box = sum(n for n in sent if n > 16)
    assert of_box < 40_000, "the plain box alone"
    del mine
    gc.collect()
    assert not held & set(on_device._HELD)
