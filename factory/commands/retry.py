"""`python -m factory retry out=<folder or URL>`: failed attempts once more, with the run's own settings.

    python -m factory retry out=runs/demo                   says what is tried again and how, then does it
    python -m factory retry out=runs/demo dry_run=true      only says it
    python -m factory retry out=runs/demo executor=local    with other settings of the run beside the recorded ones

The settings are those of the newest start of the run (current_run.json); attempts that are settled are not touched.
Code that they name (`_target_`) is not called on the word of a table: give those settings again.
Exit codes: those of the run; 2 too where there is no run, or it recorded no settings; 0 where nothing failed.
"""

import json
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from factory.config.arguments import BAD_ARGUMENTS, Refused
from factory.views.status import failed_lines, open_store

if TYPE_CHECKING:
    from factory.store.samples import Store


@dataclass(frozen=True)
class Request:
    """The keys of this command itself."""

    out: str
    dry_run: bool = False


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return retry(argv)
    except Refused as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS


def retry(argv: Sequence[str]) -> int:
    """Say what is to be tried again and how; try it. Raises Refused."""
    from factory.run import main as run

    given = dict(argument.partition("=")[::2] for argument in argv)
    if not given.get("out"):
        raise Refused("out=<folder or URL of a run> is missing; see --help")
    store = open_store(given["out"])
    print("\n".join(failed_lines(store)))
    if "failed" not in store.outcomes.read(["kind"])["kind"].to_pylist():
        return 0
    others = [argument for argument in argv if argument.partition("=")[0] not in ("out", "dry_run")]
    folder, recorded = recorded_command(store, others)
    command = [*recorded, *others, f"out={store.location.uri}", "retry_failed=true"]
    print(f"\nin {folder}: python -m factory run {shlex.join(command)}", flush=True)
    if given.get("dry_run", "false").lower() == "true":
        return 0
    if Path(folder).is_dir():
        os.chdir(folder)  # paths among the settings are relative to where the run was started
    return run(command)


def recorded_command(store: "Store", given: Sequence[str] = ()) -> tuple[str, list[str]]:
    """The folder that the newest start was given in, and its settings less those that are `given`.

    Raises Refused where none is recorded, and where they name code: a table is data, whoever wrote it, and what is
    called on its behalf must be said by who runs it.
    """
    from factory.store.samples import CURRENT_RUN

    document = json.loads(store.location.read(CURRENT_RUN) or b"{}")
    where = f"{store.location.uri}/{CURRENT_RUN}"
    if document.get("command") is None:
        raise Refused(f"{where} records no settings: run the same command with retry_failed=true")
    mine = ("out=", "retry_failed=", "dry_run=")
    words = [str(word) for word in document["command"]]
    words = [word for word in words if not word.startswith(mine) and word not in given]
    code = [word for word in words if "_target_" in word or word.startswith("-")]
    if code:
        raise Refused(f"{where} names code to be called: if you trust it, give it yourself: {shlex.join(code)}")
    return str(document["folder"]), words


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
