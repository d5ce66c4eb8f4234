"""Colour by the side it is seen from: the basis' signs, its norm, and what turning and mirroring do to it."""

from dataclasses import replace

import numpy as np
import pytest
import slow_raster
import torch
from numpy.typing import NDArray

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, concatenate, moved
from tasks.render.splatting.raster import colours_seen

ROWS = np.arange(20)


def directions(n: int = 500) -> NDArray[np.float64]:
    points = np.random.default_rng(0).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def shiny(seed: int, count: int) -> Gaussians:
    rng, n = np.random.default_rng(seed), len(ROWS)
    return Gaussians(
        rng.normal(size=(n, 3)).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.zeros((n, 3), np.float32),
        np.full(n, 0.5, np.float32),
        np.full((n, 3), 0.5, np.float32),
        rng.normal(0.0, 0.1, (n, count, 3)).astype(np.float32),
    )


def turned_pose() -> NDArray[np.float64]:
    axes, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    out = np.eye(4)
    out[:3, :3] = axes * np.sign(np.linalg.det(axes))
    out[:3, 3] = (3.0, -2.0, 5.0)
    return out


@pytest.mark.parametrize("count", [3, 8, 15])
def test_the_basis_is_the_one_of_splat_files(count: int) -> None:
    expected = slow_raster.sh_basis(torch.tensor(directions())).numpy()[:, :count]
    np.testing.assert_allclose(sh.basis(directions(), count), expected, atol=1e-12)


def test_the_basis_is_orthonormal_over_the_sphere() -> None:
    values = sh.basis(sh._spread(20000), 15)
    np.testing.assert_allclose(4 * np.pi * values.T @ values / 20000, np.eye(15), atol=1e-3)
    np.testing.assert_allclose(4 * np.pi * sh.C0 * values.mean(axis=0), 0.0, atol=1e-3)


def test_of_degree_0_all_sides_have_one_colour() -> None:
    scene = shiny(1, 0)
    assert scene.sh_rest.shape == (20, 0, 3)
    np.testing.assert_array_equal(colours_seen(scene, np.array([9.0, 1.0, 2.0]), ROWS), scene.colours)


def test_a_light_that_falls_off_to_one_side_is_brighter_from_there() -> None:
    scene = shiny(2, 3)
    scene.sh_rest[:] = 0.0
    scene.sh_rest[:, 2] = 0.4  # -C1 x of the direction from the camera: brighter where one looks towards -x
    ahead, behind = (colours_seen(scene, np.array([x, 0.0, 0.0]), ROWS) for x in (100.0, -100.0))
    assert (ahead > 0.65).all() and (behind < 0.35).all()
    scene.sh_rest[:, 2] = 4.0
    assert (colours_seen(scene, np.array([-100.0, 0.0, 0.0]), ROWS) == 0.0).all()  # black, no less


@pytest.mark.parametrize("count", sh.COUNTS)
def test_who_moves_along_with_a_vehicle_sees_the_same_colours(count: int) -> None:
    car, drive, eye = shiny(4, count), turned_pose(), np.array([4.0, 1.0, 0.5])
    there = drive[:3, :3] @ eye + drive[:3, 3]
    np.testing.assert_allclose(colours_seen(moved(car, drive), there, ROWS), colours_seen(car, eye, ROWS), atol=1e-5)


@pytest.mark.parametrize("count", sh.COUNTS)
def test_a_mirror_image_looks_from_the_mirrored_place_like_the_original(count: int) -> None:
    car, eye, flip = shiny(5, count), np.array([4.0, 1.0, 0.5]), np.array([1.0, -1.0, 1.0])
    mirrored = replace(car, means=car.means * flip, sh_rest=sh.rotate_coefficients(car.sh_rest, np.diag(flip)))
    np.testing.assert_allclose(colours_seen(mirrored, eye * flip, ROWS), colours_seen(car, eye, ROWS), atol=1e-5)


def test_turning_there_and_back_changes_nothing() -> None:
    rest, turn = shiny(6, 15).sh_rest, turned_pose()[:3, :3]
    np.testing.assert_allclose(sh.rotate_coefficients(sh.rotate_coefficients(rest, turn), turn.T), rest, atol=1e-6)


def test_parts_of_different_degrees_make_a_whole_of_the_highest() -> None:
    plain, rich = shiny(7, 0), shiny(8, 8)
    whole = concatenate([plain, rich])
    assert whole.sh_rest.shape == (40, 8, 3) and not whole.sh_rest[:20].any()
    np.testing.assert_array_equal(whole.take(np.arange(20, 40)).sh_rest, rich.sh_rest)


def test_a_number_of_coefficients_between_the_degrees_is_refused() -> None:
    with pytest.raises(ValueError, match="sh_rest"):
        shiny(9, 5)
