"""The body of a vehicle that photos show in part."""

import numpy as np
import pytest

from tasks.render.fit.body import FAR_M, unseen_body
from tasks.render.splatting.gaussians import Gaussians


def rear(size: np.ndarray) -> Gaussians:
    """Half of it red, half of it blue."""
    y, z = np.meshgrid(np.linspace(-size[1] / 2, size[1] / 2, 20), np.linspace(-size[2] / 2, size[2] / 2, 20))
    means = np.stack([np.full(y.size, -size[0] / 2), y.ravel(), z.ravel()], 1).astype(np.float32)
    n = len(means)
    colours = np.where(means[:, 1:2] > 0.0, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    return Gaussians(means, quats, np.full((n, 3), -3.0, np.float32), np.full(n, 0.5, np.float32), colours)


@pytest.mark.parametrize("size", [np.array([4.4, 1.9, 1.6]), np.array([10.5, 2.5, 3.0])])
def test_a_body_fills_the_box_where_nothing_was_seen(size: np.ndarray) -> None:
    seen = rear(size)
    body = unseen_body(seen, size)
    assert (np.abs(body.means) <= size / 2).all()
    away = np.linalg.norm(body.means[:, None] - seen.means[None], axis=-1).min(axis=1)
    assert (away > FAR_M).all()
    reach = body.means.max(axis=0)
    assert (reach > 0.8 * size / 2).all(), "front, sides and roof"
    left, right = body.means[:, 1] > 0.3, body.means[:, 1] < -0.3
    assert (body.colours[left, 0] == 1.0).all() and (body.colours[right, 2] == 1.0).all()


def test_what_was_seen_all_around_needs_no_body() -> None:
    size = np.array([4.4, 1.9, 1.6])
    whole = unseen_body(rear(size), size)
    assert len(whole) > 100 and len(unseen_body(whole, size)) < 0.1 * len(whole)
