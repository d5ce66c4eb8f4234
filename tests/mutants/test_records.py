"""Every kept mutant still fits the tree, so that `make mutants` tests what is there and not what was."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutants.__main__ import summary
from tests.mutants.records import PACKAGES, ROOT, Mutant, Stale, chosen, load, mutated

MUTANTS = load()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.id)
def test_a_mutant_still_applies_and_its_tests_exist(mutant: Mutant) -> None:
    mutated(mutant)
    for test in mutant.tests:
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file(), f"mutant {mutant.id}: {file} is gone: name the tests that should notice now"
        if name:
            found = f"def {name.partition('[')[0]}(" in (ROOT / file).read_text()
            assert found, f"mutant {mutant.id}: {file} has no {name}: name the test that should notice now"


def test_there_are_enough_of_every_package() -> None:
    assert len(MUTANTS) >= 150
    assert min(sum(mutant.package == name for mutant in MUTANTS) for name in PACKAGES) >= 40


def test_a_record_that_fits_no_more_says_what_to_do(tmp_path: Path) -> None:
    mutant = Mutant("one", "speed is in m/s", "a.py", "x = 1", "x = 2", ("tests/test_a.py",))
    with pytest.raises(Stale, match=r"mutant one: a\.py is gone: move the record"):
        mutated(mutant, tmp_path)
    source = tmp_path / "a.py"
    source.write_text("x = 1\ny = 0\nx = 1\n")
    with pytest.raises(Stale, match=r"mutant one: in a\.py this text is there 2 times(.|\n)*speed is in m/s"):
        mutated(mutant, tmp_path)
    assert mutated(replace(mutant, after="y = 0"), tmp_path) == "x = 1\ny = 0\nx = 2\n"
    with pytest.raises(Stale, match="not there behind its `after`"):
        mutated(replace(mutant, old="y = 0", after="y = 0"), tmp_path)
    with pytest.raises(Stale, match="changes nothing"):
        mutated(replace(mutant, old="y = 0", new="y = 0"), tmp_path)
    with pytest.raises(Stale, match="would be no Python"):
        mutated(replace(mutant, old="y = 0", new="y ="), tmp_path)


def test_some_can_be_chosen() -> None:
    assert {mutant.package for mutant in chosen(MUTANTS, "planners")} == {"planners"}
    assert [mutant.id for mutant in chosen(MUTANTS, MUTANTS[3].id)] == [MUTANTS[3].id]
    assert len(chosen(MUTANTS, "")) == len(MUTANTS)
    assert {m.package for m in chosen(MUTANTS, f"planners,tasks/reward,{MUTANTS[3].id}")} >= {"planners", "tasks"}
    with pytest.raises(Stale, match="ONLY=plannrs"):
        chosen(MUTANTS, "factory,plannrs")


def test_the_summary_counts_by_package_and_names_what_survived() -> None:
    of = {name: next(mutant for mutant in MUTANTS if mutant.package == name) for name in PACKAGES}
    results = [(of["tasks"], "killed"), (of["factory"], "survived"), (of["planners"], "killed")]
    text, rate = summary(results)
    assert rate == pytest.approx(2 / 3)
    assert f"survived: {of['factory'].id} ({of['factory'].file}): {of['factory'].rule}" in text
    assert "factory    0 of 1 killed, 0 %" in text
