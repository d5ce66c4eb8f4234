"""The normal equations against derivatives by differences and a dense elimination of the points."""

from dataclasses import replace

import drawn_rig
import numpy as np
import pytest
from drawn_rig import cameras, files

from tasks.render.rig.adjust import (
    N_CAMERA,
    CornerTracks,
    Rig,
    RigPhotos,
    cholesky_solve,
    corner_rays,
    initial_rig,
    motions_of_twists,
    normal_equations,
    reprojection_residuals,
    triangulate_points,
    twists_of,
)

STEP = 1e-6


def drawn() -> tuple[Rig, RigPhotos, CornerTracks, np.ndarray]:
    """Two cameras at three instants that both see five points, on which the rig does not quite agree."""
    rig, shots = initial_rig(cameras()[:2], files(list(drawn_rig.YAWS_DEG)[:2])[:6])
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(8, 14, 5), rng.uniform(4, 8, 5), rng.uniform(0, 3, 5)])
    starts, view_of = np.arange(0, 31, 6), np.tile(np.arange(6), 5)
    matched = CornerTracks(starts, view_of, np.zeros((30, 2)), np.ones(30))
    matched = replace(matched, at=off(rig, shots, matched, points) + rng.normal(size=(30, 2)))
    step = rng.normal(size=6 * 3 + 2 * N_CAMERA) * 1e-3
    step[:18] = 0.0
    return rig.moved(step), shots, matched, points


def off(rig: Rig, shots: RigPhotos, matched: CornerTracks, points: np.ndarray) -> np.ndarray:
    poses = np.linalg.inv(rig.ego_poses(shots)), np.linalg.inv(rig.ego_from_camera)
    return reprojection_residuals(
        points, matched.point_of, matched.view_of, matched.at, shots.camera_of, *poses, rig.lenses
    )


def test_the_points_are_eliminated_as_a_dense_solver_would() -> None:
    rig, shots, matched, points = drawn()
    n = 6 * 3 + 2 * N_CAMERA
    weights = np.random.default_rng(0).uniform(0.5, 1.5, 30)
    weights[7] = 0.0
    places = np.concatenate(
        [6 * shots.instant_of[matched.view_of, None] + np.arange(6),
         18 + N_CAMERA * shots.camera_of[matched.view_of, None] + np.arange(N_CAMERA)], axis=1
    )  # fmt: skip
    poses = np.linalg.inv(rig.ego_poses(shots)), np.linalg.inv(rig.ego_from_camera)
    matrix, right, inverses, sides, mixed = normal_equations(
        points, matched.starts, matched.view_of, matched.at, weights, 0.0, shots.camera_of, places, *poses, rig.lenses,
        n,
    )  # fmt: skip
    steps = np.eye(n + 15) * STEP

    def moved(step: np.ndarray) -> np.ndarray:
        return off(rig.moved(step[:n]), shots, matched, points + step[n:].reshape(-1, 3))

    slopes = np.stack([(moved(s) - moved(-s)) / (2 * STEP) for s in steps], axis=-1).reshape(-1, n + 15)
    wide = np.repeat(weights, 2)[:, None]
    full, gradient = slopes.T @ (wide * slopes), -slopes.T @ (wide[:, 0] * off(rig, shots, matched, points).ravel())
    by_point = np.linalg.inv(full[n:, n:])
    np.testing.assert_allclose(matrix, full[:n, :n] - full[:n, n:] @ by_point @ full[n:, :n], rtol=2e-3, atol=50.0)
    np.testing.assert_allclose(right, gradient[:n] - full[:n, n:] @ by_point @ gradient[n:], rtol=2e-3, atol=5.0)
    step = np.random.default_rng(1).normal(size=n) * 1e-3
    dense = by_point @ (gradient[n:] - full[n:, :n] @ step)
    moves = np.add.reduceat(np.einsum("nkm,nk->nm", mixed, step[places]), matched.starts[:-1])
    ours = np.einsum("pij,pj->pi", inverses, sides - moves)
    np.testing.assert_allclose(ours.ravel(), dense, rtol=1e-2, atol=1e-5)


def test_cholesky_solves_what_numpy_solves_and_says_where_there_is_nothing_to_solve() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(12, 9))
    matrix, right = half.T @ half, rng.normal(size=9)
    np.testing.assert_allclose(cholesky_solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
    assert np.isnan(cholesky_solve(-matrix, right)).all()


def test_rays_meet_where_the_points_are() -> None:
    rig, shots = initial_rig(cameras()[:2], files(list(drawn_rig.YAWS_DEG)[:2])[:6])
    points = np.array([[9.0, 5.0, 1.0], [12.0, 7.0, 2.5]])
    matched = CornerTracks(np.array([0, 6, 12]), np.tile(np.arange(6), 2), np.zeros((12, 2)), np.ones(12))
    matched = replace(matched, at=off(rig, shots, matched, points))
    found, there = triangulate_points(rig, shots, matched)
    assert there.all()
    np.testing.assert_allclose(found, points, atol=1e-6)
    eyes, ways = corner_rays(rig, shots, matched)
    assert np.linalg.norm(np.cross(points[matched.point_of] - eyes, ways), axis=1).max() < 1e-6


def test_a_motion_and_its_twist_are_each_other_s_opposite() -> None:
    rows = np.random.default_rng(0).normal(size=(20, 6)) * 0.5
    np.testing.assert_allclose(twists_of(motions_of_twists(rows)), rows, atol=1e-12)
    assert motions_of_twists(np.zeros((1, 6)))[0] == pytest.approx(np.eye(4))
