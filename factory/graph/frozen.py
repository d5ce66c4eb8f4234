"""What several attempts are given is read only, as a shared object store hands it out: none changes another's bytes."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def frozen(value: T) -> T:
    """The same value; every numpy array in its dataclasses, mappings and sequences is read only from here on."""
    seen: set[int] = set()
    waiting: list[object] = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, str | bytes | int | float | bool | None) or id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            one.flags.writeable = False
        elif is_dataclass(one) and not isinstance(one, type):
            waiting += [getattr(one, member.name) for member in fields(one)]
        elif isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, list | tuple | frozenset):
            waiting += one
    return value
