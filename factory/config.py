"""Configuration: Hydra composes conf/, typed dataclasses take the result, and anything unknown is an error."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from factory.job import runs_root

T = TypeVar("T")


class ConfigError(ValueError):
    """The command line or a configuration file asks for something that does not exist or does not fit."""


def need_run_extra(*modules: str) -> None:
    """Raises ConfigError with the line that installs them where one of these modules is not there."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise ConfigError(f'{", ".join(missing)} not installed: pip install -e ".[run]" in the checkout')


def conf_dir() -> Path:
    """The folder of the configuration files: inside the installed package, else beside it in a checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise ConfigError(f"no conf/run.yaml in {here} or {here.parent}: the installation is incomplete, install it again")


def compose(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved configuration `name` with the overrides of a command line.

    Raises ConfigError for a misspelt key, an unknown choice, bad syntax or a value that must be given and is not.
    """
    need_run_extra("hydra", "omegaconf")
    import hydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    OmegaConf.register_new_resolver("runs", runs_root, replace=True)
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            config = hydra.compose(name, list(overrides))
        resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = str(error.full_key)
        what = "<folder>" if key.endswith("root") else "<value>"
        raise ConfigError(f"{key} is missing: give {key}={what}") from error
    except (HydraException, OmegaConfBaseException) as error:
        cause = f" ({error.__cause__})" if error.__cause__ is not None else ""
        raise ConfigError(f"{str(error).strip()}{cause}{_meant(name, str(error))}") from error
    assert isinstance(resolved, dict)
    return {str(key): value for key, value in resolved.items()}


def _meant(name: str, message: str) -> str:
    """For a key that does not exist: the one that was perhaps meant."""
    import hydra
    from omegaconf import OmegaConf

    missed = re.search(r"Could not override '([\w.]+)'", message)
    if missed is None:
        return ""
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        known = list(_dotted(OmegaConf.to_container(hydra.compose(name)), ""))
    near = get_close_matches(missed[1], known, n=1, cutoff=0.6)
    return f"\ndid you mean {near[0]}=?" if near else ""


def _dotted(tree: Any, prefix: str) -> Iterator[str]:
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")


def fill(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """The dataclass `cls` filled from a mapping.

    Raises ConfigError naming every key that is unknown or whose value has the wrong type.
    """
    need_run_extra("pydantic")
    from pydantic import TypeAdapter, ValidationError

    unknown = list(_unknown_keys(cls, values, where))
    if unknown:
        raise ConfigError(f"unknown setting {', '.join(unknown)}")
    try:
        return TypeAdapter(cls).validate_python(dict(values))
    except ValidationError as error:
        raise ConfigError("; ".join(_line(where, e["loc"], e["msg"], e["input"]) for e in error.errors())) from error


def _line(where: str, loc: Sequence[str | int], message: str, value: object) -> str:
    """One fault; a whole group of settings is not printed, its message names the one that is wrong."""
    got = "" if not loc or isinstance(value, Mapping) else f" (got {value!r})"
    return f"{'.'.join(map(str, (where, *loc)))}: {message.removeprefix('Value error, ')}{got}"


def _unknown_keys(cls: type[Any], values: Mapping[str, Any], where: str) -> list[str]:
    hints = get_type_hints(cls)
    names = {field.name for field in dataclasses.fields(cls)}
    found = [f"{where}.{key}" for key in values if key not in names]
    for name in names & set(values):
        inner = _dataclass_in(hints[name])
        if inner is not None and isinstance(values[name], Mapping):
            found += _unknown_keys(inner, values[name], f"{where}.{name}")
    return found


def _dataclass_in(hint: Any) -> type[Any] | None:
    options = get_args(hint) if get_origin(hint) is not None else (hint,)
    return next((option for option in options if isinstance(option, type) and dataclasses.is_dataclass(option)), None)


def build(spec: Mapping[str, Any], where: str, labels: Sequence[str] = ("name",)) -> Any:
    """The object a `_target_` names, called with the spec's other keys. `labels` are for the configuration alone.

    Raises ConfigError when the target cannot be imported or does not take these arguments.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    if "_target_" not in spec:
        raise ConfigError(f"{where}._target_ is missing: name the class to use, such as my_package.MyReader")
    try:
        return instantiate({key: value for key, value in spec.items() if key not in labels}, _convert_="all")
    except InstantiationException as error:
        raise ConfigError(f"{where}: {error}") from error
