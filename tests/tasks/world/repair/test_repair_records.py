"""What was repaired, counted and in words: of each pass, of different things, and none hidden by another."""

import math
from collections import defaultdict
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from tasks.world.repair.records import (
    LEFT_OUT,
    WORDS,
    Repair,
    RepairCount,
    counts_text,
    first_repairs,
    repair_counts,
    repair_lines,
    repair_text,
    repairs_within,
)

REPAIR = st.builds(
    Repair,
    what=st.sampled_from(["gap", "twice", "own"]),
    thing=st.sampled_from(["", "a", "b", "c"]),
    time_s=st.sampled_from([math.nan, 0.0, 0.1, 7.5]),
    was=st.sampled_from(["no box", "NaN"]),
    now=st.sampled_from(["a box", LEFT_OUT]),
)
REPAIRS = st.lists(REPAIR, max_size=40)


@given(REPAIRS)
def test_counts_are_those_of_sets_of_things(repairs: list[Repair]) -> None:
    things: dict[tuple[str, bool], set[str]] = defaultdict(set)
    for repair in repairs:
        things[repair.what, repair.now == LEFT_OUT].add(repair.thing)
    slow = {what: (len(things[what, False]), len(things[what, True])) for what in sorted({r.what for r in repairs})}
    assert {count.what: (count.repaired, count.left_out) for count in repair_counts(repairs)} == slow
    assert [count.what for count in repair_counts(repairs)] == list(slow)


@given(REPAIRS, st.integers(0, 12))
def test_of_many_repairs_those_that_are_kept_are_of_every_pass(repairs: list[Repair], most: int) -> None:
    kept = first_repairs(repairs, most)
    assert len(kept) == min(most, len(repairs))
    of_pass = {what: sum(r.what == what for r in repairs) for what in {r.what for r in repairs}}
    shown = {what: sum(r.what == what for r in kept) for what in of_pass}
    cut = [shown[what] for what in of_pass if shown[what] < of_pass[what]]
    assert all(n <= least + 1 for n in shown.values() for least in cut), "a pass was cut before one that has more"
    assert first_repairs(kept, most) == kept
    assert first_repairs(repairs[::-1], most) == kept


@given(REPAIRS, st.integers(0, 12))
def test_every_line_is_a_pass_a_repair_or_how_many_more_there_are(repairs: list[Repair], most: int) -> None:
    lines = list(repair_lines(repairs, most))
    more = [lines.pop()] if len(repairs) > most else []
    assert more == [f"and {len(repairs) - most} more"] * len(more)
    kept = first_repairs(repairs, most)
    assert [line.strip() for line in lines if line.startswith("  ")] == [repair_text(repair) for repair in kept]
    names = [line for line in lines if not line.startswith("  ")]
    assert names == [f"{WORDS.get(what, what)}:" for what in sorted({repair.what for repair in kept})]


def test_one_repair_says_what_where_when_and_from_what_to_what() -> None:
    short = Repair("impossible", "12", 3.44, "length -1.30 m", LEFT_OUT)
    assert repair_text(short) == "12 at 3.4 s: length -1.30 m -> left out"
    lasting = replace(short, until_s=9.0)
    assert repair_text(lasting) == "12 from 3.4 to 9.0 s: length -1.30 m -> left out"
    clock = Repair("gap", "", math.nan, "9.9 Hz", "10 Hz")
    assert repair_text(clock) == "the log: 9.9 Hz -> 10 Hz"


def test_counts_in_words_are_largest_first_and_what_was_left_out_comes_last() -> None:
    counts = [RepairCount("gap", 2, 0), RepairCount("impossible", 0, 1200), RepairCount("own", 3, 1)]
    assert counts_text(iter(counts)) == "own 3, gaps filled 2, impossible values 1,200 (left out), own 1 (left out)"
    assert counts_text([]) == ""


def test_a_window_has_the_repairs_of_its_time_and_those_of_the_whole_log() -> None:
    times = (math.nan, 0.9, 1.0, 2.0, 2.1)
    repairs = [Repair("gap", str(time), time, "", "") for time in times]
    assert [repair.thing for repair in repairs_within(repairs, 1.0, 2.0)] == ["nan", "1.0", "2.0"]
    lasting = [Repair("jump", "", 0.0, "", "", until_s) for until_s in (0.9, 1.0, 9.0)]
    assert repairs_within(lasting, 1.0, 2.0) == tuple(lasting[1:])
