"""Two studies side by side: what both compared is counted once, by sign and by interval."""

from pathlib import Path

import pytest
from PIL import Image

from factory.exits import BAD_CONFIG
from planners.evaluation.aggregation import MEASURES
from planners.evaluation.bootstrap import Interval
from planners.study.agreement import agreement, main, pairs_of, read_differences

HEAD = "part,setup,reference,budget,stage,human_filter,difference,low,high"
UP, DOWN = Interval(2.0, 1.0, 3.0), Interval(-2.0, -3.0, -1.0)
PERHAPS_UP, PERHAPS_DOWN = Interval(1.0, -1.0, 3.0), Interval(-1.0, -3.0, 1.0)


def study(folder: Path, *rows: str) -> Path:
    folder.mkdir()
    (folder / "comparisons.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    return folder


def test_counts_are_those_worked_out_by_hand() -> None:
    pairs = [(UP, UP), (UP, PERHAPS_UP), (UP, PERHAPS_DOWN), (DOWN, UP), (DOWN, DOWN), (PERHAPS_UP, DOWN)]
    assert agreement(pairs) == (6, 5, 3, 2, 1)


def test_an_interval_that_touches_zero_is_not_clear() -> None:
    assert not Interval(1.0, 0.0, 2.0).is_clear
    assert not Interval(-1.0, -2.0, 0.0).is_clear


def test_a_comparison_counts_once_and_as_its_first_part_made_it(tmp_path: Path) -> None:
    found = read_differences(
        study(
            tmp_path / "a",
            "main,real,,steps,final,filtered,,,",
            "main,sim,real,steps,final,filtered,5,1,9",
            "rounds,sim,real,steps,final,filtered,4,-1,9",
            "rounds,sim1,real,steps,final,filtered,3,1,5",
            "rounds,sim1,real,steps,final,unfiltered,2,1,3",
        )
    )
    assert found[("sim", "real", "steps", "final", "filtered")] == Interval(5.0, 1.0, 9.0)
    assert len(found) == 3


def test_only_what_both_compared_in_the_stage_is_paired() -> None:
    final, sim = ("final", "filtered"), ("sim", "real", "steps")
    first = {(*sim, *final): UP, ("sim1", "real", "steps", *final): UP}
    second = {(*sim, *final): DOWN, ("sim", "real", "epochs", *final): UP, (*sim, "final", "unfiltered"): UP}
    assert pairs_of(first, second, final) == {(*sim, *final): (UP, DOWN)}
    assert not pairs_of(first, second, ("stage_two", "none"))
    assert not pairs_of(first, second, ("final", "unfiltered"))


@pytest.mark.slow
def test_the_command_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = study(tmp_path / "a", *(f"main,sim,real,steps,{','.join(measure)},5,1,9" for measure in MEASURES))
    second = study(tmp_path / "b", *(f"main,sim,real,steps,{','.join(measure)},-1,-3,1" for measure in MEASURES))
    assert main([f"first={first}", f"second={second}", f"out={tmp_path / 'drawn.png'}"]) == 0
    said = capsys.readouterr().out
    assert "final      filtered       1      1          0            0                  0" in said
    assert "sim against real, equal steps, final filtered: +5.0 (+1.0 .. +9.0), then -1.0 (-3.0 .. +1.0)" in said
    with Image.open(tmp_path / "drawn.png") as picture:
        assert picture.width > 800


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no table of a study's comparisons: it must have setup"),
        ("part,setup\nmain,sim\n", "no table of a study's comparisons"),
        (f"{HEAD}\nmain,sim,real,steps,final,filtered,much,1,9\n", "comparisons.csv, line 2: .*'much'"),
        (f"{HEAD}\nmain,sim,real,steps,final,filtered,5\n", "comparisons.csv, line 2"),
    ],
)
def test_what_is_no_such_table_is_said(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "comparisons.csv").write_text(text)
    with pytest.raises(ValueError, match=said):
        read_differences(tmp_path)


def test_wrong_words_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = study(tmp_path / "a", "main,sim,real,steps,final,filtered,5,1,9")
    other = study(tmp_path / "b", "main,sim,real,epochs,final,filtered,5,1,9")
    assert main([f"first={first}", f"second={other}"]) == BAD_CONFIG
    assert "no comparison in common" in capsys.readouterr().err
    assert main([f"first={first}", f"second={tmp_path / 'none'}"]) == BAD_CONFIG
    assert "none" in capsys.readouterr().err
    assert main([f"first={first}", f"sceond={first}"]) == BAD_CONFIG
    assert "sceond" in capsys.readouterr().err
    assert main([f"first={first}", str(first)]) == BAD_CONFIG
    assert "expected one of first=" in capsys.readouterr().err
