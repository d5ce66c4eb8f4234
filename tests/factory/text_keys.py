"""Which keys of a dataclass of settings may hold a text, and so the path of a file."""

from typing import Any, get_args, get_origin

from factory.config.shapes import setting_keys


def text_keys(shape: type[Any]) -> list[str]:
    """With dots, into groups."""
    return [key for key, hint in setting_keys(shape) if _takes_text(hint)]


def _takes_text(hint: Any) -> bool:
    return hint is str or (get_origin(hint) is not dict and any(map(_takes_text, get_args(hint))))


def held(values: Any, key: str) -> Any:
    """What composed settings hold under a key with dots."""
    for part in key.split("."):
        values = values[part]
    return values
