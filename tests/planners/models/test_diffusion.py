"""Anchors, noise, and the decoder of a diffusion planner, piece by piece."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from planners.data.batch import BevLayout
from planners.models.diffusiondrive import (
    FOCAL_ALPHA,
    DiffusionDecoder,
    add_noise,
    alphas_cumprod,
    checked_anchors,
    cluster_anchors,
    ddim_step,
    denormalise_points,
    focal_loss,
    grid_coordinates,
    normalise_points,
    sinusoids,
)
from planners.models.planner import read_array
from planners.models.settings import DiffusionDriveSettings, Sizes


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


def test_positions_become_units_and_back() -> None:
    corners = torch.tensor([[-1.2, -20.0], [55.7, 26.0]])
    torch.testing.assert_close(normalise_points(corners), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    points = torch.randn(5, 2) * 20
    torch.testing.assert_close(denormalise_points(normalise_points(points)), points, atol=1e-4, rtol=0)


def test_the_focal_loss_forgives_what_is_nearly_right() -> None:
    logits, target = torch.tensor([0.0, 0.0]), torch.tensor([1.0, 0.0])
    half = torch.tensor([FOCAL_ALPHA, 1 - FOCAL_ALPHA]) * 0.25 * np.log(2)
    torch.testing.assert_close(focal_loss(logits, target), half.float())
    assert focal_loss(torch.tensor(4.0), torch.tensor(1.0)) < 1e-4 < focal_loss(torch.tensor(-4.0), torch.tensor(1.0))


def test_points_fall_into_the_cells_that_the_raster_draws_them_in() -> None:
    layout = BevLayout(ahead_m=30.0, behind_m=10.0, side_m=20.0, cell_m=10.0)  # 4 x 4 cells
    raster = torch.arange(16.0).reshape(1, 1, *layout.shape)
    points = torch.tensor([[25.0, 15.0], [25.0, -15.0], [-5.0, 15.0], [5.0, -5.0]])
    read = torch.nn.functional.grid_sample(raster, grid_coordinates(points, layout)[None, None], align_corners=False)
    assert read.flatten().tolist() == [0.0, 3.0, 12.0, 10.0]


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


def test_centred_points_look_as_if_the_raster_reached_behind_as_far_as_ahead() -> None:
    """GridSampleCrossBEVAttention: y / 32 is the column, x / 32 the row, over a raster of 0 .. 32 m."""
    layout = BevLayout(public=True)
    points = torch.randn(5, 2) * 16
    torch.testing.assert_close(
        grid_coordinates(points, layout, centred=True), points.flip(-1) / 32, rtol=1e-5, atol=1e-6
    )


def test_closed_waves_end_at_the_slowest() -> None:
    """SinusoidalPosEmb: rates 10,000^(-i / (n - 1)) for i = 0 .. n - 1; else the last one is one step before."""
    step = torch.tensor([1.0])
    assert sinusoids(step, 8, closed=True)[0, 3].item() == pytest.approx(1e-4)
    assert sinusoids(step, 8)[0, 3].item() == pytest.approx(1e-3)


def test_waves_tell_positions_apart_from_a_metre_to_kilometres() -> None:
    x = torch.tensor([0.0, 0.25, 100.0])
    told = sinusoids(x, 32, 2 * torch.pi)
    assert told.shape == (3, 32)
    torch.testing.assert_close(told[0], torch.cat([torch.zeros(16), torch.ones(16)]))
    assert told[1, 0].item() == pytest.approx(1.0)  # a quarter of the shortest wave
    assert torch.cdist(told, told)[~torch.eye(3, dtype=torch.bool)].min() > 0.5


def test_a_layer_of_a_cascade_starts_where_the_layer_before_put_the_plans() -> None:
    torch.manual_seed(0)
    decoder = DiffusionDecoder(DiffusionDriveSettings(sizes=Sizes(width=16, heads=2, hidden=32), dropout=0.0))
    for layer in decoder.layers:
        torch.nn.init.zeros_(layer.offsets[-1].weight)
        torch.nn.init.constant_(layer.offsets[-1].bias, 1.0)
    points, base = torch.randn(2, 3, 8, 2), torch.zeros(2, 3, 8, 2)
    scene = torch.randn(2, 16, 4, 4), torch.randn(2, 5, 16), torch.randn(2, 1, 16)
    (first, _), (second, _) = decoder(points, base, torch.tensor([0, 49]), *scene)
    torch.testing.assert_close(first[..., :2], torch.ones(2, 3, 8, 2))
    torch.testing.assert_close(second[..., :2], torch.full((2, 3, 8, 2), 2.0))
