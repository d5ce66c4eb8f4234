"""What was put right or left out in a log: a record each, which clips, tables and pages carry on."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

LEFT_OUT: Final = "left out"
WORDS: Final = {  # pass -> what it is called for people; a pass that is not here goes by its own name
    "gap": "gaps filled",
    "clock": "clocks followed",
    "impossible": "impossible values",
    "twice": "listed twice",
    "ego": "the ego listed among agents",
    "articulated": "trailers towed",
    "token": "no identity",
    "class": "unknown classes",
    "jump": "identities that jumped",
    "heading": "headings turned by pi",
    "crossing": "outlines of crossings",
    "boundary": "boundaries of lanes",
    "light": "traffic lights",
    "lane": "lanes",
    "area": "drivable areas",
}


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


@dataclass(frozen=True)
class RepairCount:
    """What one pass did to one clip or to several; of several clips a thing counts in each."""

    what: str  # name of the pass
    repaired: int  # different things
    left_out: int


def repair_counts(repairs: Iterable[Repair]) -> tuple[RepairCount, ...]:
    """Of each pass, by name: how many different things it put right, and how many it left out."""
    found = {(repair.what, repair.thing, repair.now == LEFT_OUT) for repair in repairs}
    counts = Counter((what, left_out) for what, _, left_out in found)
    return tuple(RepairCount(what, counts[what, False], counts[what, True]) for what in sorted({w for w, _ in counts}))


def first_repairs(repairs: Iterable[Repair], most: int) -> tuple[Repair, ...]:
    """By pass, thing and time; of more than `most` the first of each pass in turn, so that none hides another."""
    ordered = sorted(repairs, key=_place)
    turns = [turn for _, group in groupby(ordered, key=lambda repair: repair.what) for turn, _ in enumerate(group)]
    chosen = sorted(range(len(ordered)), key=turns.__getitem__)[:most]
    return tuple(ordered[i] for i in sorted(chosen))


def _place(repair: Repair) -> tuple[str, str, float, float, str, str]:
    time_s = -math.inf if math.isnan(repair.time_s) else repair.time_s
    return repair.what, repair.thing, time_s, repair.until_s, repair.was, repair.now


# The same in words.


def counts_text(counts: Iterable[RepairCount]) -> str:
    """`gaps filled 2, listed twice 1 (left out)`, largest first; empty where there is none."""
    told = sorted(
        (ending, -n, count.what)
        for count in counts
        for n, ending in ((count.repaired, ""), (count.left_out, f" ({LEFT_OUT})"))
        if n
    )
    return ", ".join(f"{WORDS.get(what, what)} {-n:,}{ending}" for ending, n, what in told)


def repair_text(repair: Repair) -> str:
    """`track 12 at 3.4 s: length -1.30 m -> left out`; of the log as a whole, or for all of its time, without."""
    at = "" if math.isnan(repair.time_s) else f" at {repair.time_s:.1f} s"
    if repair.until_s > repair.time_s:
        at = f" from {repair.time_s:.1f} to {repair.until_s:.1f} s"
    return f"{repair.thing or 'the log'}{at}: {repair.was} -> {repair.now}"


def repair_lines(repairs: Sequence[Repair], most: int) -> Iterator[str]:
    """The name of each pass and below it its records; `most` of all, the others counted."""
    for what, group in groupby(first_repairs(repairs, most), key=lambda repair: repair.what):
        yield f"{WORDS.get(what, what)}:"
        yield from (f"  {repair_text(repair)}" for repair in group)
    if len(repairs) > most:
        yield f"and {len(repairs) - most:,} more"
