"""How signals end a program."""

import os
import signal
import threading

import pytest

from factory.exits import asked_to_stop


def test_the_first_signal_is_noted_and_the_second_interrupts() -> None:
    before = signal.default_int_handler  # a shell starts what runs in the background with the signal ignored
    inherited = signal.signal(signal.SIGINT, before)
    asked = threading.Event()
    with asked_to_stop(asked.set), pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        assert asked.wait(5.0)
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(5.0)
    assert signal.signal(signal.SIGINT, inherited) == before
