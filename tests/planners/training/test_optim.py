"""Schedules by closed form."""

import math

import pytest

from planners.training.fit import TrainingSettings, build_optimiser, learning_rate


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


@pytest.mark.parametrize(
    ("name", "value"), [("epochs", 0), ("batch_size", 0), ("learning_rate", 0.0), ("gradient_clip", -1.0), ("ema", 1.0)]
)
def test_impossible_settings_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        settings(**{name: value})


def test_what_is_frozen_is_not_stepped() -> None:
    from torch import nn

    model = nn.Linear(2, 3)
    model.bias.requires_grad_(False)
    groups = build_optimiser(settings(optimiser="adamw", weight_decay=0.1), model).param_groups
    assert [p.shape for g in groups for p in g["params"]] == [model.weight.shape]
    assert groups[0]["weight_decay"] == 0.1
