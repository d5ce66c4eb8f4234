"""A small part of experiments.chaos.outside, which prints each promise with its trials: commands as a user has them."""

import re
import subprocess
import sys

import pytest

from tests.pages import REPOSITORY

ROWS = ("no-reader:status", "ascii:vocabulary", "full-output:vocabulary", "sigquit:vocabulary", "dashboard-clients")


@pytest.mark.long
def test_commands_hold_their_promises_in_trouble_that_is_made_outside_them() -> None:
    words = [sys.executable, "-m", "experiments.chaos.outside", f"rows={','.join(ROWS)}", "trials=1"]
    done = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, timeout=500)
    assert re.findall(r"\(`([\w-]+)`\) \| 1 \| 100 %", done.stdout) == [row.split(":")[0] for row in ROWS], done.stderr
    assert done.returncode == 0
