"""What a run would take, by the acceptance that the tables of a run show."""

import re
from pathlib import Path

import pytest

from factory.setup.calibrate import extrapolated_from_tables
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    found = Store(tmp_path_factory.mktemp("out"))
    executed(ToyWork(), refs(6), ["recovery", "human"], 2, found)
    return found


def told(store: Store, rounds: int, n_clips: int) -> dict[str, tuple[int, int]]:
    """Expert -> attempts, samples."""
    lines = extrapolated_from_tables(store, ["recovery", "human", "nobody"], rounds, n_clips)[1:]
    found = [re.fullmatch(r"  (\w+): .*; (\d+) attempts, (\d+) samples", line) for line in lines]
    return {match[1]: (int(match[2]), int(match[3])) for match in found if match is not None}


def test_the_same_clips_and_rounds_come_to_what_the_tables_hold(store: Store) -> None:
    samples = [row["expert"] for row in store.samples.read(["expert"]).to_pylist()]
    fell = [o["expert"] for o in store.outcomes.read().to_pylist() if o["kind"] == "rejected"]
    held = {e: (samples.count(e) + fell.count(e), samples.count(e)) for e in ("recovery", "human")}
    assert told(store, 2, 6) == held
    assert told(store, 2, 600) == {expert: (100 * a, 100 * s) for expert, (a, s) in held.items()}


def test_rounds_beyond_go_on_at_the_last_rate_and_the_log_has_one(store: Store) -> None:
    assert told(store, 5, 6)["human"] == told(store, 1, 6)["human"] == (6, 6)
    assert told(store, 3, 600)["recovery"][1] > told(store, 2, 600)["recovery"][1]


def test_tables_without_attempts_say_nothing(tmp_path: Path) -> None:
    assert extrapolated_from_tables(Store(tmp_path), ["recovery"], 2, 10) == []
