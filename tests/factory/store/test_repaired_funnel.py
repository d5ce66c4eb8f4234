"""What was repaired is counted over the clips of a store, in one line that stands only where there is something."""

import math
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factory.store.funnel import Repaired, funnel_of
from factory.store.samples import MOST_RECORDS, ClipCandidates, Store
from factory.views.card import card
from factory.views.status import status_lines
from tasks.world.repair.records import LEFT_OUT, Repair, RepairCount, first_repairs, repair_counts

RECORD = {"dataset": "d", "content_digest": "c", "prepare_digest": "p", "vocabulary_digest": "v"}
OF_CLIPS = st.lists(
    st.lists(
        st.builds(
            Repair,
            what=st.sampled_from(["gap", "twice"]),
            thing=st.sampled_from("abc"),
            time_s=st.sampled_from([math.nan, 1.5]),
            was=st.just("NaN"),
            now=st.sampled_from(["1 m", LEFT_OUT]),
        ),
        max_size=6,
    ),
    max_size=5,
)


def clip_with(clip_id: str, repairs: list[Repair]) -> ClipCandidates:
    records = first_repairs(repairs, MOST_RECORDS)
    made = {**RECORD, "clip_id": clip_id, "log_id": f"log of {clip_id}", "gate_counts": {}, "candidates": ()}
    return ClipCandidates(**made, repairs=repair_counts(repairs), repair_records=records)  # type: ignore[arg-type]


@settings(max_examples=8, deadline=None)  # each writes tables
@given(OF_CLIPS)
def test_the_funnel_has_the_sums_over_clips(
    tmp_path_factory: pytest.TempPathFactory, of_clips: list[list[Repair]]
) -> None:
    store = Store(tmp_path_factory.mktemp("store"))
    for number, repairs in enumerate(of_clips):  # a file each
        store.commit([clip_with(f"c{number}", repairs)], [], [])
    slow: Counter[tuple[str, bool]] = Counter()
    for repairs in of_clips:
        slow.update({(r.what, r.thing, r.now): (r.what, r.now == LEFT_OUT) for r in repairs}.values())
    found = funnel_of(store).repaired
    assert found.clips == sum(map(bool, of_clips))
    assert {count.what: (count.repaired, count.left_out) for count in found.counts} == {
        what: (slow[what, False], slow[what, True]) for what in sorted({what for what, _ in slow})
    }
    if of_clips:
        alone = funnel_of(store, ["c0"]).repaired
        assert alone == Repaired(bool(of_clips[0]), repair_counts(of_clips[0]))


def test_the_line_counts_objects_clips_and_what_was_left_out() -> None:
    some = Repaired(7, (RepairCount("gap", 9, 0), RepairCount("heading", 3, 0), RepairCount("twice", 0, 3)))
    assert some.text == (
        "12 objects in 7 clips repaired, 3 left out: gaps filled 9, headings turned by pi 3, listed twice 3 (left out)"
    )
    assert Repaired(1, (RepairCount("gap", 1, 0),)).text == "1 object in 1 clip repaired, 0 left out: gaps filled 1"
    assert Repaired(0, ()).text == ""


def test_status_and_card_have_the_line_only_where_something_was_repaired(tmp_path: Path) -> None:
    gap = Repair("gap", "a", 1.5, "no box", "a box")
    for name, repairs in (("whole", []), ("repaired", [gap])):
        store = Store(tmp_path / name)
        store.commit([clip_with("c0", repairs)], [], [])
        line, told = "1 object in 1 clip repaired, 0 left out: gaps filled 1", bool(repairs)
        assert (line in "\n".join(status_lines(store)).splitlines()) == told
        assert (f"In their logs: {line}.\n" in card(store)) == told
        assert ("repaired" in card(store)) == told


def test_a_clip_s_row_has_its_repairs_one_by_one_up_to_a_bound(tmp_path: Path) -> None:
    many = [Repair("gap", f"track {i}", i / 10, "no box", "a box") for i in range(MOST_RECORDS + 50)]
    lane = Repair("lane", "l1", math.nan, "no boundary", LEFT_OUT)
    store = Store(tmp_path)
    store.commit([clip_with("c0", [*many, lane])], [], [])
    (row,) = store.candidates.read(["repairs", "repair_records"]).to_pylist()
    assert row["repairs"] == [
        {"what": "gap", "repaired": MOST_RECORDS + 50, "left_out": 0},
        {"what": "lane", "repaired": 0, "left_out": 1},
    ]
    assert len(row["repair_records"]) == MOST_RECORDS
    assert row["repair_records"][0] == vars(many[0])
    assert row["repair_records"][-1]["thing"] == "l1" and math.isnan(row["repair_records"][-1]["time_s"])
