"""Dense depth from sparse returns; thinning; sky."""

from itertools import pairwise

import numpy as np
import pytest
from slow_raster import covariances_of

from tasks.render.scene import surfels
from tasks.render.scene.depth import dense_depth, sparse_depth
from tasks.render.scene.sky import look_up_sky, pixel_directions, sky_cells, sky_of_views
from tasks.render.scene.surfels import BACKGROUND, PhotoDiscs, choose_discs, discs_of_photo, discs_to_gaussians

INTRINSICS = np.array([[80.0, 0.0, 40.0], [0.0, 80.0, 30.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 80, 60


def plane_depth() -> np.ndarray:
    """Ground 1.5 m under a level camera, below the horizon's neighbourhood."""
    v = np.arange(HEIGHT)[:, None] + 0.5
    return np.where(v > 34, 1.5 * 80.0 / np.maximum(v - 30.0, 1e-3), 0.0) * np.ones((1, WIDTH))


def test_gaps_on_a_plane_are_closed_exactly() -> None:
    truth = plane_depth()
    sparse = np.zeros((HEIGHT, WIDTH), np.float32)
    rows = [42, 45, 48, 52, 56, 59]  # rings
    sparse[rows, 1::3] = truth[rows, 1::3]
    label = np.where(sparse > 0, -1, -2).astype(np.int32)
    grey = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    dense, labels = dense_depth(sparse, label, grey)
    inside = np.zeros_like(truth, bool)
    inside[43:60, 4:75] = True  # above, noise would be smoothed one-sidedly
    assert (dense[inside] > 0).all() and (labels[inside] == -1).all()
    np.testing.assert_allclose(dense[inside], truth[inside], rtol=0.02)


def test_a_gap_takes_the_depth_of_the_surface_its_colour_belongs_to() -> None:
    sparse = np.zeros((HEIGHT, WIDTH), np.float32)
    sparse[:, 20], sparse[:, 30] = 5.0, 25.0
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    rgb[:, 28:] = 0.8  # the edge of the near, dark surface is at column 28
    dense, _ = dense_depth(sparse, np.where(sparse > 0, -1, -2).astype(np.int32), rgb)
    assert np.allclose(dense[:, 21:28], 5.0) and np.allclose(dense[:, 28:30], 25.0)


def test_nothing_is_invented_beyond_the_last_return() -> None:
    sparse = np.zeros((HEIGHT, WIDTH), np.float32)
    sparse[40:50, 30:50] = 8.0
    label = np.where(sparse > 0, -1, -2).astype(np.int32)
    dense, _ = dense_depth(sparse, label, np.zeros((HEIGHT, WIDTH, 3), np.float32))
    assert not dense[:35].any() and not dense[:, :25].any()


def test_a_point_seen_through_a_nearer_surface_is_removed() -> None:
    u, v = np.meshgrid(np.arange(20, 60, 2) + 0.5, np.arange(10, 50, 2) + 0.5)
    near = np.stack([(u - 40) / 80 * 6.0, (v - 30) / 80 * 6.0, np.full_like(u, 6.0)], -1).reshape(-1, 3)
    behind = np.array([[(41.5 - 40) / 80 * 20.0, (31.5 - 30) / 80 * 20.0, 20.0]])
    beside = np.array([[(70.5 - 40) / 80 * 20.0, 0.0, 20.0]])
    points = np.concatenate([near, behind, beside])
    depth, label = sparse_depth([(i, one[None]) for i, one in enumerate(points)], INTRINSICS, np.eye(4), WIDTH, HEIGHT)
    assert depth[31, 41] == 0.0 and label[31, 41] == -2
    assert depth[30, 70] == pytest.approx(20.0) and label[30, 70] == len(points) - 1


def look(colour: tuple[float, float, float], depth: float, ahead: float) -> PhotoDiscs:
    """A wall that faces a camera `ahead` metres down the road."""
    zs, pose = np.full((HEIGHT, WIDTH), depth, np.float32), np.eye(4)
    pose[2, 3] = ahead
    rgb = np.broadcast_to(np.array(colour, np.float32), (HEIGHT, WIDTH, 3))
    discs = discs_of_photo(rgb, zs, np.full((HEIGHT, WIDTH), -1, np.int32), INTRINSICS, pose)
    n = len(discs.points)
    return PhotoDiscs(discs, np.full(n, BACKGROUND, np.int32), np.zeros(n, bool), zs, INTRINSICS, pose, {})


def test_the_closest_look_at_a_surface_is_the_one_that_is_kept() -> None:
    near, far = look((1, 0, 0), 4.0, 12.0), look((0, 0, 1), 16.0, 0.0)  # the same wall at z = 16
    for order in ((near, far), (far, near)):
        kept = choose_discs(order)[BACKGROUND]
        middle = np.abs(kept.points[:, :2]).max(axis=1) < 1.2  # both photos see it
        assert (kept.rgb[middle] == [1, 0, 0]).all()
        outside = np.abs(kept.points[:, 0]) > 3.0
        assert outside.any() and (kept.rgb[outside] == [0, 0, 1]).all()


def test_a_second_photo_from_the_same_place_adds_nothing() -> None:
    first = look((0.5, 0.5, 0.5), 9.0, 0.0)
    assert len(choose_discs([first, first])[BACKGROUND].points) == len(first.discs.points)


def test_kept_discs_are_those_that_nothing_kept_before_shows_as_finely() -> None:
    """A ramp seen from two places, whose discs cross every band: held against all that is kept, each time anew."""
    depth = (np.linspace(3.0, 90.0, WIDTH) * np.ones((HEIGHT, 1))).astype(np.float32)
    rgb = np.random.default_rng(3).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    looks, expected = [], []
    for ahead in (0.0, 2.5):
        pose, zs = np.eye(4), depth - np.float32(ahead)
        pose[:3, 3] = 0.1, 0.0, ahead
        discs = discs_of_photo(rgb, zs, np.full(zs.shape, -1, np.int32), INTRINSICS, pose)
        n = len(discs.points)
        looks.append(PhotoDiscs(discs, np.full(n, BACKGROUND, np.int32), np.zeros(n, bool), zs, INTRINSICS, pose, {}))
    for nearest, farthest in pairwise((0.0, *surfels.BANDS_M, np.inf)):
        for one in looks:
            covered, away = np.zeros(depth.shape, bool), one.discs.spacing * INTRINSICS[0, 0]
            for part in expected:
                disc = part.points, part.across, part.down, part.spacing
                surfels._mark_covered(*disc, np.linalg.inv(one.scene_from_camera), INTRINSICS, one.depth, covered)
            in_band = (away > nearest) & (away <= farthest)
            expected.append(one.discs.take(np.flatnonzero(in_band & ~covered[tuple(one.discs.pixels.T)])))
    kept = choose_discs(looks)[BACKGROUND]
    np.testing.assert_array_equal(kept.points, np.concatenate([part.points for part in expected]))
    assert len(looks[0].discs.points) < len(kept.points) < sum(len(look.discs.points) for look in looks)


def test_discs_become_flat_gaussians_that_lie_in_their_surface() -> None:
    gaussians = discs_to_gaussians(look((1, 1, 1), 4.0, 0.0).discs)
    covariances = covariances_of(gaussians)
    assert np.sqrt(covariances[:, 2, 2]).max() < 0.2 * np.sqrt(covariances[:, 0, 0]).min()
    assert np.abs(np.linalg.norm(gaussians.quats, axis=1) - 1.0).max() < 1e-5


def test_a_plain_wall_needs_few_discs_and_a_patterned_one_all() -> None:
    zs, label = np.full((HEIGHT, WIDTH), 9.0, np.float32), np.full((HEIGHT, WIDTH), -1, np.int32)
    noise = np.random.default_rng(0).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    plain = discs_of_photo(0 * noise, zs, label, INTRINSICS, np.eye(4))
    patterned = discs_of_photo(noise, zs, label, INTRINSICS, np.eye(4))
    assert len(plain.points) == HEIGHT * WIDTH // 16
    assert len(patterned.points) > 0.98 * HEIGHT * WIDTH


def test_the_sky_is_the_colour_that_was_seen_in_its_direction() -> None:
    rays = pixel_directions(INTRINSICS, np.array([[0, 0, 1.0, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]), 80, 60)
    up = rays[..., 2] > 0.02
    colours = np.zeros((60, 80, 3), np.float32)
    colours[..., 0] = np.linspace(0, 1, 80)[None, :]
    sky = sky_of_views([(rays[up], colours[up], np.ones(up.sum(), bool))])
    pose = np.array([[0, 0, 1.0, 50.0], [-1, 0, 0, -9.0], [0, -1, 0, 3.0], [0, 0, 0, 1]])  # elsewhere, same heading
    seen = look_up_sky(sky.cells, sky_cells(INTRINSICS, pose, 80, 60))
    inside = np.zeros((60, 80), bool)
    inside[2:24, 3:77] = True
    assert np.abs(seen[inside] - colours[inside]).max() < 0.05
