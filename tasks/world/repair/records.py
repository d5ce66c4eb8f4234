"""What was put right or left out in a log: a record each, which clips, tables and pages carry on."""

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

LEFT_OUT: Final = "left out"


@dataclass(frozen=True, order=True)
class Repair:
    """One thing of a log that is not as its file has it."""

    what: str  # name of the pass, as `gap`, `twice`, `crossing`
    thing: str  # track id, lane id, crossing id; "" of the log as a whole
    time_s: float  # since the log's first annotated instant; NaN: of the whole log
    was: str  # as the file has it, with its unit
    now: str  # as clips have it, or LEFT_OUT
    until_s: float = -math.inf  # where it lasts longer than an instant


def repairs_within(repairs: Iterable[Repair], first_s: float, last_s: float) -> tuple[Repair, ...]:
    """Those that show from first_s to last_s, both included, and those of the whole log."""
    return tuple(
        repair
        for repair in repairs
        if math.isnan(repair.time_s) or (repair.time_s <= last_s and max(repair.time_s, repair.until_s) >= first_s)
    )


def later(repair: Repair, seconds: float) -> Repair:
    """The same, on a clock that begins so much earlier."""
    return replace(repair, time_s=repair.time_s + seconds, until_s=repair.until_s + seconds)


def repair_counts(repairs: Iterable[Repair]) -> dict[str, tuple[int, int]]:
    """Pass -> how many different things it put right, and how many it left out; by name."""
    found = {(repair.what, repair.thing, repair.now == LEFT_OUT) for repair in repairs}
    counts = Counter((what, left_out) for what, _, left_out in found)
    return {what: (counts[what, False], counts[what, True]) for what in sorted({what for what, _ in counts})}
