"""DiffusionDrive: whom it imitates, and how it plans from noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from planners.data.batch import Batch
from planners.models.diffusiondrive import DiffusionDrive, denormalise_points, normalise_points
from planners.models.planner import TrainingData
from planners.models.settings import DiffusionDriveSettings
from tests.planners import scenes
from tests.planners.made_batch import made_batch

WAYS = 4
TINY = DiffusionDriveSettings(image=scenes.PICTURE, sizes=scenes.SIZES)


def scene_batch(n: int) -> Batch:
    return made_batch(planner().needs, n)


def planner(settings: DiffusionDriveSettings = TINY, n_anchors: int = WAYS) -> DiffusionDrive:
    torch.manual_seed(0)
    return DiffusionDrive(settings, {"anchors": scenes.four_ways(n_anchors)[:, 4::5, :2]})


def test_noise_that_is_drawn_is_another_for_every_call_and_scene_and_the_seed_s() -> None:
    batch, model = scene_batch(1), planner(replace(TINY, variant="public"))
    twice = replace(
        batch,
        attempt_ids=batch.attempt_ids * 2,
        status=batch.status.repeat(2, 1),
        image=None if batch.image is None else batch.image.repeat(2, 1, 1, 1),
    )
    torch.manual_seed(3)
    first, again = model.plan(twice), model.plan(twice)
    assert not torch.allclose(first, again, atol=1e-3) and not torch.allclose(first[0], first[1], atol=1e-3)
    torch.manual_seed(3)
    assert torch.equal(model.plan(twice), first)


class Told(torch.nn.Module):
    """A decoder that always answers with the same plans and confidences, and notes what it was asked."""

    def __init__(self, plans: torch.Tensor) -> None:
        super().__init__()
        self.plans, self.points, self.steps = plans, list[torch.Tensor](), list[list[int]]()

    def forward(
        self, points: torch.Tensor, base: torch.Tensor, step: torch.Tensor, *scene: torch.Tensor
    ) -> list[tuple[torch.Tensor, torch.Tensor]]:
        self.points.append(points)
        self.steps.append(step.tolist())
        n, anchors = points.shape[:2]
        return [(self.plans.expand(n, -1, -1, -1), torch.arange(float(anchors)).expand(n, -1))]


def test_planning_starts_at_noise_step_8_and_goes_by_ddim_from_10_to_9() -> None:
    """By hand, with the cumulated products of the schedule; the public code's truncated loop."""
    batch, model = scene_batch(2), planner()
    model.decoder = told = Told(model.anchors.roll(1, 0)[None] + 0.5)
    plan = model.plan(batch)
    betas = np.linspace(1e-4**0.5, 0.02**0.5, 1000) ** 2
    kept = torch.tensor(np.cumprod(1.0 - betas))
    clean, noise = normalise_points(model.anchors).double(), model.first_noise.double()
    start = kept[8].sqrt() * clean + (1.0 - kept[8]).sqrt() * noise
    answer = normalise_points(told.plans[0]).double()
    told_noise = (start - kept[10].sqrt() * answer) / (1.0 - kept[10]).sqrt()
    second = kept[9].sqrt() * answer.clamp(-1.0, 1.0) + (1.0 - kept[9]).sqrt() * told_noise
    assert told.steps == [[10, 10], [0, 0]]
    for found, expected in zip(told.points, (start, second)):
        torch.testing.assert_close(
            found[0].double(), denormalise_points(expected.clamp(-1.0, 1.0)), atol=1e-3, rtol=0.0
        )
    torch.testing.assert_close(plan, told.plans[0, -1].expand(2, -1, -1))  # the surest of the last answer


def test_an_anchor_is_learned_from_noise_of_the_step_that_the_decoder_is_told() -> None:
    batch, model = scene_batch(4), planner()
    model.decoder = told = Told(torch.zeros(1, WAYS, 8, 3))
    torch.manual_seed(5)
    model.losses(batch)
    torch.manual_seed(5)
    steps = torch.randint(0, 50, (4,))
    noise = torch.randn(4, *model.anchors.shape)
    assert told.steps == [steps.tolist()] and len(set(steps.tolist())) > 1
    kept = torch.tensor(np.cumprod(1.0 - np.linspace(1e-4**0.5, 0.02**0.5, 1000) ** 2)).float()[steps].view(4, 1, 1, 1)
    noisy = kept.sqrt() * normalise_points(model.anchors) + (1.0 - kept).sqrt() * noise
    torch.testing.assert_close(told.points[0], denormalise_points(noisy.clamp(-1.0, 1.0)), atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("offsets_from", ["noisy", "anchors"])
def test_before_it_learns_its_plans_are_near_what_they_are_told_from(offsets_from: str) -> None:
    model = planner(replace(TINY, offsets_from=offsets_from))
    plans = model.plan(scene_batch(4))[..., :2]
    off_m = (plans[:, None] - model.anchors).norm(dim=-1).mean(dim=-1).min(dim=1).values
    assert (off_m < 3.0).all()


def test_anchors_come_from_a_file_or_from_the_plans_to_be_trained_on(tmp_path) -> None:  # type: ignore[no-untyped-def]
    data = TrainingData(lambda: scenes.four_ways(40)[:, 4::5], None)
    made = DiffusionDrive.fixed_arrays(replace(TINY, n_anchors=4), data)["anchors"]
    assert made.shape == (4, 8, 2)
    assert sorted(made[:, -1, 0].round()) == pytest.approx([12.0, 22.0, 22.0, 40.0], abs=3.0)
    file = tmp_path / "anchors.npy"
    np.save(file, made)
    again = DiffusionDrive.fixed_arrays(replace(TINY, anchors=str(file)), TrainingData(lambda: np.zeros(0), None))
    assert np.array_equal(again["anchors"], made)


def test_a_batch_that_lacks_something_is_refused() -> None:
    batch, model = scene_batch(2), planner()
    with pytest.raises(ValueError, match="without view from above or agents"):
        model.losses(replace(batch, bev=None))
    with pytest.raises(ValueError, match="without images"):
        model.plan(replace(batch, image=None))
