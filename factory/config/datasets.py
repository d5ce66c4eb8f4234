"""What the built-in data sets offer: one folder of factory/datasets each, found by its name and imported nowhere else.

The package of a folder is light, and says what there is by these names, each of which may be missing:

    READERS             class in its module `reader` -> dataclass of the settings of `clips`
    READS               names that people give to its logs, in small letters; the settings for them, and their page
    camera_names        settings of clips -> names of the rig, before a log is read; ValueError where there is no log

and by these words -> `module:function`, which is imported when the word is used:

    IMPORTS, SIDECARS   of `python -m factory import`: it writes samples, or sidecars of photos
    EXPORTS             of `python -m factory export`: it writes all samples
    DRIVES              of `python -m factory scene`: it reads a drive that is known by its photos alone
    KERNELS             of `python -m factory warm`: it enters what the data set alone compiles
    BENCHMARKS          of `python -m planners evaluate benchmark=`: it makes the folder
"""

import re
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pkgutil import iter_modules, resolve_name
from types import ModuleType
from typing import Any

FOLDER = "factory.datasets"
LIKE = 0.7  # a name of logs that is meant: waymo_open, argoverse


@cache
def data_sets() -> Mapping[str, ModuleType]:
    """Name of a folder -> its package, sorted."""
    names = sorted(found.name for found in iter_modules(import_module(FOLDER).__path__))
    return {name: import_module(f"{FOLDER}.{name}") for name in names}


def data_set_of(clips: Mapping[str, Any]) -> ModuleType | None:
    """The data set whose reader the settings of clips name; None for a reader of the user's own."""
    folder, _, inside = str(clips.get("_target_", "")).rpartition(".reader.")
    return next((found for found in data_sets().values() if inside and found.__name__ == folder), None)


def reader_settings(clips: Mapping[str, Any]) -> type[Any] | None:
    """The dataclass of a built-in reader's settings; None for a reader of the user's own."""
    shapes: Mapping[str, type[Any]] = getattr(data_set_of(clips), "READERS", {})
    return shapes.get(str(clips.get("_target_", "")).rpartition(".")[2])


def how_to_read(name: str) -> list[str]:
    """What reads logs of that name or one like it, each as READS says it; none where no data set knows them."""
    told = [found.READS for found in data_sets().values() if hasattr(found, "READS")]
    words = " ".join(names for names, _ in told).split()
    near = get_close_matches(re.sub(r"\W|_", "", name.lower()), words, 1, LIKE)
    return [way for names, way in told if {*near} & {*names.split()}]


def words_of(kind: str) -> dict[str, str]:
    """Word -> name of what some data set offers under it, `module:function`; kind: IMPORTS or another of the above."""
    return {word: name for found in data_sets().values() for word, name in getattr(found, kind, {}).items()}


def find_function(kind: str, word: str) -> Any:
    """What a data set offers under a word of a kind, imported now."""
    return resolve_name(words_of(kind)[word])
