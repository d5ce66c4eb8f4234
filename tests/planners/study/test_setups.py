"""Set-ups in labels and overrides; which comparisons stand while a sweep goes on; what is trained at once."""

import re
from dataclasses import replace

from planners.study.setups import Comparison, Setup, completed_comparisons, words_of

BEGIN = Setup("ltf", "begin", 0, "epochs")
REAL = Setup("ltf", "real", 0, "steps")
MORE = [Setup("ltf", expert, 5, "steps") for expert in ("recovery", "pdm_closed")]
WANTED = [
    Comparison("begin", BEGIN, None, 1),
    Comparison("main", REAL, None, 3, "steps"),
    *(Comparison("main", one, REAL, 3, "steps") for one in MORE),
    Comparison("ratio", MORE[1], None, 2, "steps"),
    Comparison("ratio", replace(MORE[1], sim_ratio=0.5), MORE[1], 2, "steps"),
]


def labels(part: str, seed: int) -> list[str]:
    return [one.setup.label_of(seed) for one in WANTED if one.part == part]


def test_a_label_names_how_many_rounds_are_learned_from_and_rounds_count_from_0() -> None:
    for setup in (REAL, *MORE, replace(MORE[0], rounds=1)):
        overrides = setup.overrides("ltf_small", ["real"], ["sim"], ["val"], 0)
        rounds = [one.removeprefix("data.max_round=") for one in overrides if one.startswith("data.max_round=")]
        named = re.match(r"ltf-(?:recovery|pdm_closed)(\d+)-", setup.label)
        assert rounds == ([str(int(named[1]) - 1)] if named else []), setup.label


def test_real_samples_alone_learn_from_no_table_of_simulated_ones_and_an_expert_from_its_own_samples() -> None:
    assert "data.sim=[]" in REAL.overrides("ltf_small", ["real"], ["sim"], ["val"], 0)
    chosen = MORE[0].overrides("ltf_small", ["real"], ["sim"], ["val"], 3)
    assert {"data.sim=[sim]", "data.experts=[recovery]", "seed=3"} <= set(chosen)
    everyone = Setup("ltf", "all", 1, "epochs").overrides("ltf_small", ["real"], ["sim"], ["val"], 0)
    assert not any(one.startswith("data.experts") for one in everyone)


def test_a_setup_is_called_after_what_is_not_as_usual() -> None:
    facts = Comparison("main", MORE[1], None, 1).facts
    assert words_of(facts) == "+ pdm_closed, 5 rounds"
    assert words_of(facts | {"imitation": "real", "real_share": 0.5}, counted=False) == (
        "pdm_closed, rewards only, 50 % of the real"
    )
    assert words_of(Comparison("main", REAL, None, 1).facts) == "real"


def test_comparisons_so_far_have_the_seeds_that_both_sides_have() -> None:
    begun, first, second = labels("begin", 0), labels("main", 0), labels("main", 1)
    assert {one.part for one in completed_comparisons(WANTED, begun)} == {"begin"}
    whole = completed_comparisons(WANTED, [*begun, *first])
    assert [one.setup for one in whole] == [one.setup for one in WANTED if one.part != "ratio"]
    assert {one.seeds for one in whole} == {1}
    both = completed_comparisons(WANTED, [*begun, *first, *second])
    assert {one.seeds for one in both if one.part == "main"} == {2}
    without = [label for label in second if label != REAL.label_of(1)]
    assert completed_comparisons(WANTED, [*begun, *first, *without]) == whole, "means of other seeds would stand beside"
    assert completed_comparisons(WANTED, second) == []
