"""Which keys of a dataclass of settings may hold a text, and so the path of a file."""

from typing import Any, get_args, get_origin

from factory.config.shapes import setting_keys
from factory.config.words import FREE, PATHS

# Last words of the keys whose text names no file: a new key is one of these, or of factory.config.words.PATHS.
TEXTS = (
    "authors camera checkpoint_every clip column country device driver email expert experts full host institution "
    "keep_every map_location name older_than only only_logs origin parts policy round sample settings tag "
    "team_name validate_every version without_logs"
)
NO_PATHS = frozenset(TEXTS.split())


def text_keys(shape: type[Any]) -> list[str]:
    """With dots, into groups."""
    return [key for key, hint in setting_keys(shape) if _takes_text(hint)]


def led_home(key: str, home: object) -> str:
    """What `key=~/x` becomes, in a home folder. A key that nobody has sorted fails."""
    word = key.rpartition(".")[2]
    assert (word in PATHS) != (word in NO_PATHS), f"{key} names a file, or does not: say so in PATHS or NO_PATHS"
    return f"{home}/x" if word in PATHS or key.startswith(FREE) else "~/x"


def _takes_text(hint: Any) -> bool:
    return hint is str or (get_origin(hint) is not dict and any(map(_takes_text, get_args(hint))))


def held(values: Any, key: str) -> Any:
    """What composed settings hold under a key with dots."""
    for part in key.split("."):
        values = values[part]
    return values
