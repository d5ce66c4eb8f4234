"""Configuration: Hydra composes conf/, typed dataclasses take the result, and anything unknown is an error."""

import dataclasses
from collections import defaultdict
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from factory.config.plugins import offer_choices, with_experts
from factory.config.words import Asked, ConfigError, asked_of, nearest, no_such_choice, readable, wrong_key
from factory.job import runs_root

T = TypeVar("T")
WORDS_OF = {  # pydantic's kind of error -> what a value must be
    "int": "must be a whole number",
    "float": "must be a number",
    "bool": "must be true or false",
    "tuple": "must be a list, such as [a,b]",
    "list": "must be a list, such as [a,b]",
    "string": "must be text",
    "dataclass": "must be a group of settings",
    "dict": "must be a group of settings",
    "missing": "must be given",
}


def need_run_extra(*modules: str) -> None:
    """Raises ConfigError with the line that installs them where one of these modules is not there."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise ConfigError(f'{", ".join(missing)} not installed: pip install -e ".[run]" in the checkout')


def conf_dir() -> Path:
    """The folder of the configuration files: inside the installed package, else beside it in a checkout."""
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise ConfigError(f"no conf/run.yaml in {here} or {here.parent}: the installation is incomplete, install it again")


def compose(name: str, words: Sequence[str]) -> dict[str, Any]:
    """The resolved configuration `name` with the settings and options of a command line.

    Raises ConfigError for a misspelt key, an unknown choice, bad syntax or a value that must be given and is not.
    """
    asked = asked_of(words)
    need_run_extra("hydra", "omegaconf")
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    OmegaConf.register_new_resolver("runs", runs_root, replace=True)
    overrides = [readable(word) for word in asked.overrides]
    offer_choices(overrides, conf_dir(), asked.folders)
    try:
        resolved = OmegaConf.to_container(
            _composed(name, overrides, asked.folders), resolve=True, throw_on_missing=True
        )
    except MissingMandatoryValue as error:
        key = str(error.full_key)
        what = "<folder>" if key.endswith("root") else "<value>"
        raise ConfigError(f"{key} is missing: give {key}={what}") from error
    except MissingConfigException as error:
        raise ConfigError(no_such_choice(error.missing_cfg_file or "", error.options)) from error
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_wrong(name, asked, overrides) or _first_line(error)) from error
    assert isinstance(resolved, dict)
    values = {str(key): value for key, value in resolved.items()}
    return with_experts(values) if "experts" in values and "expert" in values else values


def _composed(name: str, overrides: Sequence[str], folders: Sequence[Path]) -> Any:
    import hydra

    quoted = ",".join(f"'file://{folder!s}'" for folder in folders)
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra.compose(name, [*overrides, *([f"hydra.searchpath=[{quoted}]"] if folders else [])])


def _wrong(name: str, asked: Asked, overrides: Sequence[str]) -> str:
    """What is wrong with the first key that does not fit the chosen groups."""
    from omegaconf import OmegaConf

    roots = [conf_dir(), *asked.folders]
    groups = {folder.name for root in roots for folder in root.iterdir() if folder.is_dir()}
    chosen = [word for word in overrides if word.partition("=")[0].partition("@")[0].lstrip("+~") in groups]
    tree = OmegaConf.to_container(_composed(name, chosen, asked.folders))
    assert isinstance(tree, dict)
    others = {
        f"{group}={path.stem}": OmegaConf.to_container(OmegaConf.load(path))
        for root in roots
        for group in sorted(groups)
        for path in sorted((root / group).glob("*.yaml"))
    }
    faults = (wrong_key(word, tree, others) for word in asked.overrides if word not in chosen)  # type: ignore[arg-type]
    return next((fault for fault in faults if fault), "")


def _first_line(error: Exception) -> str:
    """Hydra's own words, where none of ours fit."""
    cause = f" ({error.__cause__})" if error.__cause__ is not None else ""
    return f"{str(error).strip()}{cause}".splitlines()[0]


def fill(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """The dataclass `cls` filled from a mapping; a text where a list of texts is expected is a list of one.

    Raises ConfigError naming every key, below `where`, that is unknown or whose value has the wrong type.
    """
    need_run_extra("pydantic")
    from pydantic import TypeAdapter, ValidationError

    unknown = list(_unknown_keys(cls, values, where))
    if unknown:
        raise ConfigError(f"unknown setting {', '.join(unknown)}")
    try:
        return TypeAdapter(cls).validate_python(_with_lists(cls, values))
    except ValidationError as error:
        raise ConfigError("; ".join(_faults(cls, where, error.errors()))) from error


def _with_lists(cls: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    hints = get_type_hints(cls)
    found = dict(values)
    for name, value in values.items():
        inner = _dataclass_in(hints[name])
        if inner is not None and isinstance(value, Mapping):
            found[name] = _with_lists(inner, value)
        elif hints[name] == tuple[str, ...] and isinstance(value, str) and value:
            found[name] = [value]
    return found


def _faults(cls: type[Any], where: str, errors: Sequence[Any]) -> list[str]:
    """One line for each key; a whole group of settings is not printed, its message names the one that is wrong."""
    said: dict[str, list[str]] = defaultdict(list)
    got: dict[str, str] = {}
    for error in errors:
        key = ".".join(part for part in (where, *_path(cls, error["loc"])) if part)
        said[key].append(_message(error))
        if error["loc"] and not isinstance(error["input"], Mapping):
            got[key] = f" (got {error['input']!r})"
    lines = {key: " or ".join(dict.fromkeys(messages)).replace(" or must", " or") for key, messages in said.items()}
    return [f"{key}: {line}{got.get(key, '')}" if key else line for key, line in lines.items()]


def _path(cls: type[Any] | None, loc: Sequence[str | int]) -> list[str]:
    """Names of fields and places in lists; the branch of a union that pydantic tried is none."""
    if not loc:
        return []
    head, *rest = loc
    if isinstance(head, int):
        return [str(head), *_path(None, rest)]
    if cls is None or head not in (hints := get_type_hints(cls)):
        return []
    return [head, *_path(_dataclass_in(hints[head]), rest)]


def _message(error: Any) -> str:
    kind, value = str(error["type"]), error["input"]
    if kind in ("literal_error", "enum"):
        known = str(error["ctx"]["expected"]).replace("'", "")
        return f"must be {known}{nearest(str(value), known.replace(' or ', ', ').split(', '))}"
    known_kind = WORDS_OF.get(kind.partition("_")[0])
    return known_kind or str(error["msg"]).removeprefix("Value error, ")


def _unknown_keys(cls: type[Any], values: Mapping[str, Any], where: str) -> list[str]:
    hints = get_type_hints(cls)
    names = {field.name for field in dataclasses.fields(cls)}
    found = [".".join(filter(None, (where, key))) for key in values if key not in names]
    for name in names & set(values):
        inner = _dataclass_in(hints[name])
        if inner is not None and isinstance(values[name], Mapping):
            found += _unknown_keys(inner, values[name], ".".join(filter(None, (where, name))))
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
        cause = error.__cause__ or error
        why = str(cause).strip().splitlines() or [type(cause).__name__]
        taken = "does not take these settings: " if isinstance(cause, TypeError) else ""
        raise ConfigError(f"{where}: {spec['_target_']}: {taken}{why[-1]}") from error
