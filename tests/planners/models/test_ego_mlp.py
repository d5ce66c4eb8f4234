"""Planners without pictures: what they read, what they say."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from planners.data.batch import Batch, BevLayout, Needs
from planners.models.baselines import ConstantVelocity, EgoMlp, EgoMlpBev
from planners.models.planner import Planner
from planners.models.settings import ConstantVelocitySettings, EgoMlpBevSettings, EgoMlpSettings
from tests.planners.made_batch import made_batch

TINY_BEV = EgoMlpBevSettings(
    hidden=(64,), bev=BevLayout(ahead_m=32, cell_m=2.0, times_s=(-0.5, 0.0)), channels=(8, 16), features=32
)


def blind() -> EgoMlp:
    torch.manual_seed(0)
    return EgoMlp(EgoMlpSettings(hidden=(64, 64)), {})


def shown() -> EgoMlpBev:
    torch.manual_seed(0)
    return EgoMlpBev(TINY_BEV, {})


def errors_after(model: Planner, batch: Batch, steps: int, rate: float) -> float:
    """Mean error [m] after learning one batch by heart."""
    optimiser = torch.optim.Adam(model.parameters())
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * (1 - step / steps)
        optimiser.zero_grad()
        torch.stack(list(model(batch).values())).sum().backward()
        optimiser.step()
    return (model.plan(batch) - batch.plan_2hz)[..., :2].norm(dim=-1).mean().item()


def test_constant_velocity_goes_straight_on() -> None:
    batch = made_batch(Needs(), 2)
    plan = ConstantVelocity(ConstantVelocitySettings(), {}).plan(batch)  # at 5 m/s
    assert plan.shape == (2, 8, 3) and not plan[..., 1:].any()
    torch.testing.assert_close(plan[0, :, 0], torch.arange(1, 9) * 2.5)
    slipping = replace(batch, status=batch.status.clone())
    slipping.status[:, 4:6] = torch.tensor([-3.0, 4.0])  # NAVSIM's agent takes the length of the velocity
    torch.testing.assert_close(ConstantVelocity(ConstantVelocitySettings(), {}).plan(slipping), plan)


def test_constant_velocity_cannot_be_trained() -> None:
    with pytest.raises(ValueError, match="nothing to train"):
        ConstantVelocity(ConstantVelocitySettings(), {}).losses(made_batch(Needs(), 2))


@pytest.mark.parametrize("model", [blind(), shown()])
def test_labels_that_are_not_to_be_imitated_weigh_nothing(model: Planner) -> None:
    batch = made_batch(model.needs, 4)
    first = replace(batch, imitate=torch.tensor([True, False, False, False]))
    wild = replace(first, plan_2hz=torch.cat([batch.plan_2hz[:1], batch.plan_2hz[1:] + 1e6]))
    assert torch.equal(model.losses(first)["trajectory"], model.losses(wild)["trajectory"])
    perfect = replace(batch, plan_2hz=model.plan(batch))
    assert model.losses(perfect)["trajectory"].item() == 0.0
    off = replace(perfect, plan_2hz=perfect.plan_2hz + 0.5, imitate=torch.tensor([True, True, True, False]))
    assert model.losses(off)["trajectory"].item() == pytest.approx(0.5 * 3 / 4, rel=1e-4)


@pytest.mark.parametrize("model", [blind(), shown()])
def test_from_constant_velocity_layers_that_say_nothing_keep_the_speed(model: EgoMlp) -> None:
    from_speed = type(model)(replace(model.settings, plan_from="constant_velocity"), {})
    batch, straight = made_batch(model.needs, 4), ConstantVelocity(ConstantVelocitySettings(), {})
    for one in (model, from_speed):
        last = one.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    assert torch.equal(from_speed.plan(batch), straight.plan(batch))
    assert straight.plan(batch).any() and not model.plan(batch).any()


@pytest.mark.slow
def test_it_learns_32_rasters_by_heart() -> None:
    model = shown()
    assert errors_after(model, made_batch(model.needs, 32), 400, 5e-3) < 0.1
