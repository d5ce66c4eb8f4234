"""Turns of data, training and exploring: which commands they are, and that none is begun twice."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from factory.config.compose import compose, fill
from factory.config.run import load_config
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES
from planners.explore import alternate as command
from planners.explore.alternate import STEPS, TURNS, AlternateSettings, Step, main, steps_of
from planners.explore.settings import settings_of

PLAIN = fill(AlternateSettings, compose("alternate", ["out=o"], AlternateSettings), "alternate")


def words(settings: AlternateSettings, name: str) -> list[str]:
    (step,) = [step for step in steps_of(settings) if step.name == name]
    return list(step.words)


def test_every_turn_makes_data_trains_and_explores_in_this_order() -> None:
    names = [step.name for step in steps_of(replace(PLAIN, turns=2))]
    assert names == ["data/0", "trained/0", "explored/0", "data/1", "trained/1", "explored/1"]
    with_held_out = replace(PLAIN, turns=1, held_out_clips="clips.seed=7")
    assert [step.name for step in steps_of(with_held_out)][-1] == "held_out/0"


def test_a_turn_starts_from_where_the_planner_before_it_drove() -> None:
    assert not [word for word in words(PLAIN, "data/0") if word.startswith("explore=")]
    second = words(PLAIN, "data/1")
    assert {"explore=o/explored/0", "seed=1", "rounds=2", "experts=[pdm_closed]", "out=o/data/1"} <= set(second)
    trained = words(PLAIN, "trained/1")
    assert {"data.real=[o/data/0]", "data.sim=[o/data/0,o/data/1]", "init_from=o/trained/0"} <= set(trained)
    assert "planner=o/trained/1" in words(PLAIN, "explored/1")


def test_without_exploring_one_table_grows_by_as_much_a_turn() -> None:
    alone = replace(PLAIN, explore="none")
    assert {"rounds=4", "seed=0", "out=o/data/0"} <= set(words(alone, "data/1"))
    assert "data.sim=[o/data/0]" in words(alone, "trained/1")
    some = replace(alone, limit=3)
    assert {"limit=6", "rounds=2", "sample.drawn=true"} <= set(words(some, "data/1"))


def test_a_targeted_turn_draws_by_the_scores_of_the_planner_before_it() -> None:
    targeted = replace(PLAIN, explore="none", draws="targeted", limit=3)
    assert {"sample.drawn=true", "limit=3"} <= set(words(targeted, "data/0"))
    second = words(targeted, "data/1")
    assert {"sample=targeted", "sample.scores=o/explored/0", "limit=3", "out=o/data/1"} <= set(second)
    assert not [word for word in second if word.startswith("explore=")]
    assert "explore=o/explored/0" in words(replace(targeted, explore="planner"), "data/1")


@pytest.mark.parametrize(
    "change", [{}, {"explore": "none"}, {"draws": "targeted", "limit": 3}, {"held_out_clips": "clips.n_clips=2"}]
)
def test_every_step_is_a_command_line_of_its_program(change: dict[str, object]) -> None:
    for step in steps_of(replace(PLAIN, turns=2, **change)):  # type: ignore[arg-type]
        program, *given = step.words
        if program == "run":
            load_config([word for word in given if not word.startswith("sample.scores")] + ["sample.scores=o"])
        elif program == "explore":
            settings_of(given)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [("turn=3", "turn"), ("turns=0", "turns=0"), ("explore=planer", "explore"), ("out=s3://b/x", "a folder")],
)
def test_what_cannot_be_meant_is_refused(wrong: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([wrong]) == BAD_CONFIG
    assert said in capsys.readouterr().err


def test_a_step_that_ended_is_not_begun_again_and_one_that_failed_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Real commands, and quick ones: the first ends, the second cannot as long as it is misspelt."""
    steps = [Step("data/0", "factory", ("--version",)), Step("trained/0", "planners", ("planers",))]
    monkeypatch.setattr(command, "steps_of", lambda settings: iter(steps))
    monkeypatch.setattr(command, "turns_of", lambda settings, ended: [])
    asked = [f"out={tmp_path}", "turns=1"]
    assert main(asked) == COMPLETE_WITH_FAILURES
    assert json.loads((tmp_path / STEPS).read_text()) == {"data/0": ["--version"]}
    said = capsys.readouterr().err
    assert "data/0: python -m factory --version" in said and "ended with exit code 2" in said
    steps[1] = Step("trained/0", "planners", ("--version",))
    assert main(asked) == COMPLETE
    assert "data/0" not in capsys.readouterr().err
    steps[0] = Step("data/0", "factory", ("--help",))
    assert main(asked) == BAD_CONFIG
    assert "data/0 was made with other settings" in capsys.readouterr().err


@pytest.mark.slow
def test_a_turn_on_the_town_makes_a_line_of_the_table(tmp_path: Path) -> None:
    clips = f"clips=synthetic clips.cache_dir={tmp_path}/towns clips.n_clips=2 clips.settings.cameras=[]"
    asked = [
        f"out={tmp_path}/out",
        "turns=1",
        "rounds=1",
        f"training_clips={clips} clips.settings.lidar_beams=0",
        "train=planner=ego_mlp_small planner.training.batch_size=2 planner.training.epochs=1 workers=1",
        "drive=handover_s=[3] open_loop=false",
    ]
    assert main(asked) == COMPLETE
    with (tmp_path / "out" / TURNS).open() as file:
        (line,) = csv.DictReader(file)
    assert (line["turn"], line["samples"], line["explored_samples"], line["clips"]) == ("0", "2", "0", "2")
    assert 0.0 <= float(line["epdms"]) <= 1.0 and int(line["failing"]) <= int(line["drifts"]) <= 2
    assert line["held_out_epdms"] == ""
