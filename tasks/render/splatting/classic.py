"""Gaussians that one screen filter was learned with, made for gsplat's `classic`, which knows no other."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tasks.render.splatting.gaussians import Gaussians, rotations_of
from tasks.render.splatting.project import CLASSIC, NEAR_M, ScreenFilter
from tasks.world.arrays import Array, Ints
from tasks.world.clip import Pinhole

MOST_OPAQUE = 1.0 - 2.0**-11  # its logit is finite in 16 bits too


def made_classic(gaussians: Gaussians, screen: ScreenFilter, eyes: Sequence[Pinhole]) -> Gaussians:
    """With the opacities at which `CLASSIC` leaves each, from `eyes` in their own frame, the light that `screen` does.

    Light is opacity times area: of a screen covariance C, a filter that keeps light leaves sqrt(det C) of it (Yu et al.
    2024, eq. 9), one that does not sqrt(det(C + dilation)). The mean over the eyes counts by the area that they see.
    A Gaussian that no eye sees stays as it is.
    """
    weight, light = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for eye in eyes:
        index, half_axes = _half_axes(gaussians, eye)
        area = _area(half_axes, screen.dilation_px2)
        weight[index] += area
        light[index] += (
            area * (_area(half_axes, 0.0) if screen.keeps_light else area) / _area(half_axes, CLASSIC.dilation_px2)
        )
    share = np.divide(light, weight, out=np.ones_like(light), where=weight > 0.0)
    return replace(gaussians, opacities=np.minimum(gaussians.opacities * share, MOST_OPAQUE).astype(np.float32))


def _half_axes(gaussians: Gaussians, eye: Pinhole) -> tuple[Ints, Array]:
    """Which Gaussians have their middle in the picture (M,), and their half axes there (M, 2, 3) [px]."""
    k, camera_from_scene = eye.intrinsics, np.linalg.inv(eye.world_from_camera)
    places = gaussians.means.astype(np.float64) @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]
    z = np.maximum(places[:, 2], NEAR_M)
    u, v = k[0, 0] * places[:, 0] / z + k[0, 2], k[1, 1] * places[:, 1] / z + k[1, 2]
    index = np.flatnonzero((places[:, 2] > NEAR_M) & (u > 0) & (u < eye.width) & (v > 0) & (v < eye.height))
    ahead = places[index, 2:, None]
    axes = camera_from_scene[:3, :3] @ rotations_of(gaussians.quats[index])
    axes *= np.exp(gaussians.log_scales[index].astype(np.float64))[:, None]
    slopes = axes[:, :2] - places[index, :2, None] / ahead * axes[:, 2:]
    return index, np.array([[k[0, 0]], [k[1, 1]]]) / ahead * slopes


def _area(half_axes: Array, dilation_px2: float) -> Array:
    """(M,) square root of the determinant of screen covariances with half axes (M, 2, 3)."""
    du, dv = half_axes[:, 0], half_axes[:, 1]
    xx, yy = ((d * d).sum(axis=1) + dilation_px2 for d in (du, dv))
    return np.asarray(np.sqrt(np.maximum(xx * yy - (du * dv).sum(axis=1) ** 2, 0.0)))
