"""Rates, times and errors as people say them."""

import re
from collections.abc import Collection, Iterator, Sequence
from itertools import islice

MOST_SHOWN, ITEMS_SHOWN = 80, 4  # characters of a text, items of a container
MOST_SAID = 1000  # characters of what is wrong: it may quote a file
BITS_SHOWN = 256  # of an integer; Python writes out some 14,000


def rate_text(per_s: float, what: str = "") -> str:
    """In the largest of 1/s, 1/min and 1/h that leaves at least one of them: 0.02 clips a second are 1.20 clips/min."""
    for unit, seconds in (("s", 1.0), ("min", 60.0), ("h", 3600.0)):
        if per_s * seconds >= 1.0:
            return f"{per_s * seconds:.2f}{what}/{unit}"
    return f"{per_s * 3600.0:.2f}{what}/h" if per_s > 0 else f"0{what}/s"


def time_text(seconds: float) -> str:
    """Seconds up to two minutes, then minutes, from two hours on both hours and minutes."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def time_left_text(ends_ms: float | None, now_ms: float) -> str:
    """Of what will end then, both since 1970; None: nobody knows yet."""
    return "?" if ends_ms is None else time_text(max(0.0, ends_ms - now_ms) / 1000.0)


def one_line(error: BaseException) -> str:
    """What an error says, without a client's colours and line breaks."""
    try:
        said = str(error)
    except ValueError:  # of an integer that Python does not write out, such as a missing key
        said = ", ".join(map(shown, error.args))
    plain = re.sub(r"\x1b\[[0-9;]*m", "", said).replace("\u21b3", ":")
    return printable(" ".join(plain.split())[:300]) or type(error).__name__


def printable(text: str) -> str:
    """On one line and without what a terminal would obey: what a file says may be quoted in it."""
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in text)


def shown(value: object, inside: int = 2) -> str:
    """A value out of a file as its `repr`, in bounded time and length whatever it is: what is long is cut.

    `repr` itself may take for ever: of tuples that share others, of integers that Python does not write out.
    inside: containers in each other of which the items are shown.
    """
    if isinstance(value, str | bytes | bytearray):
        text = repr(value[:MOST_SHOWN])
        return text if len(value) <= MOST_SHOWN else f"{text}... ({len(value):,} long)"
    if isinstance(value, int) and value.bit_length() > BITS_SHOWN:
        return f"an integer of {value.bit_length():,} bits"
    if value is None or isinstance(value, int | float | complex):
        return repr(value)
    if isinstance(value, dict):
        pairs = [f"{shown(key, inside - 1)}: {shown(value[key], inside - 1)}" for key in _first(value, inside)]
        return f"{{{', '.join(pairs)}{_rest(value, inside)}}}"
    if isinstance(value, list | tuple | set | frozenset):
        opens, closes = (
            ("[", "]") if isinstance(value, list) else ("(", ")") if isinstance(value, tuple) else ("{", "}")
        )
        items = ", ".join(shown(item, inside - 1) for item in _first(value, inside))
        return f"{opens}{items}{_rest(value, inside)}{closes}"
    if (shape := getattr(value, "shape", None)) == () and hasattr(value, "item"):
        return shown(value.item(), 0)
    return f"a {type(value).__name__}" + (f" of shape {shape}" if isinstance(shape, tuple) else "")


def _first(value: Collection[object], inside: int) -> Iterator[object]:
    return islice(value, ITEMS_SHOWN if inside > 0 else 0)


def _rest(value: Collection[object], inside: int) -> str:
    shown_items = min(len(value), ITEMS_SHOWN if inside > 0 else 0)
    return "" if shown_items == len(value) else f"{', ' if shown_items else ''}..."


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
