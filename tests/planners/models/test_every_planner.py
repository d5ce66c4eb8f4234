"""What every planner that learns keeps to, whatever is inside."""

from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from planners.data.batch import Batch, Needs
from planners.models.baselines import GoStraight
from planners.models.gtrs_dense import GtrsDense
from planners.models.planner import Planner
from planners.models.settings import ConstantVelocitySettings
from tests.planners.models import test_diffusiondrive, test_ego_mlp, test_gtrs_dense, test_ltf


class Case(NamedTuple):
    """A small planner, four samples for it, and its terms that imitate."""

    model: Planner
    batch: Batch
    imitating: tuple[str, ...]
    silent: str  # beginning of the names of what only imitation teaches


def case_of(name: str) -> Case:
    if name == "gtrs_dense":
        shifting = replace(test_gtrs_dense.TINY, image_shift=0.1)  # the small picture's by more than no pixel
        return Case(
            test_gtrs_dense.planner(shifting), test_gtrs_dense.labelled(4)[0], ("imitation",), "scorer.heads.imitation"
        )
    if name == "diffusiondrive":
        batch = test_diffusiondrive.scene_batch(4)
        return Case(test_diffusiondrive.planner(), batch, ("confidence", "regression"), "decoder.")
    if name == "ltf":
        return Case(test_ltf.planner(), test_ltf.batch(), ("trajectory",), "plan_head.")
    model = test_ego_mlp.blind() if name == "ego_mlp" else test_ego_mlp.shown()
    return Case(model, test_ego_mlp.made_batch(model.needs, 4), ("trajectory",), "layers.")


NAMES = ("ego_mlp", "ego_mlp_bev", "ltf", "diffusiondrive", "gtrs_dense")


@pytest.fixture(params=NAMES)
def case(request: pytest.FixtureRequest) -> Case:
    return case_of(request.param)


def summed(terms: dict[str, Tensor]) -> Tensor:
    return torch.stack(list(terms.values())).sum()


def imitating(case: Case, *which: bool) -> dict[str, Tensor]:
    """The terms where these samples are to be imitated; all that is random is the same."""
    torch.manual_seed(0)
    return case.model.losses(replace(case.batch, imitate=torch.tensor(which)))


def test_a_plan_is_the_same_every_time_and_whatever_else_is_in_the_batch(case: Case) -> None:
    model, random = case.model.train(), torch.get_rng_state()
    first = model.plan(case.batch)
    assert torch.equal(torch.get_rng_state(), random), "whatever is drawn changes scores, if not always the best one"
    torch.manual_seed(9)
    assert model.training and torch.equal(model.plan(case.batch), first) and not first.requires_grad
    assert first.shape in ((4, 8, 3), (4, 40, 3)) and first[..., 2].abs().max() <= torch.pi
    alone = torch.cat([model.plan(part) for part in case.batch.parts(4)])
    torch.testing.assert_close(alone, first, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_told_its_speed_alone_a_planner_plans_the_same_however_it_accelerates(name: str) -> None:
    model, batch = case_of(name)[:2]
    model.eval()
    pushed, faster = batch.status.clone(), batch.status.clone()
    pushed[:, 6:] += 2.0
    faster[:, 4] += 20.0
    for status in ("all", "speed"):
        model.settings = replace(model.settings, status=status)
        of = model.scores if isinstance(model, GtrsDense) else lambda batch: {"plan": model.plan(batch)}
        (plan, again, other) = (
            torch.stack([*of(replace(batch, status=seen)).values()]) for seen in (batch.status, pushed, faster)
        )
        assert torch.equal(again, plan) == (status == "speed")
        assert not torch.equal(other, plan)


def test_who_goes_straight_never_stands() -> None:
    batch = test_ego_mlp.made_batch(Needs(), 2)
    status = batch.status.clone()
    status[:, 4:6] = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    plan = GoStraight(ConstantVelocitySettings(), {}).plan(replace(batch, status=status))
    torch.testing.assert_close(plan[:, -1], torch.tensor([[4.0, 0.0, 0.0], [20.0, 0.0, 0.0]]))


def test_losses_reach_every_parameter_also_where_nothing_imitates(case: Case) -> None:
    """And then there is a gradient of zero: processes wait for the gradient of every parameter."""
    for imitate in (True, False):
        case.model.zero_grad()
        terms = imitating(case, *[imitate] * 4)
        summed(terms).backward()
        for name, parameter in case.model.named_parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name
            assert imitate or not name.startswith(case.silent) or not parameter.grad.any(), name
    assert all(terms[name].item() == 0.0 for name in case.imitating)
    assert all(term.item() > 0.0 for name, term in terms.items() if name not in case.imitating)


def test_imitation_is_divided_by_the_whole_batch_and_the_rest_counts_every_sample(case: Case) -> None:
    case.model.eval()
    both, one, other = (
        imitating(case, True, False, True, False),
        imitating(case, True, False, False, False),
        imitating(case, False, False, True, False),
    )
    for name in both:
        wanted = one[name] + other[name] if name in case.imitating else one[name]
        torch.testing.assert_close(both[name], wanted)


def test_bf16_learns_and_plans(case: Case) -> None:
    with torch.autocast("cpu", torch.bfloat16):
        terms = case.model(case.batch)
        summed(terms).backward()
        plan = case.model.plan(case.batch)
    assert all(term.isfinite() and term.dtype == torch.float32 for term in terms.values())
    assert plan.dtype == torch.float32 and plan.isfinite().all()
