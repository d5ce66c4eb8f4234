"""`python -m factory retry out=<folder or URL>`: failed attempts once more, with the run's own settings.

    python -m factory retry out=runs/demo                   says what is tried again and how, then does it
    python -m factory retry out=runs/demo executor=local    with other settings of the run beside the recorded ones

What it would try: python -m factory failed. The settings are those of the newest start of the run (current_run.json);
attempts that are settled are not touched.
Code that they name (`_target_`) is not called on the word of a table: give those settings again.
A table that `import` wrote is no run: the same import again tries what failed.
Exit codes: those of the run; 0 where nothing failed.
"""

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from factory.config.arguments import SOME_RUN_SETTINGS, Refused
from factory.exits import COMPLETE
from factory.views.status import IMPORT_AGAIN, failed_lines, open_store

if TYPE_CHECKING:
    from factory.store.samples import Store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    settings: tuple[str, ...] = field(default=(), metadata=SOME_RUN_SETTINGS)


def main(request: Request) -> int:
    """Say what is to be tried again and how; try it. Raises Refused."""
    from factory.run import main as run
    from factory.store.samples import imported_from

    store = open_store(request.out)
    print("\n".join(failed_lines(store)))
    if "failed" not in store.outcomes.read(["kind"])["kind"].to_pylist():
        return COMPLETE
    if source := imported_from(store.runs()):
        raise Refused(f"{store.location.uri} is no run, its rows were imported: {IMPORT_AGAIN.format(source)}")
    folder, recorded = recorded_command(store, request.settings)
    command = [*recorded, *request.settings, f"out={store.location.uri}", "retry_failed=true"]
    print(f"\nin {folder}: python -m factory run {shlex.join(command)}", flush=True)
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
    mine = ("out=", "retry_failed=")
    words = [str(word) for word in document["command"]]
    words = [word for word in words if not word.startswith(mine) and word not in given]
    code = [word for word in words if "_target_" in word or word.startswith("-")]
    if code:
        raise Refused(f"{where} names code to be called: if you trust it, give it yourself: {shlex.join(code)}")
    return str(document["folder"]), words
