"""The arguments of a command: one parser, from `key=value` and plain words to a typed dataclass of its own."""

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin, get_type_hints

from factory.config.shapes import choices_of, defaults_of, described, plain, to_give
from factory.config.words import SHOW, ConfigError, SettingsShown, at_home, nearest, without_show
from factory.exits import BAD_CONFIG

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Metadata of a field. Of WORD: it may stand without its key; the fields in their order, a tuple for all that is left.
WORD = {"given": "word"}
RUN = {"given": "run"}  # it takes every argument that is no field: settings of the run
SOME = {**RUN, "of": "some"}  # of them what is given alone: the others are recorded, or of no use here
Request = TypeVar("Request", bound="DataclassInstance")


class Refused(ValueError):
    """The request cannot be answered; the message says why."""


def answer(command: ModuleType, argv: Sequence[str]) -> int:
    """A whole command: its help, or `main` of its Request; the exit code, 0 where `main` returns none."""
    if {"-h", "--help"} & set(argv):
        print(
            f"{command.__doc__}\nExit codes: 0 done, 2 refused in one line that says why; all: docs/configuration.md."
        )
        return 0
    try:
        return command.main(parse(command.Request, argv)) or 0
    except SettingsShown as settings:
        print(settings)
        return 0
    except (Refused, ConfigError, MemoryError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG


def parse(shape: type[Request], argv: Sequence[str]) -> Request:
    """A request out of arguments; its fields are the keys: text, a number, a switch, a Literal, a list of texts.

    Raises Refused for an unknown key, a value missing or of another kind, a key given twice, and a field without a
    default that is not given; with --cfg SettingsShown instead, whatever is not given yet.
    """
    argv, shows = without_show(argv)
    kinds, words, rest = keys_of(shape), given_as(shape, WORD), given_as(shape, RUN)
    given: dict[str, Any] = dict.fromkeys(rest, ())
    for argument in argv:
        key, equals, value = argument.partition("=")
        if key in kinds and value:
            if key in given:
                raise Refused(f"{key} is given twice")
            given[key] = at_home(_value(key, value, kinds[key]), key)
        elif words and not equals and not argument.startswith("-"):
            name = words[0]
            if get_origin(kinds[name]) is tuple:
                given[name] = (*given.get(name, ()), at_home(argument, name))
                continue
            if name in given:
                raise Refused(f"{name} is given twice")
            given[name] = at_home(_value("", argument, kinds[words.pop(0)]), name)
        elif rest:
            given[rest[0]] += (argument,)
        else:
            known = [f"{name}=" for name in kinds]
            near = "" if key in kinds else nearest(key, known)
            raise Refused(f"{argument!r}: expected one of {'..., '.join(known)}...; see --help{near}")
    if shows:
        raise SettingsShown("\n".join(_shown(shape, given)))
    for field in fields(shape):
        if field.default is MISSING and field.name not in given:
            choices = "|".join(map(str, get_args(kinds[field.name])))
            what = "<folder or URL of a run>" if field.name == "out" else choices or "..."
            raise Refused(f"{field.name}={what} is missing; see --help")
    try:
        return shape(**given)
    except ValueError as error:
        raise Refused(str(error)) from error


def keys_of(shape: type["DataclassInstance"]) -> dict[str, Any]:
    """Key -> type of a request's fields, less the one that takes the settings of the run."""
    hints, rest = get_type_hints(shape), given_as(shape, RUN)
    return {field.name: hints[field.name] for field in fields(shape) if field.name not in rest}


def given_as(shape: type["DataclassInstance"], how: Mapping[str, str]) -> list[str]:
    """The fields that are given as words, or that take the settings of the run."""
    return [field.name for field in fields(shape) if how.items() <= field.metadata.items()]


def _shown(shape: type["DataclassInstance"], given: Mapping[str, Any]) -> Iterator[str]:
    """The keys of a request as YAML, and behind them the settings of the run that it takes."""
    own = keys_of(shape)
    values = {**to_give(shape), **defaults_of(shape), **{name: plain(value) for name, value in given.items()}}
    yield from described({name: values[name] for name in own}, shape, {})
    for name in given_as(shape, RUN):
        groups = {re.split("[=.@]", word.lstrip("+"))[0] for word in given[name]}
        keeps = True
        for line in _settings_of_run(given[name]).splitlines():
            if name in given_as(shape, SOME) and not line.startswith(" "):
                keeps = line.partition(":")[0] in groups
            if keeps:
                yield line


def _settings_of_run(words: Sequence[str]) -> str:
    from factory.config.run import composed_run

    try:
        composed_run([SHOW[0], *words])
    except SettingsShown as settings:
        return str(settings)
    raise AssertionError("what is only to be shown is shown")


def _value(key: str, text: str, kind: Any) -> Any:
    allowed, said = {kind, *get_args(kind)}, f"{key}={text}" if key else repr(text)
    choices = choices_of(kind)
    if choices and (text.lower() if bool in allowed else text) not in choices:
        listed = "true or false" if bool in allowed else f"one of {', '.join(choices)}"
        raise Refused(f"{said}: must be {listed}{nearest(text, choices)}")
    if bool in allowed:
        return text.lower() == "true"
    if int in allowed and not (text.isascii() and text.isdecimal()):
        raise Refused(f"{said}: must be a whole number, 0 or more")
    if get_origin(kind) is tuple:
        return tuple(part.strip() for part in text.strip("[]").split(","))
    try:
        return int(text) if int in allowed else float(text) if float in allowed else text
    except ValueError as error:
        raise Refused(f"{said}: must be a number") from error
