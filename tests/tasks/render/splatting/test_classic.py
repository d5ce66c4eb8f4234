"""Opacities for another screen filter: a Gaussian's light in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.render.splatting.classic import made_classic
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import ANTIALIASED, CLASSIC, FITTED, ScreenFilter
from tasks.world.clip import Pinhole
from tests.tasks.render.splatting.test_ply import some

K = np.array([[100.0, 0.0, 64.0], [0.0, 100.0, 36.0], [0.0, 0.0, 1.0]])


def eye(z: float) -> Pinhole:
    pose = np.eye(4)
    pose[2, 3] = -z
    return Pinhole(K, pose, 128, 72)


def ball(sigma_m: float) -> Gaussians:
    one = replace(some(1, 0), means=np.zeros((1, 3), np.float32), opacities=np.array([0.8], np.float32))
    return replace(one, log_scales=np.full((1, 3), np.log(sigma_m), np.float32))


@pytest.mark.parametrize("screen", [FITTED, ANTIALIASED, ScreenFilter(0.1, False)])
@pytest.mark.parametrize("z", [5.0, 50.0])
def test_a_ball_keeps_its_light(screen: ScreenFilter, z: float) -> None:
    variance = (100.0 * 0.1 / z) ** 2  # px2, of a ball of 0.1 m
    kept = variance if screen.keeps_light else variance + screen.dilation_px2
    found = made_classic(ball(0.1), screen, [eye(z)]).opacities[0]
    assert found == pytest.approx(0.8 * kept / (variance + CLASSIC.dilation_px2), rel=1e-5)


def test_eyes_count_by_what_they_see_and_one_that_no_eye_sees_stays() -> None:
    near, far = (float(made_classic(ball(0.1), FITTED, [eye(z)]).opacities[0]) for z in (5.0, 50.0))
    both = float(made_classic(ball(0.1), FITTED, [eye(5.0), eye(50.0)]).opacities[0])
    assert far < near and abs(both - near) < 0.1 * abs(both - far)
    assert made_classic(ball(0.1), FITTED, [eye(-5.0)]).opacities[0] == np.float32(0.8)
    assert made_classic(ball(0.1), FITTED, []).opacities[0] == np.float32(0.8)


def test_of_a_disc_seen_from_its_edge_less_is_left_than_from_its_face() -> None:
    disc = replace(ball(0.1), quats=np.array([[1.0, 0.0, 0.0, 0.0]], np.float32))
    face, edge = (
        made_classic(replace(disc, log_scales=np.log(np.array([scales], np.float32))), FITTED, [eye(20.0)]).opacities[0]
        for scales in ((0.1, 0.1, 0.005), (0.1, 0.005, 0.1))
    )
    assert edge < 0.3 * face
