"""Detection and segmentation losses: closed forms, and the matching against trying every one."""

import itertools
import math

import pytest
import torch
from torch.nn import functional as F

from planners.data.bev import BevClass
from planners.models.layers import N_CLASSES, AgentHead, BevHead, agent_losses, bev_loss

SURE = 50.0


def vehicles(n: int, seed: int = 0) -> torch.Tensor:
    made = torch.Generator().manual_seed(seed)
    return torch.rand(1, n, 5, generator=made) * torch.tensor([30.0, 10.0, 1.0, 5.0, 2.0])


def test_perfect_detections_in_any_order_cost_nothing() -> None:
    agents, valid = vehicles(4), torch.tensor([[True, True, False, True]])
    order = torch.tensor([3, 1, 0, 2])
    logits = torch.where(valid, SURE, -SURE)[:, order]
    there, off = agent_losses(agents[:, order], logits, agents, valid, 10.0, 1.0)
    assert there.item() == pytest.approx(0.0, abs=1e-6) and off.item() == 0.0


def test_a_boxes_error_is_the_sum_over_its_numbers_and_the_mean_over_vehicles() -> None:
    agents, valid = vehicles(3), torch.tensor([[True, True, False]])
    off_by = torch.tensor([0.5, 0.0, 0.1, 0.2, 0.0])
    _, off = agent_losses(agents + off_by, torch.where(valid, SURE, -SURE), agents, valid, 10.0, 1.0)
    assert off.item() == pytest.approx(0.8, rel=1e-5)


def test_the_matching_is_the_cheapest_of_all() -> None:
    agents, boxes = vehicles(4), vehicles(4, seed=1)
    valid, logits = torch.tensor([[True, False, True, True]]), torch.tensor([[0.3, -1.0, 2.0, 0.1]])
    there, off = agent_losses(boxes, logits, agents, valid, 10.0, 1.0)

    def terms(order: tuple[int, ...]) -> tuple[float, float, float]:
        wanted, mask = agents[:, list(order)], valid[:, list(order)].float()
        unsure = F.binary_cross_entropy_with_logits(logits, mask).item()
        apart = (boxes - wanted).abs() * mask[..., None]
        return 10 * unsure * 4 + apart[..., :2].sum().item(), unsure, apart.sum().item() / 3

    best = min(terms(order) for order in itertools.permutations(range(4)))
    assert (there.item(), off.item()) == pytest.approx(best[1:], rel=1e-5)


def test_a_vehicle_beside_the_cameras_view_is_not_asked_for() -> None:
    agents = torch.tensor([[[1.0, 20.0, 0.0, 4.0, 2.0]]])  # at 87 degrees
    there, off = agent_losses(
        agents + 5, torch.full((1, 1), -SURE), agents, torch.ones(1, 1, dtype=torch.bool), 10.0, 1.0
    )
    assert there.item() == pytest.approx(0.0, abs=1e-6) and off.item() == 0.0


def test_a_perfect_raster_costs_nothing_and_the_route_counts_as_centre_line() -> None:
    raster = torch.arange(8, dtype=torch.uint8).repeat(2, 1, 4, 1)  # (2, 1, 4, 8), every class
    shown = torch.where(raster[:, 0] == BevClass.ROUTE, BevClass.CENTERLINE, raster[:, 0]).long()
    logits = F.one_hot(shown, N_CLASSES).permute(0, 3, 1, 2) * SURE
    assert bev_loss(logits, raster).item() == pytest.approx(0.0, abs=1e-6)
    assert bev_loss(torch.zeros(2, N_CLASSES, 4, 8), raster).item() == pytest.approx(math.log(N_CLASSES), rel=1e-5)


def test_heads_keep_to_their_shapes_and_bounds() -> None:
    torch.manual_seed(0)
    assert BevHead(4, (6, 10))(torch.randn(2, 4, 8, 8)).shape == (2, N_CLASSES, 6, 10)
    boxes, logits = AgentHead(8, 16, 32.0)(torch.randn(2, 5, 8) * 1000)
    assert boxes.shape == (2, 5, 5) and logits.shape == (2, 5)
    assert boxes[..., :2].abs().max() <= 32.0 and boxes[..., 2].abs().max() <= math.pi + 1e-6
