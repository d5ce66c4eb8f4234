"""The study's plan: what is compared with what, and that nothing is trained twice."""

import re
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from factory.config.compose import compose, fill
from planners.study.setups import so_far
from planners.study.study import ENSEMBLE, PARTS, Sizes, StudySettings, comparisons, planned, with_all_parts
from planners.study.sweep import BATCH, batches
from planners.training.many import Training

SIZES = Sizes(steps=600, matched=7)


def settings(**changes: Any) -> StudySettings:
    values = compose("study", ["vocabulary=voc.npy"])
    return fill(StudySettings, {**values, **changes}, "study")


def trainings(chosen: StudySettings) -> list[Training]:
    return [one for one in planned(comparisons(chosen), chosen, SIZES) if not one.members]


def labels(found: list[Training], *units: tuple[str, int]) -> list[str]:
    return [one.label for one in found if one.unit in units]


def test_every_family_is_trained_with_and_without_simulation_in_equal_epochs_and_in_equal_steps() -> None:
    found = comparisons(settings(parts=("main",)))
    for planner in ("ltf", "diffusiondrive", "gtrs_dense"):
        for budget in ("epochs", "steps"):
            mine = [c for c in found if (c.part, c.setup.planner, c.budget) == ("main", planner, budget)]
            assert {c.setup.data for c in mine} == {"real", "recovery", "pdm_closed"}
            for one in mine:
                assert (one.reference is None) == (one.setup.rounds == 0)
                if one.reference is not None:
                    assert (one.reference.planner, one.reference.data, one.reference.budget) == (
                        planner,
                        "real",
                        budget,
                    )


def test_every_training_begins_with_what_the_same_planner_learnt_in_other_towns() -> None:
    everything = settings(out="here", data="made", begin="elsewhere")
    everyone = trainings(everything)
    first = {t.label: t for t in everyone if t.facts["data"] == "begin"}
    assert set(first) == {f"{planner}-begin-epochs-0" for planner in everything.planners}
    for training in everyone:
        mine = f"init_from=here/trainings/{training.facts['planner']}-begin-epochs-0"
        assert (mine in training.overrides) == (training.label not in first)
        real = "elsewhere" if training.label in first else "made,elsewhere"
        assert f"data.real=[{real}]" in training.overrides
    two = trainings(settings(begin="elsewhere", parts=("ratio",)))
    assert {t.facts["planner"] for t in two} == {"diffusiondrive", "gtrs_dense"}, "nothing else is trained for a part"
    alone = settings(begin=None)
    begun = ["begin" in t.label or any(o.startswith("init_from") for o in t.overrides) for t in trainings(alone)]
    assert not any(begun)


def test_tables_hold_all_parts_whichever_are_trained_now() -> None:
    some = settings(parts=("ratio", "main"))
    whole = with_all_parts(some)
    assert whole.parts[:2] == some.parts
    assert sorted(whole.parts) == sorted(PARTS)
    mine, every = ({t.label: t.overrides for t in trainings(chosen)} for chosen in (some, whole))
    assert mine.items() < every.items(), "a training is the same whichever parts ask for it"


def test_a_training_is_planned_once_with_as_many_seeds_as_anyone_asks_for() -> None:
    everything = settings()
    everyone = trainings(everything)
    assert len({one.label for one in everyone}) == len(everyone) == len({one.overrides for one in everyone})
    assert {t.facts["seed"] for t in everyone if t.label.startswith("gtrs_dense-pdm_closed5-epochs-")} >= {0, 1, 2}


def test_a_setup_differs_from_its_reference_in_what_its_part_is_about() -> None:
    about = {"traffic": "traffic", "ratio": "sim_ratio", "psnr": "psnr", "rewards": "imitation"}
    for one in comparisons(settings()):
        if one.reference is not None and one.part in about:
            differs = {k for k, v in vars(one.setup).items() if v != vars(one.reference)[k]}
            assert differs - {"budget"} == {about[one.part]}, one


def test_equal_steps_are_those_of_all_that_there_is_which_is_trained_once() -> None:
    found = [one for one in comparisons(settings(parts=("main",))) if one.setup.data == "pdm_closed"]
    assert {one.budget for one in found} == {"epochs", "steps"}
    assert {one.setup.budget for one in found} == {"epochs"}
    assert {(one.budget, one.reference.budget) for one in found if one.reference} == {
        ("epochs", "epochs"),
        ("steps", "steps"),
    }


