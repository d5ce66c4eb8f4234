"""Anchors, noise, and the decoder of a diffusion planner, piece by piece."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from planners.data.batch import BevLayout
from planners.models.diffusiondrive import (
    add_noise,
    alphas_cumprod,
    checked_anchors,
    cluster_anchors,
    ddim_step,
    grid_coordinates,
    sinusoids,
)
from planners.models.planner import read_array


def test_anchors_are_the_means_of_well_separated_clusters() -> None:
    rng = np.random.default_rng(0)
    means = np.arange(3)[:, None, None] * 50.0 + rng.normal(size=(3, 8, 2))
    plans = np.concatenate([mean + rng.normal(scale=0.5, size=(40, 8, 2)) for mean in means])
    anchors = cluster_anchors(rng.permutation(plans), 3, seed=1)
    expected = plans.reshape(3, 40, 8, 2).mean(axis=1)
    np.testing.assert_allclose(anchors[anchors[:, 0, 0].argsort()], expected)


def test_anchors_depend_on_the_seed_only_and_read_positions_only() -> None:
    plans = np.random.default_rng(0).normal(size=(50, 8, 3))
    turned = plans.copy()
    turned[..., 2] += 1.0
    assert np.array_equal(cluster_anchors(plans, 5, 3), cluster_anchors(turned, 5, 3))
    assert not np.array_equal(cluster_anchors(plans, 5, 3), cluster_anchors(plans, 5, 4))


def test_as_many_anchors_as_distinct_plans_are_those_plans_and_more_are_refused() -> None:
    plans = np.random.default_rng(0).normal(size=(4, 8, 3)).repeat(3, axis=0)
    anchors = cluster_anchors(plans, 4, seed=0)
    assert sorted(anchors[:, 0, 0]) == pytest.approx(sorted(set(plans[:, 0, 0])))
    with pytest.raises(ValueError, match="5 anchors cannot be made of 4 distinct plans"):
        cluster_anchors(plans, 5, seed=0)


def test_unfit_anchors_are_refused_by_name(tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=r"a\.npy: anchors have shape \(20, 8, 3\), expected"):
        checked_anchors(np.zeros((20, 8, 3)), "a.npy")
    with pytest.raises(ValueError, match=r"a\.npy: anchors hold NaN"):
        checked_anchors(np.full((2, 8, 2), np.nan), "a.npy")
    np.savez(tmp_path / "several.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match=r"anchors=.*several\.npz: expected one array"):
        read_array(str(tmp_path / "several.npz"), "anchors")


def test_the_noise_schedule_is_the_product_of_scaled_linear_betas() -> None:
    levels = alphas_cumprod()
    assert levels[0].item() == pytest.approx(1 - 1e-4)
    second = (1e-4**0.5 + (0.02**0.5 - 1e-4**0.5) / 999) ** 2
    assert levels[1].item() == pytest.approx((1 - 1e-4) * (1 - second))
    assert (levels.diff() < 0).all()
    assert 1 - levels[49].item() == pytest.approx(0.0085, rel=0.05)  # what is left out of 1 where training stops


def test_a_step_with_the_truth_leads_to_the_same_noise_at_the_earlier_level() -> None:
    torch.manual_seed(0)
    truth, noise, levels = torch.rand(3, 8, 2) * 2 - 1, torch.randn(3, 8, 2), alphas_cumprod()
    there = add_noise(truth, noise, levels[40])
    torch.testing.assert_close(
        ddim_step(there, truth, levels[40], levels[20]), add_noise(truth, noise, levels[20]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(ddim_step(there, truth, levels[40], torch.ones(())), truth)


def test_points_fall_into_the_same_cells_of_a_raster_that_is_turned() -> None:
    layout = BevLayout(ahead_m=30.0, behind_m=10.0, side_m=20.0, cell_m=10.0)
    points = torch.tensor([[25.0, 15.0], [-5.0, 15.0], [5.0, -5.0]])
    raster = torch.arange(16.0).reshape(1, 1, *layout.shape)
    there = (
        grid_coordinates(points, layout)[None, None],
        grid_coordinates(points, replace(layout, public=True))[None, None],
    )
    read = torch.nn.functional.grid_sample(raster, there[0], align_corners=False)
    turned = torch.nn.functional.grid_sample(raster.flip(2, 3), there[1], align_corners=False)
    torch.testing.assert_close(read, turned)


def test_closed_waves_end_at_the_slowest() -> None:
    """SinusoidalPosEmb: rates 10,000^(-i / (n - 1)) for i = 0 .. n - 1; else the last one is one step before."""
    step = torch.tensor([1.0])
    assert sinusoids(step, 8, closed=True)[0, 3].item() == pytest.approx(1e-4)
    assert sinusoids(step, 8)[0, 3].item() == pytest.approx(1e-3)
