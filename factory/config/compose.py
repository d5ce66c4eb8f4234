"""Configuration: Hydra composes conf/, typed dataclasses take the result, and anything unknown is an error."""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from factory.config.datasets import how_to_read
from factory.config.plugins import register_plugin_choices
from factory.config.shapes import dataclass_in, deep_merge, defaults_of, required_keys, setting_keys, yaml_lines
from factory.config.words import (
    ConfigError,
    SettingsShown,
    as_hydra_override,
    did_you_mean,
    expand_home,
    parse_command_line,
    unknown_choice_text,
)
from factory.files import default_runs_folder, folders_in

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
        raise ConfigError(
            f'{", ".join(missing)} not installed: pip install "driving-data-factory[run]", in a checkout -e ".[run]"'
        )


def conf_dir() -> Path:
    """The folder of the configuration files: inside the installed package, else beside it in a checkout."""
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "run.yaml").is_file():
            return folder
    raise ConfigError(f"no conf/run.yaml in {here} or {here.parent}: the installation is incomplete, install it again")


def config_groups(conf: str) -> dict[str, str]:
    """Group of choices in conf/<conf>.yaml, as a command line names it -> what is chosen there."""
    text = (conf_dir() / f"{conf}.yaml").read_text(encoding="utf-8")
    return dict(re.findall(r"^  - (\w+(?:@\w+)?): (\w+)$", text, re.M))


def compose(
    name: str,
    words: Sequence[str],
    shape: type[Any] | None = None,
    completed: Callable[[dict[str, Any]], dict[str, Any]] = lambda values: values,
    shapes: Callable[[Mapping[str, Any]], Mapping[str, type[Any]]] = lambda values: {},
) -> dict[str, Any]:
    """The resolved configuration `name` with the settings and options of a command line.

    shape: the dataclass of its keys, whose defaults hold for what neither conf/ nor the words say; None: conf/ says
    all, and what is unknown is told when the values are filled in.
    completed: adds what neither of them knows; shapes: of all values, key with dots -> dataclass of an open group.
    Raises SettingsShown for --cfg, where what must be given may be missing, and ConfigError for a misspelt key, an
    unknown choice, bad syntax or a value that must be given and is not.
    """
    asked = parse_command_line(words)
    need_run_extra("hydra", "omegaconf")
    import hydra
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

    OmegaConf.register_new_resolver("runs", default_runs_folder, replace=True)
    groups = {path.name for root in (conf_dir(), *asked.folders) for path in folders_in(root)}
    own = config_groups(name)
    known = [*own, *(key for key, _ in setting_keys(shape))] if shape is not None else [*own]
    overrides = []  # held against the dataclasses and not against conf/, which says few keys: Hydra takes any
    for word in map(as_hydra_override, asked.overrides):
        plain = word.lstrip("+")
        group = plain.partition("=")[0]
        if word == plain and group in groups and group not in own:
            raise ConfigError(_no_such_setting(group, known))
        overrides.append(word if group.partition("@")[0] in groups else f"++{plain}")
    register_plugin_choices(overrides, conf_dir(), asked.folders)
    if asked.folders:
        quoted = ",".join(f"'file://{folder!s}'" for folder in asked.folders)
        overrides.append(f"hydra.searchpath=[{quoted}]")
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            found = hydra.compose(name, overrides)
            try:
                resolved = OmegaConf.to_container(found, resolve=True, throw_on_missing=not asked.shows)
            except InterpolationToMissingValueError:  # a value that is made of one that must be given
                if not asked.shows:
                    raise
                resolved = OmegaConf.to_container(found, resolve=False)
    except MissingMandatoryValue as error:
        key = str(error.full_key)
        what = "<folder>" if key.endswith("root") else "<value>"
        raise ConfigError(f"{key} is missing: give {key}={what}") from error
    except MissingConfigException as error:
        missing = str(error.missing_cfg_file)
        ways = how_to_read(missing.removeprefix("clips/")) if missing.startswith("clips/") else []
        raise ConfigError(unknown_choice_text(missing, error.options, ways)) from error
    except (HydraException, OmegaConfBaseException) as error:
        cause = f" ({error.__cause__})" if error.__cause__ is not None else ""
        raise ConfigError(f"{str(error).strip()}{cause}".splitlines()[0]) from error
    assert isinstance(resolved, dict)
    values = {str(key): expand_home(value, str(key)) for key, value in resolved.items()}
    if shape is not None:
        refuse_unknown(shape, values, "", lambda key: _no_such_setting(key, known))
        values = deep_merge(defaults_of(shape), values)
        values = {**required_keys(shape), **values} if asked.shows else values
    values = completed(values)
    if asked.shows:
        raise SettingsShown("\n".join(yaml_lines(values, shape, shapes(values))))
    return values


def fill(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """The dataclass `cls` filled from a mapping; a text where a list of texts is expected is a list of one.

    Raises ConfigError naming every key, below `where`, that is unknown or whose value has the wrong type.
    """
    need_run_extra("pydantic")
    from pydantic import ValidationError

    refuse_unknown(cls, values, where)
    kind: Any = cls
    try:
        filled: T = _adapter(kind).validate_python(_with_lists(cls, values))
        return filled
    except ValidationError as error:
        raise ConfigError("; ".join(_faults(cls, where, error.errors()))) from error


@cache
def _adapter(cls: Any) -> Any:
    """A tenth of a second for a run's settings, which are filled twice: given, and as the paper's."""
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _with_lists(cls: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    hints = get_type_hints(cls)
    found = dict(values)
    for name, value in values.items():
        inner = dataclass_in(hints[name])
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
    if get_origin(hints[head]) is dict and dataclass_in(get_args(hints[head])[1]):
        return [head, *map(str, rest)]
    return [head, *_path(dataclass_in(hints[head]), rest)]


def _message(error: Any) -> str:
    kind, value = str(error["type"]), error["input"]
    if kind in ("literal_error", "enum"):
        known = str(error["ctx"]["expected"]).replace("'", "")
        return f"must be {known}{did_you_mean(str(value), known.replace(' or ', ', ').split(', '))}"
    known_kind = WORDS_OF.get(kind.partition("_")[0])
    return known_kind or str(error["msg"]).removeprefix("Value error, ")


def refuse_unknown(
    cls: type[Any], values: Mapping[str, Any], where: str, said: Callable[[str], str] = lambda key: ""
) -> None:
    """Raises ConfigError naming the first key, below `where`, that `cls` does not have, and the nearest that it has.

    said: what else is known of such a key.
    """
    prefix = f"{where}." if where else ""
    known = [key for key, _ in setting_keys(cls, prefix)]
    for key in _dotted_keys(cls, values, prefix):
        if key not in known:
            raise ConfigError(said(key) or _no_such_setting(key, known))


def _no_such_setting(key: str, known: Sequence[str]) -> str:
    meant = did_you_mean(key, [other for other in known if other != key])
    more = f"{meant.removesuffix('?')}=?" if meant else "; see --help"
    return f"{key}: there is no such setting{more}"


def _dotted_keys(cls: type[Any], values: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """The keys of `values`, into groups that are dataclasses."""
    hints = get_type_hints(cls)
    for key, value in values.items():
        yield f"{prefix}{key}"
        inner = dataclass_in(hints.get(key))
        if inner is not None and isinstance(value, Mapping):
            yield from _dotted_keys(inner, value, f"{prefix}{key}.")


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
