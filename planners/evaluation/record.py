"""What an evaluated planner's folder says of itself; it is written last, so a folder without it is not done."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError

RECORD = "record.json"


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Whole or not at all."""
    unfinished = folder / f".{RECORD}.{os.getpid()}"
    unfinished.write_text(json.dumps(record, indent=1, sort_keys=True))
    os.replace(unfinished, folder / RECORD)


def read_record(folder: Path) -> dict[str, Any]:
    """Raises ConfigError where there is none or it is damaged."""
    try:
        record = json.loads((folder / RECORD).read_text())
    except FileNotFoundError as error:
        raise ConfigError(f"{folder}: no {RECORD}: no planner was evaluated here, or not to the end") from error
    except ValueError as error:
        raise ConfigError(f"{folder / RECORD}: {error}: remove it and evaluate again") from error
    assert isinstance(record, dict)
    return record


def forget(folder: Path) -> None:
    """From here on the folder is not done: what it holds is about to be replaced."""
    (folder / RECORD).unlink(missing_ok=True)


def is_done(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Whether the folder holds what `identity` (planner, benchmark, rules) describes, whole."""
    if not (folder / RECORD).is_file():
        return False
    record = read_record(folder)
    return all(record.get(name) == value for name, value in identity.items())
