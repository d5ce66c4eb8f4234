"""Listings of an object store that are behind what was written, or break off.

Amazon's list a key as soon as it is there, others may be seconds late; who asks for a key by its name gets it at once.
delta-rs's client asks again where a file breaks off, but not where a listing does, or the words by which a store says
that there is no such file; Arrow's does for all of them.
"""

import re
import time
from collections.abc import Callable
from typing import TypeVar

from deltalake.exceptions import DeltaError

T = TypeVar("T")
PAUSES_S = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # a minute in all
BROKE_OFF = re.compile(  # in what delta-rs says; where it asked again by itself the time is followed by how often
    r"Error getting list response body|Error performing GET \S+ in \S+ - .*error reading a body", re.DOTALL
)
BROKEN_PAUSES_S = (0.1, 0.2, 0.5, 1.0, 2.0)  # each before asking once more


class ListingBehind(TimeoutError):
    """What was written is still not listed."""


def until_listed(is_seen: Callable[[], bool], name: str) -> None:
    """Look until it is seen. Raises ListingBehind after a minute."""
    for pause_s in PAUSES_S:
        time.sleep(pause_s)
        if is_seen():
            return
    raise ListingBehind(f"{name} is there, and its store does not list it after {sum(PAUSES_S):.0f} s")


def broke_off(error: BaseException) -> bool:
    """What delta-rs raised is of an answer that ended before its end, and was not asked for again."""
    return isinstance(error, DeltaError | OSError) and BROKE_OFF.search(str(error)) is not None


def listed(ask: Callable[[], T]) -> T:
    """What delta-rs, which lists meanwhile, answers; asked again, five times at most, where an answer broke off."""
    for pause_s in BROKEN_PAUSES_S:
        try:
            return ask()
        except (DeltaError, OSError) as error:
            if not broke_off(error):
                raise
        time.sleep(pause_s)
    return ask()
