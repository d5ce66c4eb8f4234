"""Waiting for an object store whose listings are behind what was written.

Amazon's list a key as soon as it is there, others may be seconds late; who asks for a key by its name gets it at once.
"""

import time
from collections.abc import Callable

PAUSES_S = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # a minute in all


class ListingBehind(TimeoutError):
    """What was written is still not listed."""


def until_listed(is_seen: Callable[[], bool], name: str) -> None:
    """Look until it is seen. Raises ListingBehind after a minute."""
    for pause_s in PAUSES_S:
        time.sleep(pause_s)
        if is_seen():
            return
    raise ListingBehind(f"{name} is there, and its store does not list it after {sum(PAUSES_S):.0f} s")
