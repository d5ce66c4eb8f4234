"""Sweeps: every combination once, its curves, and who evaluates what."""

from typing import Any

import pytest

from planners.study.figures import Curve
from planners.study.report import StudyFrames, curves_of
from planners.study.scaling import ScalingSettings, SweepData, comparisons_of, trainings_of
from planners.study.sweep import EVALUATED_TOGETHER, shares_of
from planners.training.many import Training


def scaling(**changes: Any) -> ScalingSettings:
    axes: dict[str, Any] = {
        "planners": ("ltf",),
        "experts": ("recovery", "pdm_closed"),
        "rounds": (0, 1, 2, 3),
        "sim_ratios": ("natural",),
        "imitation": ("all",),
        "real_shares": (1.0,),
        "seeds": 2,
    }
    data = SweepData(("real",), ("sim",))
    return ScalingSettings(data=data, benchmark="bench", out="out", **{**axes, **changes})


def test_every_combination_is_trained_once_and_real_samples_alone_not_once_an_expert() -> None:
    trainings = trainings_of(scaling())
    assert len(trainings) == len({t.label for t in trainings}) == 2 * (1 + 2 * 3)
    alone = [t for t in trainings if t.facts["rounds"] == 0]
    assert [t.facts["seed"] for t in alone] == [0, 1]
    assert all("data.sim=[]" in t.overrides for t in alone)
    third = next(t for t in trainings if t.facts["rounds"] == 3 and t.facts["data"] == "recovery")
    assert {"data.max_round=2", "data.experts=[recovery]", "data.sim=[sim]"} <= set(third.overrides)


def test_all_experts_together_are_one_axis_value() -> None:
    (one,) = trainings_of(scaling(experts=("all",), rounds=(1,), seeds=1))
    assert not any(o.startswith("data.experts") for o in one.overrides)


def drawn(settings: ScalingSettings) -> list[Curve]:
    facts = [
        {"training": one.label, **one.facts, "real": 100, "simulated": 50 * one.facts["rounds"]}
        for one in trainings_of(settings)
    ]
    scores = {one["training"]: {"final_unfiltered": 30.0 + one["rounds"]} for one in facts}
    return curves_of(StudyFrames(tuple(facts), tuple(comparisons_of(settings)), {}), scores, "final_unfiltered")


def test_curves_hold_their_own_points_and_real_samples_alone() -> None:
    recovery, pdm = drawn(scaling())
    assert (recovery.label, pdm.label) == ("recovery", "pdm_closed")
    for curve in (recovery, pdm):
        assert sorted(curve.samples) == [100, 100, 150, 150, 200, 200, 250, 250]
        assert curve.law is not None
    (few,) = drawn(scaling(experts=("recovery",), rounds=(0, 1, 2)))
    assert few.law is None and few.row()["a"] == ""


def test_a_curve_is_named_after_what_is_not_as_usual() -> None:
    labels = [one.label for one in drawn(scaling(experts=("recovery",), real_shares=(0.5, 1.0), imitation=("real",)))]
    assert labels == ["recovery, rewards only, 50 % of the real", "recovery, rewards only"]
    for curve in drawn(scaling(imitation=("all", "none"), seeds=1)):
        assert len(curve.samples) == 4, "real samples alone with imitation, or without, as the curve's own"


@pytest.mark.parametrize(("name", "value"), [("seeds", 0), ("rounds", (-1,)), ("planners", ("ltf", "ltf"))])
def test_axes_that_are_none_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        scaling(**{name: value})


@pytest.mark.parametrize(("n", "processes"), [(0, 0), (1, 1), (16, 2), (48, 2), (49, 4)])
def test_processes_evaluate_all_planners_and_as_many_of_each_kind(n: int, processes: int) -> None:
    who = [Training(f"{'slow' if i < n / 2 else 'fast'}-{i}") for i in range(n)]
    shares = shares_of(who, 2)
    assert len(shares) == processes
    assert sorted(one.label for share in shares for one in share) == sorted(one.label for one in who)
    assert all(len(share) <= EVALUATED_TOGETHER for share in shares)
    slow = [sum(one.label.startswith("slow") for one in share) for share in shares]
    assert not slow or max(slow) - min(slow) <= 1
