"""Values out of a pickled dict, checked one by one: what is wrong names file, frame and key."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factory.readers.base import BadClip
from factory.wording import shown
from tasks.world.arrays import Array

MISSING = object()


@dataclass(frozen=True)
class Values:
    """The items of one dict; `place` says where it stands in the file, as `frames[3].`."""

    items: Mapping[Any, Any]
    file: str
    place: str = ""

    def bad(self, key: str, problem: str) -> BadClip:
        """The error that names the key."""
        return BadClip(self.file, f"{self.place}{key}", problem)

    def get(self, key: str, default: Any = MISSING) -> Any:
        """The value as it stands, or the default where the key is missing; without one that raises BadClip."""
        value = self.items.get(key, default)
        if value is MISSING:
            raise self.bad(key, "missing")
        return value

    def inner(self, key: str) -> "Values":
        """A dict within. Raises BadClip."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            raise self.bad(key, f"is a {type(value).__name__}, expected a dict")
        return Values(value, self.file, f"{self.place}{key}.")

    def text(self, key: str, *, may_be_empty: bool = False) -> str:
        """Raises BadClip where it is no text, or empty and must not be."""
        value = self.get(key)
        if not isinstance(value, str):
            raise self.bad(key, f"is a {type(value).__name__}, expected text")
        if not value and not may_be_empty:
            raise self.bad(key, "is empty")
        return str(value)

    def integer(self, key: str) -> int:
        """Python's or numpy's. Raises BadClip."""
        value = self.get(key)
        if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
            raise self.bad(key, f"is {shown(value)}, expected a whole number")
        return int(value)

    def numbers(self, key: str, shape: tuple[int | None, ...]) -> Array:
        """A list or an array of finite numbers as float64, never a view of another's; None: any length.

        Raises BadClip.
        """
        value = self.get(key)
        try:
            array = np.array(value, np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.bad(key, f"holds no numbers ({shown(value)})") from error
        if array.size == 0 and shape[0] is None:  # an empty list says nothing of its columns
            array = array.reshape(0, *(n or 0 for n in shape[1:]))
        if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
            raise self.bad(key, f"shape {array.shape}, expected ({', '.join(str(n or 'N') for n in shape)})")
        if not np.isfinite(array).all():
            raise self.bad(key, "holds NaN or infinity")
        return array

    def texts(self, key: str) -> tuple[str, ...]:
        """A list, tuple or array of text. Raises BadClip."""
        value = self.get(key)
        if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
            raise self.bad(key, f"is a {type(value).__name__}, expected a list of text")
        for item in value:
            if not isinstance(item, str):
                raise self.bad(key, f"holds {shown(item)}, expected text")
        return tuple(map(str, value))
