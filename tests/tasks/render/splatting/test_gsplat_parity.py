"""Pictures and derivatives of this package's kernels are gsplat's, and so is what it is called with.

recorded/gsplat_1_5_3.npz: six small scenes and what gsplat 1.5.3's own reference in torch (2.13.0, float64) says of
them, with the signature of its `rasterization`; written by `python -m tests.bench.peer_gsplat <file>`.
"""

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from packaging.requirements import Requirement

from tasks.render.scene.on_device import Device, arguments, gaussians_on, repeated
from tasks.render.splatting.tensors import Eye, SceneTensors, learned_arguments
from tasks.world.clip import Pinhole
from tests.bench.peer_gsplat import (
    CENTRED,
    HEIGHT,
    SCENES,
    WIDTH,
    apart,
    of_gsplat,
    of_kernels,
    pose,
    rasterization,
    read,
    signature,
)
from tests.factory.installs import PROJECT

RECORDED = Path(__file__).parent / "recorded" / "gsplat_1_5_3.npz"
CLOSE = 1e-4  # of an array's length
BEHIND_A_WALL = 2e-3  # a tile is left with 1e-3 of the light, gsplat leaves a pixel with 1e-4
ABOVE = {"a wall, others behind it": BEHIND_A_WALL}


@pytest.mark.parametrize("name", SCENES)
def test_the_kernels_draw_and_derive_what_gsplat_does(name: str) -> None:
    """rgb, depth, alpha; where light is the same from all sides by means, quaternions, ..., the camera, and places."""
    scene, intrinsics, expected = read(RECORDED, name)
    found = apart(of_kernels(scene, intrinsics), expected)
    assert len(found) == (3 if scene.sh_rest.size else 10) and max(found.values()) < ABOVE.get(name, CLOSE), found


@pytest.mark.parametrize("name", SCENES)
def test_what_is_recorded_is_what_the_installed_gsplat_says(name: str) -> None:
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    scene, intrinsics, expected = read(RECORDED, name)
    found = of_gsplat(scene, intrinsics)
    np.testing.assert_array_equal(found["index"], expected["index"])
    assert max(apart(found, expected).values()) < 1e-6


def given(packed: bool = True) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the drawing and what the fit call gsplat with, of one scene and camera."""
    scene, intrinsics = SCENES["colours below zero"]
    device, eye = Device("cpu", rasterization, packed), Pinhole(np.array(intrinsics), pose(), WIDTH, HEIGHT)
    drawing = arguments(device, repeated(gaussians_on(device, scene), 1), [[eye]])
    logits = torch.logit(torch.tensor(scene.opacities))
    tensors = (scene.means, scene.quats, scene.log_scales, logits, scene.colours)
    learned = SceneTensors(*map(torch.as_tensor, tensors))
    return drawing, learned_arguments(learned, Eye(np.array(CENTRED), pose(), WIDTH, HEIGHT, torch.zeros(6)))


def test_the_fit_calls_gsplat_as_the_drawing_does() -> None:
    drawing, fitting = given()
    assert drawing.keys() == fitting.keys()
    plain = {name: value for name, value in drawing.items() if not isinstance(value, torch.Tensor)}
    assert plain == {name: fitting[name] for name in plain} and len(plain) == 8
    for name in drawing.keys() - plain.keys():
        np.testing.assert_allclose(fitting[name], drawing[name][0], rtol=1e-5, atol=1e-6, err_msg=name)


def test_every_argument_is_one_of_gsplat_s_and_what_is_not_said_has_a_default() -> None:
    with np.load(RECORDED) as file:
        recorded, version = file["signature"].tolist(), str(file["version"])
    names, needed = [each.partition("=")[0] for each in recorded], [each for each in recorded if "=" not in each]
    assert "packed=True" in recorded  # what it does where nothing is said, and we do
    for packed in (True, False):
        drawing, fitting = given(packed)
        assert drawing["packed"] is packed and fitting["packed"] is True  # the fit asks which rows are in view
        for called in (drawing, fitting):
            assert set(needed) <= set(called) <= set(names)
    (wanted,) = (r for r in map(Requirement, PROJECT["optional-dependencies"]["gpu"]) if r.name == "gsplat")
    assert wanted.specifier.contains(version)
    assert not wanted.specifier.contains("1.6.0"), "its main branch caps opacities at 0.99"


def test_the_installed_gsplat_has_the_recorded_signature() -> None:
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
    with np.load(RECORDED) as file:
        assert file["signature"].tolist() == signature(gsplat.rasterization)
    for packed in (True, False):
        for called in given(packed):
            inspect.signature(gsplat.rasterization).bind(**called)
