"""The backward pass from a picture, against what torch finds by itself in float64."""

from dataclasses import replace

import numpy as np
import pytest
import slow_raster
import torch
from numpy.typing import NDArray

from tasks.render.splatting.gaussians import EMPTY, Gaussians, concatenate, moved
from tasks.render.splatting.gradient import Gradients, backward, untransformed_gradients
from tasks.render.splatting.raster import ForwardPass, forward

WIDTH, HEIGHT = 37, 29  # no multiple of a tile
INTRINSICS = np.array([[30.0, 0.0, 18.0], [0.0, 31.0, 15.0], [0.0, 0.0, 1.0]])
BACKGROUND = np.random.default_rng(1).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
KINDS = ("means", "quats", "log_scales", "logits", "colours")


def pose(angles: tuple[float, float, float], position: tuple[float, float, float]) -> NDArray[np.float64]:
    out = np.eye(4)
    for axis, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.eye(3)
        turn[np.ix_([(axis + 1) % 3, (axis + 2) % 3], [(axis + 1) % 3, (axis + 2) % 3])] = [[c, -s], [s, c]]
        out[:3, :3] = out[:3, :3] @ turn
    out[:3, 3] = position
    return out


CAMERA = pose((0.05, -0.1, 0.2), (0.2, -0.1, -0.4))


def cloud(n: int, seed: int, near: float, far: float, sigma: float, most_opaque: float) -> Gaussians:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(near, far, n)
    means = np.stack([rng.uniform(-0.7, 0.7, n) * depth, rng.uniform(-0.5, 0.5, n) * depth, depth], 1)
    return Gaussians(
        means.astype(np.float32),
        (rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, (n, 1))).astype(np.float32),  # of any length
        np.log(sigma * rng.uniform(0.3, 2.0, (n, 3))).astype(np.float32),
        rng.uniform(0.05, most_opaque, n).astype(np.float32),
        rng.uniform(0.1, 1.0, (n, 3)).astype(np.float32),
    )


SCENES = {
    "small ones": cloud(60, 0, 1.0, 12.0, 0.3, 0.9),
    "some behind the camera": cloud(60, 1, -4.0, 6.0, 0.3, 0.9),
    "big and near": cloud(12, 2, 0.3, 2.0, 0.8, 0.8),
    "nearly opaque": cloud(40, 3, 2.0, 9.0, 0.4, 1.0),
    "opaque": replace(cloud(25, 4, 2.0, 9.0, 0.3, 1.0), opacities=np.full(25, 0.9996, np.float32)),
    "hardly there": cloud(60, 5, 1.0, 9.0, 0.2, 0.06),
}


def upstream(seed: int) -> tuple[NDArray[np.float32], ...]:
    rng = np.random.default_rng(seed)
    shapes = ((HEIGHT, WIDTH, 3), (HEIGHT, WIDTH), (HEIGHT, WIDTH))
    return tuple(rng.normal(size=shape).astype(np.float32) for shape in shapes)


def traced(scene: Gaussians, threads: int = 1, with_depth: bool = True) -> ForwardPass:
    return forward(scene, INTRINSICS, CAMERA, WIDTH, HEIGHT, BACKGROUND, threads, with_depth=with_depth)


def dense(gradients: Gradients, kind: str, n: int) -> NDArray[np.float32]:
    rows = getattr(gradients, kind)
    out = np.zeros((n, *rows.shape[1:]), np.float32)
    out[gradients.index] = rows
    return out


