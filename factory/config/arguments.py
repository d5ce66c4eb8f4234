"""key=value arguments of the commands that look at a run, as a typed dataclass of theirs."""

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, fields
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BAD_ARGUMENTS = 2  # the exit code
Request = TypeVar("Request", bound="DataclassInstance")


class Refused(ValueError):
    """The request cannot be answered; the message says why."""


def answer(about: str, shape: type[Request], argv: Sequence[str], lines: Callable[[Request], Iterable[str]]) -> int:
    """A whole command: help, arguments, its lines printed as they come; the exit code."""
    if {"-h", "--help"} & set(argv):
        print(about)
        return 0
    try:
        for line in lines(parse(shape, argv)):
            print(line, flush=True)
    except Refused as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS
    return 0


def parse(shape: type[Request], argv: Sequence[str]) -> Request:
    """A request out of arguments; its fields are the keys, each a str, an int or a bool, or one of these and None.

    Raises Refused for an unknown key, a value missing or of another kind, a key given twice, and a field without a
    default that is not given.
    """
    kinds = get_type_hints(shape)
    given: dict[str, Any] = {}
    for argument in argv:
        key, equals, value = argument.partition("=")
        if key not in kinds or not equals or not value:
            near = "" if key in kinds else "".join(get_close_matches(key, kinds, 1, 0.6))
            meant = f"; did you mean {near}=?" if near else ""
            known = ", ".join(f"{name}=..." for name in kinds)
            raise Refused(f"{argument!r}: expected one of {known}; see --help{meant}")
        if key in given:
            raise Refused(f"{key} is given twice")
        given[key] = _value(key, value, kinds[key])
    for field in fields(shape):
        if field.default is MISSING and field.name not in given:
            what = "<folder or URL of a run>" if field.name == "out" else "..."
            raise Refused(f"{field.name}={what} is missing; see --help")
    try:
        return shape(**given)
    except ValueError as error:
        raise Refused(str(error)) from error


def _value(key: str, text: str, kind: Any) -> str | int | bool:
    allowed = {kind, *get_args(kind)}
    if bool in allowed:
        if text.lower() not in ("true", "false"):
            raise Refused(f"{key}={text}: must be true or false")
        return text.lower() == "true"
    if int in allowed:
        if not (text.isascii() and text.isdecimal()):
            raise Refused(f"{key}={text}: must be a whole number, 0 or more")
        return int(text)
    return text
