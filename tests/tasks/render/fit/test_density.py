"""Relocation and growth: the picture stays, the number does what it was told."""

import numpy as np
import pytest

from tasks.render.fit.state import AdamArray, FitState, logits_of, opacities_of, relocate_and_grow, split_opacity
from tasks.render.settings import FitSettings
from tasks.render.splatting.gaussians import Gaussians, concatenate
from tasks.render.splatting.raster import forward

K = np.array([[40.0, 0.0, 16.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]])


def one(opacity: float, sigma: float) -> Gaussians:
    return Gaussians(
        np.array([[0.0, 0.0, 4.0]], np.float32),
        np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.full((1, 3), np.log(sigma), np.float32),
        np.full(1, opacity, np.float32),
        np.ones((1, 3), np.float32),
    )


@pytest.mark.parametrize("opacity", [0.2, 0.6, 0.95])
@pytest.mark.parametrize("copies", [2, 3, 6])
def test_copies_in_place_of_one_gaussian_show_the_same(opacity: float, copies: int) -> None:
    opacities, shrink = split_opacity(np.array([opacity]), np.array([copies]))
    assert 1.0 - (1.0 - opacities[0]) ** copies == pytest.approx(opacity)
    before = forward(one(opacity, 0.5), K, np.eye(4), 32, 32, np.zeros(3, np.float32)).view.rgb
    parts = [one(opacities[0], 0.5 * shrink[0])] * copies
    after = forward(concatenate(parts), K, np.eye(4), 32, 32, np.zeros(3, np.float32)).view.rgb
    assert after[16].sum() == pytest.approx(before[16].sum(), rel=0.05)  # the paper's equation: along a line through it
    assert np.abs(after - before).max() < 0.15
    assert after[16, 16] == pytest.approx(before[16, 16], abs=0.01)


def state(n: int, owners: int) -> FitState:
    rng = np.random.default_rng(0)
    opacities = np.where(np.arange(n) % 4 == 0, 0.001, 0.6)[:, None]
    learned = {
        "means": AdamArray.unstepped(rng.normal(size=(n, 3))),
        "quats": AdamArray.unstepped(rng.normal(size=(n, 4))),
        "log_scales": AdamArray.unstepped(np.full((n, 3), -3.0)),
        "logits": AdamArray.unstepped(logits_of(opacities)),
        "colours": AdamArray.unstepped(rng.uniform(0, 1, (n, 3))),
    }
    owner = np.sort(rng.integers(-1, owners, n)).astype(np.int32)
    return FitState(100, learned, owner, np.zeros(n, bool), np.ones(n, np.float32), np.ones(n, np.float32))


def test_dead_gaussians_are_put_where_others_are_and_the_number_grows_to_its_limit() -> None:
    settings = FitSettings(most_gaussians=420, growth=0.04)
    fitted = state(400, 3)
    relocate_and_grow(fitted, settings)
    assert len(fitted) == 416
    assert (opacities_of(fitted.learned["logits"].values) >= 0.004).all()
    assert (np.diff(fitted.owner) >= 0).all()
    assert {len(fitted.learned[name].values) for name in fitted.learned} == {416}
    fitted.wanted[:] = 1.0
    relocate_and_grow(fitted, settings)
    assert len(fitted) == 420


def test_what_nobody_asked_for_is_not_copied() -> None:
    fitted = state(400, 1)
    fitted.wanted[:200] = 0.0
    before = fitted.learned["colours"].values.copy()
    relocate_and_grow(fitted, FitSettings(most_gaussians=500, growth=0.1))
    new = fitted.learned["colours"].values
    copies = [np.sum((new == row).all(axis=1)) for row in before[:200]]
    assert max(copies) == 1


def test_the_same_seed_refines_the_same_way() -> None:
    first, second, third = state(300, 2), state(300, 2), state(300, 2)
    relocate_and_grow(first, FitSettings())
    relocate_and_grow(second, FitSettings())
    relocate_and_grow(third, FitSettings(seed=1))
    np.testing.assert_array_equal(first.learned["means"].values, second.learned["means"].values)
    assert not np.array_equal(first.learned["means"].values, third.learned["means"].values)
