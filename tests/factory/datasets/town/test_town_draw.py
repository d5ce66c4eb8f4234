"""The renderer and the lidar: true perspective, occlusion, shadows, textures that stay in the world."""

import numpy as np
import pytest

from factory.datasets.town import textures as tx
from factory.datasets.town.draw import (
    MOUNT_M,
    REAR_AXLE_Z_M,
    SHADOW_SIZE,
    build_rig,
    cast_shadows,
    paint,
    scan_lidar,
    sun_over,
    world_from_ego,
)
from factory.datasets.town.raster import LitScene, MeshBuilder
from factory.datasets.town.settings import CAMERA_NAMES

FRONT = build_rig(("ring_front_center",), 320, 180)[0]
RED = (1.0, 0.0, 0.0)
GREEN = (0.0, 1.0, 0.0)


def staged(builder: MeshBuilder, shadows: bool = False) -> LitScene:
    mesh = builder.mesh()
    sun = sun_over(np.zeros(2), 0.4, 0.8)
    shadow = np.full((SHADOW_SIZE, SHADOW_SIZE), -1e9, np.float32)
    if shadows:
        cast_shadows(shadow, mesh, sun)
    return LitScene(mesh, shadow, sun, np.zeros((1, 1, 9)), 1)


def lamp(builder: MeshBuilder, at: tuple[float, float, float], size: float, colour: tuple[float, float, float]) -> None:
    builder.box(at, (size, size, size), tx.GLOW, colour)


def lawn(builder: MeshBuilder) -> None:
    corners = np.array([[[-80, -80], [80, -80], [80, 80], [-80, 80]]], float)
    builder.quads(np.concatenate([corners, np.zeros((1, 4, 1))], axis=-1), corners, tx.GRASS)


@pytest.mark.parametrize("camera", build_rig(CAMERA_NAMES, 320, 180), ids=CAMERA_NAMES)
def test_a_point_is_drawn_where_the_calibration_projects_it(camera) -> None:  # type: ignore[no-untyped-def]
    ego = world_from_ego(np.array([10.0, -4.0, 0.7]))
    in_camera = np.array([1.5, -0.6, 14.0, 1.0])  # right, up, ahead
    world = ego @ camera.ego_from_camera @ in_camera
    builder = MeshBuilder()
    lamp(builder, tuple(world[:3]), 0.3, RED)
    picture = paint(staged(builder), camera, ego).astype(int)
    rows, columns = np.nonzero((picture[..., 0] > 150) & (picture[..., 1] < 120))
    projected = camera.intrinsics @ in_camera[:3] / in_camera[2]
    assert abs(columns.mean() + 0.5 - projected[0]) < 0.5
    assert abs(rows.mean() + 0.5 - projected[1]) < 0.5


def test_the_nearer_of_two_things_hides_the_other() -> None:
    ego = world_from_ego(np.zeros(3))
    for first, second in (((20.0, RED), (12.0, GREEN)), ((12.0, GREEN), (20.0, RED))):
        builder = MeshBuilder()
        for distance, colour in (first, second):
            lamp(builder, (distance, 0.0, 1.65), 1.0, colour)
        centre = paint(staged(builder), FRONT, ego)[90, 160]
        assert centre[1] > centre[0]


def test_a_surface_that_passes_beside_and_behind_the_camera_is_drawn_to_the_picture_edge() -> None:
    builder = MeshBuilder()
    lawn(builder)
    picture = paint(staged(builder), FRONT, world_from_ego(np.zeros(3))).astype(int)
    assert (picture[-1, :, 1] > picture[-1, :, 2]).all()  # lawn below, all along the lower edge
    assert (picture[0, :, 2] > picture[0, :, 0] - 8).all()  # sky above


def test_a_place_has_one_colour_from_wherever_it_is_seen() -> None:
    """Big texture cells of a house front, seen from two places at the same pixel size."""
    builder = MeshBuilder()
    builder.face([(30, 40, 0), (30, -40, 0), (30, -40, 12), (30, 40, 12)], tx.FACADE, seed=4)
    scene = staged(builder)
    shifted = 8.0
    one = paint(scene, FRONT, world_from_ego(np.array([0.0, 0.0, 0.0]))).astype(float)
    two = paint(scene, FRONT, world_from_ego(np.array([0.0, shifted, 0.0]))).astype(float)
    pixels = round(shifted * FRONT.intrinsics[0, 0] / (30.0 - 1.62))
    same = np.abs(one[40:100, : 320 - pixels] - two[40:100, pixels:]).mean()
    other = np.abs(one[40:100] - two[40:100]).mean()
    assert same < 0.35 * other


def test_what_stands_in_the_sun_casts_a_shadow() -> None:
    builder = MeshBuilder()
    lawn(builder)
    ego = world_from_ego(np.zeros(3))
    bright = paint(staged(builder, shadows=True), FRONT, ego)[120:].astype(float).mean()
    builder.face([(0, -40, 30.0), (60, -40, 30.0), (60, 40, 30.0), (0, 40, 30.0)], tx.METAL)
    sun = sun_over(np.zeros(2), 0.4, 0.8).direction
    assert sun[2] > 0
    dark = paint(staged(builder, shadows=True), FRONT, ego)
    shifted = -30.0 * sun[:2] / sun[2]  # where the plate's shadow lies
    assert np.abs(shifted).max() < 40.0
    assert dark[170:].astype(float).mean() < 0.75 * bright


def test_the_lidar_measures_the_road_and_a_wall_where_they_are() -> None:
    builder = MeshBuilder()
    lawn(builder)
    builder.face([(25, 60, 0), (25, -60, 0), (25, -60, 20), (25, 60, 20)], tx.ISLAND_STONE)
    sweep = scan_lidar(staged(builder), world_from_ego(np.zeros(3)), 24, 360)
    points = sweep.points
    wall = np.abs(points[:, 0] - 25.0) < 1e-3
    ground = np.abs(points[:, 2] + REAR_AXLE_Z_M) < 1e-3
    assert wall.sum() > 200
    assert ground.sum() > 1500
    assert (wall | ground).all()
    assert not (points[:, 0] > 25.5).any()  # a beam at the foot of the wall may meet the lawn that far behind
    assert np.hypot(*(points[ground] - MOUNT_M)[:, :2].T).min() > 3.0
    assert sweep.laser_number.max() < 24
    assert (np.diff(sweep.offset_ns[sweep.laser_number == 3]) > 0).all()
