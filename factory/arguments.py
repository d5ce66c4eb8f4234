"""key=value arguments of the commands that look at a run, as a typed dataclass of theirs."""

from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BAD_ARGUMENTS = 2  # the exit code
Request = TypeVar("Request", bound="DataclassInstance")


class Refused(ValueError):
    """The request cannot be answered; the message says why."""


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
            raise Refused(f"{argument!r}: expected one of {', '.join(f'{name}=...' for name in kinds)}; see --help")
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