def test_budgets_and_bounds_become_overrides() -> None:
    everything = settings()
    by_label = {t.label: t.overrides for t in trainings(everything)}
    assert not any(o.startswith("steps=") for o in by_label["ltf-real-epochs-0"])
    assert "steps=600" in by_label["ltf-real-steps-0"]
    low, high = (by_label[f"gtrs_dense-pdm_closed5-epochs-psnr_{side}-1"] for side in ("low", "high"))
    assert {"data.psnr_max=27.0", "data.limit_sim=7"} <= set(low)
    assert {"data.psnr_min=27.0", "data.limit_sim=7"} <= set(high)
    assert "data.psnr_min=27.0" in by_label["ltf-recovery5-epochs-0"]
    assert f"data.sim=[{everything.replay}]" in by_label["gtrs_dense-pdm_closed1-epochs-replay-0"]
    control = by_label["ltf-logged5-steps-1"]
    assert {f"data.sim=[{everything.control}]", "data.experts=[logged]", "steps=600"} <= set(control)


def test_a_label_names_how_many_rounds_are_learned_from_and_rounds_count_from_0() -> None:
    for training in trainings(settings()):
        rounds = [o.removeprefix("data.max_round=") for o in training.overrides if o.startswith("data.max_round=")]
        named = re.match(r"[a-z_]+-(?:recovery|pdm_closed|logged)(\d+)-", training.label)
        assert rounds == ([str(int(named[1]) - 1)] if named else []), training.label


def test_ensembles_are_made_of_trainings_that_are_planned_before_them() -> None:
    chosen = settings(parts=("ensemble",), out="here")
    everyone = planned(comparisons(chosen), chosen, SIZES)
    made = [one for one in everyone if one.members]
    for ensemble in made:
        trained = [one.label for one in everyone if one.unit <= ensemble.unit and not one.members]
        assert ensemble.label.startswith(ENSEMBLE) and set(ensemble.members) <= set(trained)
        assert ensemble.spec(Path("here")) == "+".join(f"here/trainings/{label}" for label in ensemble.members)
    assert len(made) == 2 * chosen.curve_seeds


def test_one_seed_of_one_part_is_done_after_the_other() -> None:
    chosen = settings(parts=("main", "control"))
    everyone = planned(comparisons(chosen), chosen, SIZES)
    assert [unit for unit, _ in groupby(everyone, key=lambda one: one.unit)] == [
        ("begin", 0),
        *(("main", seed) for seed in range(3)),
        *(("control", seed) for seed in range(2)),
    ]
    assert all(one.facts["seed"] == one.unit[1] for one in everyone)
    assert {one.facts["data"] for one in everyone if one.unit[0] == "control"} == {"logged"}


def test_small_units_are_trained_at_once_but_never_with_what_they_begin_with() -> None:
    chosen = settings(parts=("main", "control", "rewards"))
    everyone = planned(comparisons(chosen), chosen, SIZES)
    found = batches(everyone)
    assert [one for batch in found for one in batch] == everyone
    assert {one.unit[0] for one in found[0]} == {"begin"}
    for batch in found[1:]:
        assert len(batch) - len(labels(batch, batch[-1].unit)) < BATCH
        assert len(batch) >= BATCH or batch is found[-1]
    assert len(found) < len({one.unit for one in everyone}) - 2


def test_comparisons_so_far_have_the_seeds_that_both_sides_have() -> None:
    chosen = settings(parts=("main",))
    found = comparisons(chosen)
    everyone = planned(found, chosen, SIZES)
    begun, first, second = (labels(everyone, unit) for unit in (("begin", 0), ("main", 0), ("main", 1)))
    assert {c.part for c in so_far(found, begun)} == {"begin"}
    whole = so_far(found, [*begun, *first])
    assert [c.setup for c in whole] == [c.setup for c in found]
    assert {c.seeds for c in whole} == {1}
    both = so_far(found, [*begun, *first, *second])
    assert {c.seeds for c in both if c.part == "main"} == {2}
    without = [label for label in second if label != "ltf-real-steps-1"]
    assert so_far(found, [*begun, *first, *without]) == whole, "means of other seeds would stand beside"
    assert so_far(found, second) == []


def test_a_part_of_which_only_others_trainings_are_there_is_left_out() -> None:
    asked, whole = settings(parts=("rewards",)), settings()
    done = [one.label for one in planned(comparisons(asked), asked, SIZES)]
    assert {c.part for c in so_far(comparisons(whole), done)} == {"begin", "rewards"}


@pytest.mark.parametrize(
    ("changes", "said"), [({"parts": ["mian"]}, "parts="), ({"planners": {"ltf": "ltf"}}, "planners lacks")]
)
def test_plans_that_cannot_be_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        settings(**changes)
    assert set(compose("study", ["vocabulary=v"])["parts"]) == set(PARTS)
