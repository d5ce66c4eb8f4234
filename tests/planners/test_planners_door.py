"""What all commands do alike: help, exit codes, one line for what is wrong."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from factory.commands.table import PLANNERS
from factory.config.arguments import command
from factory.config.compose import ConfigError, compose
from factory.exits import BAD_CONFIG, COMPLETE_WITH_FAILURES, INTERRUPTED, Failed, Stopped
from planners.drive.settings import DriveSettings
from planners.evaluation.compare import CompareSettings
from planners.evaluation.evaluate import EvaluateSettings
from planners.evaluation.planner_names import find_planner
from planners.evaluation.replay import ReplaySettings
from planners.models.planner import planner_class
from planners.models.settings import BUILT_IN
from planners.published.import_planner import ImportConfig
from planners.training.train import TrainConfig
from tests.factory.text_keys import held, led_home, text_keys


@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        (ValueError("x=1: must be 2"), BAD_CONFIG, "error: x=1: must be 2\n"),
        (FileNotFoundError("no runs/a"), BAD_CONFIG, "error: no runs/a\n"),
        (Failed("a training"), COMPLETE_WITH_FAILURES, "error: a training\n"),
        (Stopped("the same command goes on"), INTERRUPTED, "the same command goes on\n"),
    ],
)
def test_what_is_raised_is_one_line_and_an_exit_code(
    raised: Exception, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    @command("compare", CompareSettings)
    def main(argv: Sequence[str]) -> None:
        raise raised

    assert main([]) == code
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("name", "shape", "given"),
    [
        ("train", TrainConfig, ("out=x",)),
        ("train", TrainConfig, ("out=x", "planner=gtrs_dense_small")),
        ("import_planner", ImportConfig, ("out=x", "checkpoint=x", "planner=ltf_public")),
        ("evaluate", EvaluateSettings, ("benchmark=x",)),
        ("compare", CompareSettings, ("a=x", "b=y")),
        ("drive", DriveSettings, ()),
        ("replay", ReplaySettings, ("benchmark=x", "clip=x")),
    ],
)
def test_a_home_folder_is_one_in_every_key_that_names_a_file(
    name: str, shape: type, given: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    choices = {word.partition("=")[0] for word in given if word.startswith("planner=")}
    keys = [key for key in text_keys(shape) if key not in choices and key != "planner"]
    values = compose(name, [*given, *(f"{key}=~/x" for key in keys)], shape)
    assert keys and {key: held(values, key) for key in keys} == {key: led_home(key, tmp_path) for key in keys}


def test_a_secret_of_an_object_store_is_left_as_it_is() -> None:
    values = compose("train", ["out=x", "data.storage_options.aws_secret_access_key=~a/b"], TrainConfig)
    assert values["data"]["storage_options"] == {"aws_secret_access_key": "~a/b"}


def test_a_planner_of_the_home_folder_is_evaluated_alone_and_in_an_ensemble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    for spec in ("~/a", "~/a+~/b"):
        with pytest.raises(ValueError, match=f"{tmp_path}/a.*no.*checkpoint"):
            find_planner(spec)
    with pytest.raises(ConfigError, match=r"^planner=~nobody\.here/a: there is no home folder ~nobody\.here"):
        find_planner("~nobody.here/a")


def test_a_fault_of_the_program_is_not_hidden() -> None:
    @command("compare", CompareSettings)
    def main(argv: Sequence[str]) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        main([])


def test_help_answers_without_running_and_tells_every_key(capsys: pytest.CaptureFixture[str]) -> None:
    @command("compare", CompareSettings)
    def main(argv: Sequence[str]) -> None:
        raise AssertionError(argv)

    assert main(["--help", "x=1"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("What all commands do alike")
    for line in (
        "a: ???  # folder of an evaluated planner, table of NAVSIM's, or a list of them",
        "column: score  # or a sub-score: nc dac tlc ddc ep ttc lk hc ec",
        "out: null  # a CSV file",
    ):
        assert f"\n{line}\n" in told


def test_help_tells_the_choices_of_every_group_and_what_conf_gives(capsys: pytest.CaptureFixture[str]) -> None:
    assert PLANNERS["train"].load()(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  mix: half, natural, rewards_only" in lines
    assert any(line.startswith('out: "runs/train/${planner.name}"  # ') for line in lines)
    assert not any(line.startswith(("mix:", "planner:")) for line in lines)


REFUSED = (  # a misspelt key, an unknown planner, a value, data that is missing
    "train data.rael=[x]",
    "train planner=nobody",
    "train planner=ltf_small planner.settings.varient=small",
    "train planner=gtrs_dense_small steps=0",
    "train planner=constant_velocity",
    "train planner=ltf_small data.real=[/nowhere]",
    "evaluate",
    "evaluate benchmark=/nowhere planner=nobody",
    "evaluate benchmark=/nowhere planner=human",
    "compare a=/nowhere b=/nowhere",
    "drive secnods=1",
    "drive planner=nobody",
    "drive planner=human clips=av2 clips.root=/nowhere",
    "replay benchmark=/nowhere clip=0",
    "import /nowhere.ckpt planner=ltf_public out=x",
    "serve",
    "submit",
)


@pytest.mark.slow
def test_what_does_not_fit_is_told_and_keys_are_completed_before_pytorch_is_imported() -> None:
    program = f"""
import sys
from factory.commands.completion import completions
from planners.__main__ import main
for words in {REFUSED}:
    assert main(words.split()) == 2, words
    assert "torch" not in sys.modules, words
for command in {tuple(PLANNERS)}:
    assert completions([command], "", "planners"), command
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == len(REFUSED) and all(line.startswith("error: ") for line in lines)


def test_a_built_in_planner_has_the_settings_that_its_name_says() -> None:
    for name, (_, settings) in BUILT_IN.items():
        assert planner_class(name).settings_type is settings
