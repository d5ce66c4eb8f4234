"""What a dataclass of settings says of itself: its keys, their defaults, their choices, and what each means.

A field means what the comment behind it says; a group of fields, what its dataclass' docstring begins with.
"""

import inspect
import io
import json
import re
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, is_dataclass
from enum import Enum
from keyword import iskeyword
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from tasks.settings import configurable_fields

SWITCH = ("false", "true")
GIVE = "???"  # as Hydra has it: a value that must be given
PLAIN = re.compile(r"[A-Za-z_/.~]([\w./:~-]*[\w./~-])?")  # text that YAML reads as text without quotes,
OTHERWISE = {"null", "~", "true", "false", "yes", "no", "on", "off", "y", "n"}  # but for these


def dataclass_in(hint: Any) -> type[Any] | None:
    """The dataclass that a field's type is, or allows beside None."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return next((option for option in options if isinstance(option, type) and is_dataclass(option)), None)


def setting_keys(shape: type[Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key with dots that may be set, groups before what is in them, and its type."""
    hints = get_type_hints(shape)
    for field in configurable_fields(shape):
        yield f"{prefix}{field.name}", hints[field.name]
        inner = dataclass_in(hints[field.name])
        if inner is not None:
            yield from setting_keys(inner, f"{prefix}{field.name}.")


def allowed_values(hint: Any) -> list[str]:
    """The words that a key may have, where they are few."""
    if hint is bool:
        return list(SWITCH)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return [str(member.value) for member in hint]
    if get_origin(hint) is Literal:
        return [str(value) for value in get_args(hint)]
    return [choice for option in get_args(hint) if get_origin(option) is Literal for choice in allowed_values(option)]


def defaults_of(shape: type[Any]) -> dict[str, Any]:
    """Key -> default of every field that has one, as YAML would hold it."""
    return {
        field.name: to_plain(_default(field)) for field in configurable_fields(shape) if _default(field) is not MISSING
    }


def required_keys(shape: type[Any]) -> dict[str, Any]:
    """Key -> ??? of every field that has no default."""
    return {field.name: GIVE for field in configurable_fields(shape) if _default(field) is MISSING}


def _default(field: Field[Any]) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def to_plain(value: Any) -> Any:
    """Dataclasses as mappings of what they offer, tuples as lists, enums as text."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in configurable_fields(type(value))}
    if isinstance(value, Mapping):
        return {key: to_plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(inner) for inner in value]
    return value.value if isinstance(value, Enum) else value


def deep_merge(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`under` with what `over` says, group by group."""
    both = {
        key: deep_merge(under[key], value)
        if isinstance(value, Mapping) and isinstance(under.get(key), Mapping)
        else value
        for key, value in over.items()
    }
    return {**under, **both}


def field_comments(shape: type[Any]) -> Mapping[str, str]:
    """Field -> its comment; of a group without one, the first sentence of its docstring."""
    found: dict[str, str] = {}
    for cls in reversed(shape.__mro__):
        if is_dataclass(cls):
            found |= _comments(cls)
    for name, hint in get_type_hints(shape).items():
        inner = dataclass_in(hint)
        if inner is not None and name not in found:
            found[name] = (inspect.getdoc(inner) or "").partition("\n")[0].rstrip(".")
    return found


def _comments(cls: type[Any]) -> dict[str, str]:
    """Field -> the comments on the lines of its statement."""
    names, found, words = inspect.get_annotations(cls), {}, []
    statement: list[str] = []
    for token in tokenize.generate_tokens(io.StringIO(inspect.cleandoc("\n" + inspect.getsource(cls))).readline):
        if token.type == tokenize.COMMENT and statement:
            words.append(token.string.lstrip("# "))
        elif token.type == tokenize.NEWLINE:
            if words and len(statement) > 1 and statement[0] in names and statement[1] == ":":
                found[statement[0]] = " ".join(words)
            statement, words = [], []
        elif token.type in (tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING):
            statement.append(token.string)
    return found


def yaml_lines(
    values: Mapping[str, Any], shape: type[Any] | None, others: Mapping[str, type[Any]], key: str = ""
) -> Iterator[str]:
    """The values as lines of YAML, each with its meaning behind it.

    others: key with dots -> the dataclass of a group that `shape` leaves open.
    """
    hints = {} if shape is None else get_type_hints(shape)
    about = {} if shape is None else field_comments(shape)
    for name, value in values.items():
        path = f"{key}.{name}" if key else name
        words = allowed_values(hints.get(name))
        said = "; ".join(filter(None, (" | ".join(words) if words != list(SWITCH) else "", about.get(name))))
        comment = f"  # {said}" if said else ""
        pad = "  " * path.count(".")
        if isinstance(value, Mapping) and value:
            yield f"{pad}{name}:{comment}"
            yield from yaml_lines(value, others.get(path, dataclass_in(hints.get(name))), others, path)
        else:
            yield f"{pad}{key_of(name)}: {_scalar(value)}{comment}"


def key_of(name: str) -> str:
    """The key of a field; that of `for_` is `for`, which is a word of Python."""
    return name[:-1] if name.endswith("_") and iskeyword(name[:-1]) else name


def _scalar(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_scalar, value))}]"
    if value == GIVE or (isinstance(value, str) and PLAIN.fullmatch(value) and value.lower() not in OTHERWISE):
        return value
    return json.dumps(value)
