"""Pickled logs as data that a test may change."""

from pathlib import Path
from typing import Any

import numpy as np

from factory.readers.pickles import load_plain


def load_writable(path: Path) -> Any:
    """What `load_plain` gives of a file, which runs nothing of it, with arrays that can be written. Raises BadClip."""
    return writable(load_plain(path.read_bytes(), str(path)))


def writable(value: Any) -> Any:
    """The same with copies of all containers and arrays in it."""
    if isinstance(value, np.ndarray):
        return np.array(value)
    if isinstance(value, dict):
        return {key: writable(item) for key, item in value.items()}
    return type(value)(map(writable, value)) if isinstance(value, list | tuple) else value
