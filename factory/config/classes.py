"""The class that a `_target_` or a planner's name names: found, or told in one line with the nearest that there is.

A module is looked for before anything of it is imported, so that a misspelt one costs nothing.
"""

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

from factory.config.words import ConfigError, nearest
from factory.wording import one_line

NEAR_MODULE = 0.75  # hundreds are installed: likenesses of short names mean nothing


def class_of(spec: Mapping[str, Any], where: str, example: str) -> Any:
    """What `spec["_target_"]` names, a class or a function. Raises ConfigError.

    where: the group of settings, for the message; example: a name of the user's own, for where none is given.
    """
    if "_target_" not in spec:
        raise ConfigError(f"{where}._target_ is missing: name the class to use, such as {example}")
    return object_named(str(spec["_target_"]), where, example)


def object_named(name: str, where: str, example: str) -> Any:
    """The class or function of a name such as `package.module.Class` or `package.module:Class`. Raises ConfigError."""
    said, parts = f"{where}: {name}", name.replace(":", ".").split(".")
    if len(parts) < 2 or not all(parts):
        raise ConfigError(f"{said}: name a class with its module, such as {example}")
    if parts[0] != "__main__" and find_spec(parts[0]) is None:
        meant = nearest(parts[0], [module.name for module in iter_modules()], NEAR_MODULE)
        raise ConfigError(f"{said}: there is no module {parts[0]}{meant or '; is it installed, or on PYTHONPATH?'}")
    depth = 1
    try:
        found: Any = import_module(parts[0])
        while depth < len(parts) - 1 and hasattr(found, "__path__") and find_spec(".".join(parts[: depth + 1])):
            depth += 1
            found = import_module(".".join(parts[:depth]))
    except Exception as error:  # whatever a stranger's module does when it is imported
        module = ".".join(parts[:depth])
        raise ConfigError(f"{said}: {module} cannot be imported: {type(error).__name__}: {one_line(error)}") from error
    for i in range(depth, len(parts)):
        if not hasattr(found, parts[i]):
            inside = [*vars(found), *(module.name for module in iter_modules(getattr(found, "__path__", [])))]
            raise ConfigError(f"{said}: {'.'.join(parts[:i])} has no {parts[i]}{nearest(parts[i], inside)}")
        found = getattr(found, parts[i])
    return found
