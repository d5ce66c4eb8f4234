"""Schedules by closed form."""

import math

import pytest
from torch import nn

from planners.models.layers import LatentFusion
from planners.models.settings import BackboneSettings, FusionSettings
from planners.training.optim import TrainingSettings, build_optimiser, learning_rate, set_rate


def settings(**changes: object) -> TrainingSettings:
    return TrainingSettings(**{"epochs": 1, "batch_size": 4, "learning_rate": 0.5, **changes})  # type: ignore[arg-type]


def test_a_constant_rate_is_constant() -> None:
    assert {learning_rate(settings(), step, 10) for step in range(10)} == {0.5}


def test_a_cosine_begins_at_the_rate_passes_its_half_and_falls_towards_nothing() -> None:
    rates = [learning_rate(settings(schedule="cosine"), step, 100) for step in range(100)]
    assert rates[0] == 0.5
    assert rates[50] == pytest.approx(0.25)
    assert rates[99] == pytest.approx(0.25 * (1 + math.cos(0.99 * math.pi)))
    assert rates == sorted(rates, reverse=True)


def test_warm_up_rises_linearly_and_the_schedule_follows() -> None:
    warm = settings(schedule="cosine", warmup_steps=5)
    assert [learning_rate(warm, step, 15) for step in range(5)] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert learning_rate(warm, 5, 15) == 0.5


def test_warm_up_in_epochs_is_warm_up_in_their_steps() -> None:
    epochs, steps = settings(schedule="cosine", warmup_epochs=1.5), settings(schedule="cosine", warmup_steps=15)
    assert [learning_rate(epochs, step, 60, 10) for step in range(60)] == [
        learning_rate(steps, step, 60, 10) for step in range(60)
    ]
    with pytest.raises(ValueError, match="not both"):
        settings(warmup_steps=1, warmup_epochs=1.0)


def test_by_epoch_the_rates_are_those_of_the_public_scheduler() -> None:
    """lr (e + 1) / 3, then lowest + (lr - lowest) (1 + cos(pi (e - 3) / (E - 3))) / 2: hand-computed of E = 7."""
    public = settings(schedule="cosine", warmup_epochs=3.0, by_epoch=True, lowest_rate=0.1)
    per_epoch = [learning_rate(public, step, 28, 4) for step in range(28)]
    by_hand = [0.5 / 3, 1.0 / 3, 0.5, 0.5, 0.1 + 0.2 * (1 + math.sqrt(0.5)), 0.3, 0.1 + 0.2 * (1 - math.sqrt(0.5))]
    assert per_epoch == pytest.approx([rate for rate in by_hand for _ in range(4)])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("epochs", 0),
        ("batch_size", 0),
        ("learning_rate", 0.0),
        ("gradient_clip", -1.0),
        ("warmup_epochs", -1.0),
        ("lowest_rate", 0.6),
        ("backbone_rate", 0.0),
        ("weight_decay", -0.1),
        ("backbone_decay", math.inf),
    ],
)
def test_impossible_settings_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        settings(**{name: value})


def test_what_is_frozen_is_not_stepped() -> None:
    model = nn.Linear(2, 3)
    model.bias.requires_grad_(False)
    groups = build_optimiser(settings(optimiser="adamw", weight_decay=0.1), model).param_groups
    assert [p.shape for g in groups for p in g["params"]] == [model.weight.shape]
    assert groups[0]["weight_decay"] == 0.1


class Seeing(nn.Module):
    """A backbone over pictures, one over something else, and a head."""

    def __init__(self) -> None:
        super().__init__()
        small = BackboneSettings(name="small", widths=(2, 2, 2, 2))
        self.fusion = LatentFusion(FusionSettings(small, 32, image_tokens=(1, 1), latent_tokens=(1, 1), heads=1))
        self.head = nn.Linear(2, 3)


def test_backbones_over_pictures_have_a_rate_of_their_own_and_every_parameter_one() -> None:
    model = Seeing()
    optimiser = build_optimiser(settings(backbone_rate=0.1), model)
    set_rate(optimiser, 0.25)
    rates = {id(p): group["lr"] for group in optimiser.param_groups for p in group["params"]}
    for name, parameter in model.named_parameters():
        assert rates[id(parameter)] == pytest.approx(0.025 if name.startswith("fusion.image.") else 0.25), name
    assert sum(len(group["params"]) for group in optimiser.param_groups) == len(list(model.parameters()))
    again = build_optimiser(settings(backbone_rate=0.1), Seeing())
    again.load_state_dict(optimiser.state_dict())
    set_rate(again, 1.0)
    assert [group["lr"] for group in again.param_groups] == pytest.approx([1.0, 0.1])
    assert len(build_optimiser(settings(), model).param_groups) == 1
    with pytest.raises(ValueError, match="no backbone over pictures"):
        build_optimiser(settings(backbone_rate=0.1), model.head)


def test_backbones_over_pictures_may_decay_otherwise_at_the_same_rate() -> None:
    model = Seeing()
    optimiser = build_optimiser(settings(optimiser="adamw", weight_decay=0.1, backbone_decay=0.0), model)
    set_rate(optimiser, 0.25)
    decays = {id(p): group["weight_decay"] for group in optimiser.param_groups for p in group["params"]}
    for name, parameter in model.named_parameters():
        assert decays[id(parameter)] == (0.0 if name.startswith("fusion.image.") else 0.1), name
    assert {group["lr"] for group in optimiser.param_groups} == {0.25}
    same = settings(optimiser="adamw", weight_decay=0.1, backbone_decay=0.1)
    assert len(build_optimiser(same, model).param_groups) == 1
