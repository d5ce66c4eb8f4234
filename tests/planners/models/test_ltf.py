"""Latent TransFuser: what it minimises and what it sees."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from planners.data.batch import Batch, ImageLayout
from planners.models.backbones import load_pretrained
from planners.models.baselines import ConstantVelocity
from planners.models.layers import LatentFusion
from planners.models.ltf import Ltf
from planners.models.settings import ConstantVelocitySettings, LtfSettings
from tests.planners import scenes
from tests.planners.made_batch import made_batch

TINY = LtfSettings(image=scenes.PICTURE, sizes=scenes.SIZES)


def planner(settings: LtfSettings = TINY) -> Ltf:
    torch.manual_seed(0)
    return Ltf(settings, {})


@cache
def batch(n: int = 4) -> Batch:
    return made_batch(planner().needs, n)


def test_from_constant_velocity_a_head_that_says_nothing_keeps_the_speed() -> None:
    settings = replace(TINY, plan_from="constant_velocity")
    from_zero, from_speed = planner(), planner(settings)
    for one in (from_zero, from_speed):
        last = one.plan_head[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    straight = ConstantVelocity(ConstantVelocitySettings(), {}).plan(batch())
    assert torch.equal(from_speed.plan(batch()), straight)
    assert not from_zero.plan(batch()).any() and straight.any()


def test_a_planner_that_sees_its_speed_alone_plans_the_same_however_it_accelerates() -> None:
    """And another plan at another speed or command; one that sees all is told."""
    here = batch()
    pushed, faster = here.status.clone(), here.status.clone()
    pushed[:, 6:] += 2.0
    faster[:, 4] += 2.0
    for model in (planner(), planner(replace(TINY, status="speed"))):
        plan, blind = model.plan(here), model.settings.status == "speed"
        assert torch.equal(model.plan(replace(here, status=pushed)), plan) == blind
        assert not torch.equal(model.plan(replace(here, status=faster)), plan)


@pytest.mark.parametrize("size", [(32, 64), (64, 352), (96, 256)])
def test_a_picture_may_have_any_size_divisible_by_32(size: tuple[int, int]) -> None:
    settings = replace(TINY, image=ImageLayout(height=size[0], width=size[1]))
    model = planner(settings)
    assert model.plan(made_batch(model.needs, 2)).shape == (2, 8, 3)


def test_a_plan_that_is_its_label_costs_nothing() -> None:
    model = planner().eval()
    told = replace(batch(), plan_2hz=model.plan(batch()))
    assert model.losses(told)["trajectory"].item() == pytest.approx(0.0, abs=1e-6)
    off = replace(told, plan_2hz=told.plan_2hz + torch.tensor([0.3, 0.0, 0.0]))
    assert model.losses(off)["trajectory"].item() == pytest.approx(10 * 0.1, rel=1e-4)


def test_the_latent_counted_once_is_the_latent_of_every_sample() -> None:
    """Before the first exchange nothing tells samples apart: the mean over copies is the mean over one."""
    torch.manual_seed(0)
    fusion = LatentFusion(TINY.fusion).train()
    alone = fusion.latent.stage(0, fusion.latent.enter(fusion.picture))
    copies = fusion.latent.stage(0, fusion.latent.enter(fusion.picture.expand(5, -1, -1, -1)))
    torch.testing.assert_close(copies, alone.expand(5, -1, -1, -1), rtol=1e-4, atol=1e-4)


def test_weights_are_for_the_picture_and_the_latent_starts_at_random(tmp_path: Path) -> None:
    source = planner()
    save_file(dict(source.fusion.image.state_dict()), tmp_path / "w.safetensors")
    torch.manual_seed(1)
    model = Ltf(replace(TINY, pretrained=str(tmp_path / "w.safetensors")), {})
    record = load_pretrained(model)
    assert record["fusion.image"].startswith("w.safetensors") and record["fusion.latent"] == "none"
    for a, b in zip(model.fusion.image.parameters(), source.fusion.image.parameters()):
        assert torch.equal(a, b)
    assert not torch.equal(model.fusion.latent.get_parameter("conv1.weight"), source.fusion.latent.conv1.weight)
