"""What all commands do alike: help, exit codes, one line for what is wrong."""

from collections.abc import Sequence

import pytest

from factory.exits import BAD_CONFIG, COMPLETE_WITH_FAILURES, INTERRUPTED
from planners.command import Failed, Stopped, command
from planners.study.scaling import main as scaling


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
    @command
    def main(argv: Sequence[str]) -> None:
        raise raised

    assert main([]) == code
    assert capsys.readouterr().err == said


def test_a_fault_of_the_program_is_not_hidden() -> None:
    @command
    def main(argv: Sequence[str]) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        main([])


def test_help_answers_without_running(capsys: pytest.CaptureFixture[str]) -> None:
    @command
    def main(argv: Sequence[str]) -> None:
        raise AssertionError(argv)

    assert main(["--help", "x=1"]) == 0
    assert capsys.readouterr().out.startswith("What all commands do alike")


def test_help_tells_every_key_with_its_value_and_its_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the file of choices, of the dataclass, and of the dataclass that it builds on."""
    assert scaling(["--help"]) == 0
    told = capsys.readouterr().out
    for line in (
        "out: runs/scaling  # the same command on the same folder goes on",
        "rounds: [0, 1, 2, 3, 4, 5]  # simulated rounds trained on; 0: real samples alone",
        "executor: process  # process | ray",
    ):
        assert f"\n{line}\n" in told