def slow_gradients(
    leaves: slow_raster.SlowGaussians, scene: slow_raster.SlowGaussians, ups: tuple[NDArray[np.float32], ...]
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    images = slow_raster.slow_render(scene, INTRINSICS, CAMERA, background, motion)
    loss = sum((image * torch.tensor(up)).sum() for image, up in zip(images, ups))
    *by_leaves, by_motion = torch.autograd.grad(loss, [*leaves.leaves(), motion])
    return [g.numpy() for g in by_leaves], by_motion.numpy()


def same(fast: NDArray[np.floating], slow: NDArray[np.floating]) -> bool:
    """To a thousandth of the whole, and of the largest entry."""
    if slow.size == 0:
        return fast.shape == slow.shape
    error = fast - slow
    close = np.linalg.norm(error) <= 1e-3 * np.linalg.norm(slow)
    return bool(close and np.abs(error).max() <= 1e-3 * np.abs(slow).max())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("terms", ["rgb", "rgb, depth, alpha"])
def test_gradients_are_those_of_the_slow_twin(name: str, terms: str) -> None:
    scene, (d_rgb, d_depth, d_alpha) = SCENES[name], upstream(7)
    record = traced(scene, with_depth="depth" in terms)
    d_depth = d_depth * (record.view.alpha > 0.05)  # the mean depth of almost nothing is steep beyond float32
    if terms == "rgb":
        fast = backward(record, scene, d_rgb)
        with pytest.raises(ValueError, match="drawn without"):
            backward(record, scene, d_rgb, d_depth)
        d_depth, d_alpha = np.zeros_like(d_depth), np.zeros_like(d_alpha)
    else:
        fast = backward(record, scene, d_rgb, d_depth, d_alpha)
    leaves = slow_raster.slow(scene)
    slow, by_motion = slow_gradients(leaves, leaves, (d_rgb, d_depth, d_alpha))
    wrong = [kind for kind, g in zip(KINDS, slow) if not same(dense(fast, kind, len(scene)), g)]
    assert not wrong
    assert same(fast.camera, by_motion)


def test_a_vehicle_gets_its_gradients_in_its_own_frame() -> None:
    street, car = cloud(30, 8, 3.0, 9.0, 0.4, 0.8), cloud(40, 9, -0.5, 0.5, 0.15, 0.9)
    drive = pose((0.3, 0.8, -0.4), (0.4, 0.2, 3.0))
    scene, ups = concatenate([street, moved(car, drive)]), upstream(10)
    fast = backward(traced(scene), scene, *ups[:1])
    own = untransformed_gradients(fast, drive)
    leaves = slow_raster.slow(car)
    whole = slow_raster.slow_concatenate([slow_raster.slow(street), slow_raster.slow_moved(leaves, drive)])
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    slow, by_motion = slow_gradients(leaves, whole, (ups[0], nothing, nothing))
    wrong = [kind for kind, g in zip(KINDS, slow) if not same(dense(own, kind, len(scene))[len(street) :], g)]
    assert not wrong
    assert same(fast.camera, by_motion)


def test_the_screen_gradient_moves_a_far_gaussian_across_the_view() -> None:
    scene = cloud(60, 11, 30.0, 60.0, 0.2, 0.9)  # so far that a step to the side changes nothing but the place
    gradients = backward(forward(scene, INTRINSICS, np.eye(4), WIDTH, HEIGHT, BACKGROUND), scene, upstream(11)[0])
    pixels_per_metre = np.array([30.0, 31.0]) / scene.means[gradients.index, 2:]
    moved_by = gradients.screen * pixels_per_metre
    np.testing.assert_allclose(gradients.means[:, :2], moved_by, atol=0.01 * np.abs(moved_by).max())


def test_the_number_of_threads_changes_no_byte() -> None:
    scene, ups = cloud(9000, 12, 1.0, 12.0, 0.05, 0.9), upstream(13)
    one, three = (backward(traced(scene, n), scene, *ups, threads=n) for n in (1, 3))
    for name in Gradients.__dataclass_fields__:
        assert getattr(one, name).tobytes() == getattr(three, name).tobytes()


def test_what_nobody_sees_has_no_gradient() -> None:
    wall = Gaussians(
        np.array([[0, 0, 2], [0, 0, 9]], np.float32),
        np.array([[1, 0, 0, 0], [1, 0, 0, 0]], np.float32),
        np.log([[9, 9, 0.01], [1, 1, 1]]).astype(np.float32),
        np.array([0.999, 0.9], np.float32),
        np.ones((2, 3), np.float32),
    )
    scene = concatenate([wall.take(np.zeros(40, np.intp)), wall.take(np.ones(1, np.intp))])
    gradients = backward(traced(scene), scene, upstream(14)[0])
    assert gradients.index[-1] == 40
    assert not gradients.colours[-1].any() and not gradients.means[-1].any()


def test_an_empty_scene_has_no_gradients() -> None:
    gradients = backward(traced(EMPTY), EMPTY, upstream(15)[0])
    assert len(gradients.index) == 0 and gradients.means.shape == (0, 3) and not gradients.camera.any()


def test_upstream_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        backward(traced(EMPTY), EMPTY, np.zeros((5, 5, 3), np.float32))
