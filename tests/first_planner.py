"""`make first-planner`: the commands of docs/tutorials/first_planner.md, one after the other, as the page has them.

`python -m tests.first_planner steps=100` gives another value to the commands that have the key. What is done is not
done again, so the same call goes on.
"""

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence

from tests.pages import commands

PAGE = "docs/tutorials/first_planner.md"
ONE_THREAD = {"OMP_NUM_THREADS": "1"}  # a small network gains nothing by more, and loses much where cores are busy


def page_commands(overrides: Sequence[str]) -> list[list[str]]:
    """What is run, with `key=value` in the place of the page's own: not what reads a user's logs, in /data.

    Raises ValueError for a key that no command has.
    """
    run = [list(one.words) for one in commands(PAGE) if not any("/data/" in word for word in one.words)]
    for override in overrides:
        key = f"{override.partition('=')[0]}="
        if not any(word.startswith(key) for words in run for word in words):
            raise ValueError(f"{override}: no command of {PAGE} has {key}")
        run = [[override if word.startswith(key) else word for word in words] for words in run]
    return run


def main(overrides: Sequence[str]) -> int:
    """Run them in this folder; the exit code of the first that fails, or 0."""
    began = time.monotonic()
    for _, *words in page_commands(overrides):
        print(f"\n[{time.monotonic() - began:.0f} s] python {shlex.join(words)}", flush=True)
        if code := subprocess.run([sys.executable, *words], env=ONE_THREAD | os.environ).returncode:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
