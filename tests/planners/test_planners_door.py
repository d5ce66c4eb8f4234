"""What all commands do alike: help, exit codes, one line for what is wrong, signals."""

import os
import signal
import threading
from collections.abc import Sequence

import pytest

from factory.exits import BAD_CONFIG, COMPLETE_WITH_FAILURES, INTERRUPTED
from planners.command import Failed, Stopped, command, until_signal


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


def test_the_first_signal_is_noted_and_the_second_has_its_usual_effect() -> None:
    before = signal.default_int_handler  # a shell starts what runs in the background with the signal ignored
    inherited = signal.signal(signal.SIGINT, before)
    with until_signal() as asked, pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        assert asked.wait(5.0)
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(5.0)
    assert signal.signal(signal.SIGINT, inherited) == before
