"""The scene file: everything comes back, the same scene is the same bytes, damage is found and named."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from factory.stages.scene_file import (
    IN_HALF,
    KEY,
    BadScene,
    read_dtype,
    read_scene,
    scene_digest,
    scene_header,
    scene_tensors,
    write_scene,
)
from tasks.render.scene.asset import BlockRange, ClassQuality, Exposure, PhotoPose, RenderAsset, ViewQuality
from tasks.render.scene.movers import NO_SHIFTS, BoxShifts
from tasks.render.scene.sky import SkyMap
from tasks.render.settings import SceneDtype
from tasks.render.splatting.gaussians import EMPTY, Gaussians
from tasks.render.splatting.project import CLASSIC


def gaussians(n: int, count: int, seed: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, count, 3))
    return Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def scene() -> RenderAsset:
    return RenderAsset(
        origin=np.array([600_000.25, 4_000_000.5, 30.0]),
        background=gaussians(30, 3, 0),
        nodes={"b/7 ü": gaussians(5, 15, 1), "a": gaussians(4, 0, 2)},
        sky=SkyMap(np.random.default_rng(3).uniform(0, 2, (8, 16, 3)).astype(np.float32)),
        psnr_db=27.123456789,
        n_held_out=3,
        views=(
            ViewQuality("front", 0.5, 28.5, 0.91, True, 3.5, (ClassQuality("road", 0.3, 30.5, 0.9),)),
            ViewQuality("front", 1.0, float("inf"), float("nan"), False),
        ),
        exposures=(Exposure("front", 0.5, np.eye(3, 4, dtype=np.float32) * 1.1),),
        block=BlockRange("av2", "log", 10.0, 30.0, np.array([-1.5, 2.0]), np.array([8.0, 3.25])),
        taken=(PhotoPose("front", 0.1 + 0.2, np.eye(4) * 0.1),),
        shifts=BoxShifts(("a",), np.arange(12, dtype=np.float32).reshape(1, 3, 4)),
        screen=CLASSIC,
    )


def test_everything_comes_back(tmp_path: Path) -> None:
    asset = scene()
    written = write_scene(tmp_path / "deep" / "x.safetensors", asset)
    back = read_scene(tmp_path / "deep" / "x.safetensors")
    assert back.digest == written.digest and len(back.digest) == 16
    assert list(back.nodes) == list(asset.nodes)  # the order of the nodes is kept
    for name, array in scene_tensors(asset).items():
        stored = scene_tensors(back)[name]
        assert (stored.dtype, stored.tobytes()) == (array.dtype, array.tobytes()), name
    assert scene_header(back) == scene_header(asset) and back.screen == asset.screen == CLASSIC
    assert back.views[0] == asset.views[0] and np.isnan(back.views[1].ssim) and np.isinf(back.views[1].psnr_db)
    assert back.block is not None and back.block.low.tolist() == [-1.5, 2.0]
    assert back.psnr_db == 27.123456789 and back.shifts.track_ids == ("a",)
    assert (back.taken[0].camera, back.taken[0].time_s) == ("front", 0.1 + 0.2)  # by which files are found again
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["x.safetensors"]  # no drafts left


def test_a_scene_of_nothing_but_sky_and_without_a_measure_is_a_scene(tmp_path: Path) -> None:
    plain = RenderAsset(np.zeros(3), EMPTY, {}, scene().sky, float("nan"))
    write_scene(tmp_path / "x", plain)
    back = read_scene(tmp_path / "x")
    assert len(back.background) == 0 and back.nodes == {} and np.isnan(back.psnr_db) and back.block is None


def test_the_same_scene_is_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_scene(tmp_path / name / "block", scene())
    assert (tmp_path / "a/block").read_bytes() == (tmp_path / "b/block").read_bytes()


def of_unit_length(part: Gaussians) -> Gaussians:
    return replace(part, quats=part.quats / np.linalg.norm(part.quats, axis=1, keepdims=True))


def test_in_16_bits_places_stay_and_all_else_is_the_nearest_number_of_11_bits(tmp_path: Path) -> None:
    whole = replace(scene(), background=of_unit_length(gaussians(3000, 15, 0)))
    opacities = np.linspace(1e-3, 1.0 - 2.0**-24, 3000).astype(np.float32)
    whole = replace(whole, background=replace(whole.background, opacities=opacities))
    path, plain = tmp_path / "half", tmp_path / "whole"
    written = write_scene(path, whole, SceneDtype.FLOAT16)
    back = read_scene(path)
    write_scene(plain, whole)
    assert (read_dtype(path), read_dtype(plain)) == (SceneDtype.FLOAT16, SceneDtype.FLOAT32)
    assert path.stat().st_size < 0.56 * plain.stat().st_size  # 124 of 236 bytes a Gaussian, and the rest
    for name, array in scene_tensors(whole).items():
        first, second = scene_tensors(written)[name], scene_tensors(back)[name]
        assert first.tobytes() == second.tobytes() and second.dtype == array.dtype, name  # built or read: the same
        if name.startswith("background.") and name.rpartition(".")[2] in IN_HALF:
            error = 2.0 ** (-10 if name.endswith(".quats") else -11)  # a quaternion's length is put right
            assert np.abs(second - array).max() > 0.0
            assert (np.abs(second - array) <= 1.001 * error * np.abs(array) + 2.0**-24).all(), name
    assert back.background.means.tobytes() == whole.background.means.tobytes()
    np.testing.assert_allclose(np.linalg.norm(back.background.quats, axis=1), 1.0, atol=1e-6)
    assert back.background.opacities.max() < 1.0
    assert back.digest == written.digest != read_scene(plain).digest


def test_a_file_of_16_bits_says_so_and_holds_places_in_32(tmp_path: Path) -> None:
    write_scene(tmp_path / "x", scene(), SceneDtype.FLOAT16)
    with safe_open(tmp_path / "x", framework="numpy") as file:
        assert json.loads(file.metadata()[KEY])["version"] == 2
        assert file.get_tensor("background.means").dtype == np.float32
        assert {file.get_tensor(f"nodes.0.{name}").dtype for name in IN_HALF} == {np.dtype(np.float16)}


def test_what_16_bits_do_not_hold_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    bright = replace(scene().background, colours=np.full((30, 3), 70_000.0, np.float32))
    with pytest.raises(ValueError, match=r"background\.colours: 70000 is more than 16 bits hold; .* float32"):
        write_scene(tmp_path / "x", replace(scene(), background=bright), SceneDtype.FLOAT16)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "changed",
    [
        lambda s: replace(s, origin=s.origin + 1e-9 * np.array([0.0, 0.0, 1.0])),
        lambda s: replace(s, nodes=dict(reversed(list(s.nodes.items())))),
        lambda s: replace(s, sky=SkyMap(s.sky.rgb[::-1])),
        lambda s: replace(s, psnr_db=27.0),
        lambda s: replace(s, views=s.views[:1]),
        lambda s: replace(s, exposures=()),
        lambda s: replace(s, block=None),
        lambda s: replace(s, taken=()),
        lambda s: replace(s, shifts=NO_SHIFTS),
        lambda s: replace(s, shifts=BoxShifts(("b/7 ü",), s.shifts.rows)),
        lambda s: replace(s, background=s.background.take(np.arange(29))),
    ],
)
def test_the_digest_sees_every_part(changed: Callable[[RenderAsset], RenderAsset]) -> None:
    first, other = scene(), changed(scene())
    assert scene_digest(scene_tensors(first), scene_header(first)) != scene_digest(
        scene_tensors(other), scene_header(other)
    )


def test_any_program_reads_the_file_without_this_project(tmp_path: Path) -> None:
    write_scene(tmp_path / "x", scene())
    with safe_open(tmp_path / "x", framework="numpy") as file:
        header = json.loads(file.metadata()[KEY])
        assert file.get_tensor("nodes.0.sh_rest").shape == (5, 15, 3)
    assert header["nodes"] == ["b/7 ü", "a"] and header["views"][1]["ssim"] is None


@pytest.mark.parametrize("dtype", SceneDtype)
def test_one_flipped_bit_anywhere_in_the_tensors_is_found(tmp_path: Path, dtype: SceneDtype) -> None:
    path = tmp_path / "x"
    write_scene(path, scene(), dtype)
    whole = bytearray(path.read_bytes())
    start = len(whole) - sum(array.nbytes for array in scene_tensors(scene(), dtype).values())
    for at in np.linspace(start, len(whole) - 1, 7).astype(int):
        damaged = whole.copy()
        damaged[at] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(BadScene, match=r"x: the content does not match its digest"):
            read_scene(path)


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with pytest.raises(BadScene, match="x: cannot be read"):
        read_scene(path)
    write_scene(path, scene())
    whole = path.read_bytes()
    for cut in (0, 5, 200, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(BadScene, match="x: cannot be read"):
            read_scene(path)
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(BadScene, match="no scene"):
        read_scene(path)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("[]", "damaged"),
        ("{", "damaged: JSONDecodeError"),
        ('{"format":"other","version":1}', "format 'other' 1, this version reads"),
        ('{"format":"driving-data-factory scene","version":3}', "scene' 3, this version reads"),
    ],
)
def test_a_foreign_header_is_named(tmp_path: Path, header: str, said: str) -> None:
    save_file({"a": np.zeros(3)}, tmp_path / "x", metadata={KEY: header})
    with pytest.raises(BadScene, match=said):
        read_scene(tmp_path / "x")


def test_a_consistent_file_without_an_array_is_named(tmp_path: Path) -> None:
    tensors, described = scene_tensors(scene()), scene_header(scene())
    del tensors["nodes.1.quats"]
    header = json.dumps(described | {"digest": scene_digest(tensors, described), "kept_as": "x"})
    save_file(tensors, tmp_path / "x", metadata={KEY: header})
    with pytest.raises(BadScene, match=r"KeyError 'nodes\.1\.quats'"):
        read_scene(tmp_path / "x")


def test_every_field_of_the_gaussians_has_its_tensor() -> None:
    names = set(scene_tensors(scene()))
    assert {f"background.{field.name}" for field in fields(Gaussians)} <= names
