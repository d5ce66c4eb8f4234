"""What goes wrong with a command of many clips: it is interrupted after the first, or the first cannot be made."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import pytest


@contextmanager
def interrupted_after_one(command: ModuleType) -> Iterator[None]:
    """Inside, the command is interrupted once it has its first item."""
    each = command.parallel_map

    def first_alone(function, items, *arguments) -> Iterator[object]:  # type: ignore[no-untyped-def]
        yield from each(function, list(items)[:1], *arguments)
        raise command.TaskStopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "parallel_map", first_alone)
        yield


def fail_once(monkeypatch: pytest.MonkeyPatch, work: ModuleType, name: str) -> None:
    """The first call of a function of `work` raises ValueError; what comes after it does not."""
    honest, bad = getattr(work, name), []

    def sometimes(*given):  # type: ignore[no-untyped-def]
        bad.append(1)
        if len(bad) == 1:
            raise ValueError("a plan must be (8 or 40, 3) finite numbers")
        return honest(*given)

    monkeypatch.setattr(work, name, sometimes)
