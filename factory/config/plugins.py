"""Readers, experts and planners by name: what installed packages offer through entry points (docs/extend.md), and the
class that a `_target_` names, found or told in one line with the nearest that there is.

A package that declares `mine = "my_package:Mine"` in one of these groups makes `clips=mine`, `experts=[mine]` or
`planner=mine` work wherever it is installed. A module is looked for before anything of it is imported, so that a
misspelt one costs nothing.
"""

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from factory.config.words import ConfigError, did_you_mean
from factory.files import matching
from factory.wording import one_line
from tasks.stages import FRAMES

GROUPS = {
    "clips": "driving_data_factory.readers",
    "expert": "driving_data_factory.experts",
    "planner": "driving_data_factory.planners",
}
WHAT = {"clips": "reader", "expert": "expert", "planner": "planner"}


@dataclass(frozen=True)
class Plugin:
    """What one package offers under a name."""

    name: str
    module: str
    attribute: str
    package: str  # and its version, for messages

    @property
    def target(self) -> str:
        """As `_target_` names it."""
        return f"{self.module}.{self.attribute}"

    @property
    def reference(self) -> str:
        """As `planner.name` names it."""
        return f"{self.module}:{self.attribute}"


def plugins_by_name(kind: str) -> dict[str, list[Plugin]]:
    """Name -> what installed packages offer under it; kind: a key of GROUPS."""
    found: dict[str, list[Plugin]] = {}
    searched = [Path(folder) for folder in sys.path if Path(folder).is_dir()]
    written = tuple((str(folder), folder.stat().st_mtime_ns) for folder in searched)
    for entry in _entry_points(written).select(group=GROUPS[kind]):
        package = "an unnamed package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        found.setdefault(entry.name, []).append(Plugin(entry.name, entry.module, entry.attr, package))
    return {name: sorted(found[name], key=lambda plugin: plugin.package) for name in sorted(found)}


@lru_cache(maxsize=1)
def _entry_points(installed_since: tuple[tuple[str, int], ...]) -> Any:
    """All entry points of these folders: hundreds of files, which one command line asks for four times."""
    return entry_points()


def plugin_named(kind: str, name: str, built_in: Collection[str]) -> Plugin | None:
    """The one plug-in of that name, None where there is none.

    Raises ConfigError naming the packages where two offer it, or one offers what is built in.
    """
    plugins = plugins_by_name(kind).get(name, [])
    if not plugins:
        return None
    by = " and ".join(plugin.package for plugin in plugins)
    if name in built_in:
        raise ConfigError(f"{WHAT[kind]} {name} is built in, and {by} offers another of that name: uninstall {by}")
    if len(plugins) > 1:
        raise ConfigError(f"{WHAT[kind]} {name} is offered by {by}: uninstall all but one, or name the class")
    return plugins[0]


def group_choices(group: str, folders: Sequence[Path]) -> list[str]:
    """What a group of settings offers, sorted: files of its name in the folders, and what packages add to it."""
    return sorted({*_files(group, folders), *(plugins_by_name(group) if group in GROUPS else ())})


def _files(group: str, folders: Sequence[Path]) -> set[str]:
    return {file.stem for folder in folders for file in matching(folder / group, "*.yaml")}


def register_plugin_choices(overrides: Sequence[str], conf: Path, folders: Sequence[Path] = ()) -> None:
    """Make `clips=<name>` and `planner=<name>` choices of Hydra's.

    conf, folders: where the files of the other choices lie. Raises ConfigError where the one that is chosen clashes.
    """
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    chosen = dict(word.partition("=")[::2] for word in overrides)
    for group in ("clips", "planner"):
        built_in = _files(group, (conf, *folders))
        if group in chosen:
            plugin_named(group, chosen[group], built_in)
        for name, plugins in plugins_by_name(group).items():
            if name in built_in or len(plugins) > 1:
                continue
            node = OmegaConf.load(conf / group / "custom.yaml")
            node.name = name
            if group == "clips":
                node._target_ = plugins[0].target
            ConfigStore.instance().store(name=name, node=node, group=group, provider=plugins[0].package)


def add_installed_experts(values: Mapping[str, Any], conf: Path) -> dict[str, Any]:
    """Composed settings with every installed expert as `expert.<name>`; what the command line says of one is kept.

    conf: where the files of the built-in ones lie. Raises ConfigError where one that `experts` names clashes.
    """
    specs = {name: dict(spec) for name, spec in values["expert"].items()}
    built_in = {*_files("expert", (conf,)), *FRAMES}
    asked = [values["experts"]] if isinstance(values["experts"], str) else values["experts"]
    for name, plugins in plugins_by_name("expert").items():
        if "_target_" in specs.get(name, {}) and name not in built_in:
            continue  # the command line names a class
        if name in asked:
            plugin_named("expert", name, built_in)
        if name not in built_in and len(plugins) == 1:
            specs[name] = {"_target_": plugins[0].target, **specs.get(name, {})}
    return {**values, "expert": specs}


# The class that a `_target_` or a planner's name names: found, or told in one line with the nearest that there is.
#
# A module is looked for before anything of it is imported, so that a misspelt one costs nothing.

NEAR_MODULE = 0.75  # hundreds are installed: likenesses of short names mean nothing


def import_target(spec: Mapping[str, Any], where: str, example: str) -> Any:
    """What `spec["_target_"]` names, a class or a function. Raises ConfigError.

    where: the group of settings, for the message; example: a name of the user's own, for where none is given.
    """
    if "_target_" not in spec:
        raise ConfigError(f"{where}._target_ is missing: name the class to use, such as {example}")
    return import_object(str(spec["_target_"]), where, example)


def import_object(name: str, where: str, example: str) -> Any:
    """The class or function of a name such as `package.module.Class` or `package.module:Class`. Raises ConfigError."""
    said, parts = f"{where}: {name}", name.replace(":", ".").split(".")
    if len(parts) < 2 or not all(parts):
        raise ConfigError(f"{said}: name a class with its module, such as {example}")
    if parts[0] != "__main__" and find_spec(parts[0]) is None:
        meant = did_you_mean(parts[0], [module.name for module in iter_modules()], NEAR_MODULE)
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
            raise ConfigError(f"{said}: {'.'.join(parts[:i])} has no {parts[i]}{did_you_mean(parts[i], inside)}")
        found = getattr(found, parts[i])
    return found
