"""A hand-made vocabulary of two, by both weightings."""

import math

import pytest
import torch

from planners.models.gtrs_dense import WEIGHTINGS, choose, weighted_total
from tasks.subscores import LABELLED


def named(**given: list[float]) -> dict[str, torch.Tensor]:
    """Probabilities (1, K): those given, 0.5 for every other."""
    k = len(next(iter(given.values())))
    every = dict.fromkeys((*LABELLED, "imitation"), [0.5] * k) | given
    return {name: torch.tensor([values]) for name, values in every.items()}


def test_total_is_the_log_weighted_sum_worked_out_by_hand() -> None:
    scores = named(imitation=[0.1], nc=[0.9], dac=[0.8], ddc=[0.7], tlc=[0.6], ttc=[0.5], ep=[0.4], lk=[0.3], hc=[0.2])
    log = math.log
    release = 0.03 * log(0.1) + 0.1 * log(0.6) + 0.1 * log(0.9) + 0.9 * log(0.8) + 0.2 * log(0.7)
    release += 6.0 * log(7.0 * 0.5 + 7.0 * 0.4 + 3.0 * 0.3)
    assert weighted_total(scores, WEIGHTINGS["release"]).item() == pytest.approx(release, rel=1e-6)


def test_the_release_weighs_progress_more_than_collisions() -> None:
    scores = named(nc=[0.5, 0.99], ep=[0.9, 0.6])
    assert choose(scores, WEIGHTINGS["release"]).tolist() == [0]


def test_of_equals_the_first_is_chosen_and_a_probability_of_zero_stays_finite() -> None:
    scores = named(imitation=[0.0, 0.0, 0.0], nc=[0.0, 0.5, 0.5])
    assert choose(scores, WEIGHTINGS["release"]).tolist() == [1]
    assert weighted_total(scores, WEIGHTINGS["release"]).isfinite().all()


@pytest.mark.parametrize("name", WEIGHTINGS)
def test_full_marks_beat_everything(name: str) -> None:
    best = named(**{score: [1.0, 0.95] for score in LABELLED})
    assert choose(best, WEIGHTINGS[name]).tolist() == [0]
