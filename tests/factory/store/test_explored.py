"""The table of drifts: what a run reads of it, and what of it a run refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.config.run import load_config
from factory.readers.base import BadClip
from factory.setup.settings import identity_of
from factory.store.explored.drifts import Explored, explored_in
from factory.store.explored.table import DriftRow, ExploredClip, open_explored, write_explored
from factory.store.location import Location
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary
from tests.tasks.streets import street_clip

STATES = np.arange(41.0 * 11.0).reshape(41, 11) / 7.0
CLIP = replace(street_clip(), content_digest="as it was")


def drift(number: int, fails: str = "") -> DriftRow:
    states = tuple(map(tuple, (STATES + number).tolist()))
    return DriftRow(number, "closed loop from 0.0 s", 1.0, 0.1, 0.0, 8.0, 0.5, fails, {"nc": 1.0}, states)


def row(clip_id: str = CLIP.clip_id, **changed: object) -> ExploredClip:
    found = ExploredClip(
        *(clip_id, "town", "log", "as it was", "free", ("slow",), "someone", "0a1b", "{}", 0.25, "dac", {"lateral": 1}),
        drifts=(drift(0), drift(2, "nc")),
    )
    return replace(found, **changed)  # type: ignore[arg-type]


def written(folder: Path, *rows: ExploredClip) -> Location:
    location = Location.parse(folder)
    table = open_explored(location)
    for one in rows:
        write_explored(table, [one])
    return location


def test_a_clip_s_drifts_come_back_to_the_last_bit(tmp_path: Path) -> None:
    explored = explored_in(written(tmp_path, row("another"), row()))
    assert (explored.planner, explored.planner_digest) == ("someone", "0a1b")
    assert (explored.n_drifts, explored.n_failing) == (4, 2)
    first, second = explored.of(CLIP)
    assert (first.number, first.score, first.fails, second.number, second.fails) == (0, 0.5, "", 2, "nc")
    np.testing.assert_array_equal(second.ego_states, STATES + 2)
    assert explored.of(replace(CLIP, clip_id="not explored")) == ()


def test_what_was_explored_is_what_was_found_and_not_when_or_where(tmp_path: Path) -> None:
    one = explored_in(written(tmp_path / "a", row(), row("another")))
    other = explored_in(written(tmp_path / "b", row("another"), row()))
    assert one.digest == other.digest
    moved = explored_in(written(tmp_path / "c", row("another"), row(drifts=(drift(0),))))
    assert moved.digest != one.digest


def test_a_clip_that_was_changed_since_is_refused_by_its_name(tmp_path: Path) -> None:
    explored = explored_in(written(tmp_path, row()))
    with pytest.raises(BadClip, match=f"log {CLIP.log_id}: clip: content digest changed, explored as as it was"):
        explored.of(replace(CLIP, content_digest="changed"))


def test_a_row_that_was_replaced_since_the_run_began_is_refused(tmp_path: Path) -> None:
    explored = explored_in(written(tmp_path, row()))
    with pytest.raises(OSError, match="explored anew since this run began"):
        replace(explored, digests={CLIP.clip_id: "0" * 16}).of(CLIP)


def test_a_table_of_two_planners_or_of_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no drifts in"):
        explored_in(Location.parse(tmp_path / "nothing"))
    both = written(tmp_path / "both", row(), row("another", planner_digest="2c3d"))
    with pytest.raises(ValueError, match="drifts of 2 planners or settings"):
        explored_in(both)


def test_with_drifts_clips_are_prepared_anew_and_attempts_have_other_names(tmp_path: Path) -> None:
    """And without, all is as it was."""
    config, vocabulary = load_config([]), Vocabulary(kinematic_trajectories(20, seed=0))
    explored = explored_in(written(tmp_path / "a", row()))
    more = explored_in(written(tmp_path / "b", row(), row("another")))

    def named(one: Explored | None) -> tuple[str, str, str]:
        made = identity_of(config, vocabulary, None, one)
        return made.prepare_digest, made.vocabulary_digest, made.settings_hash

    assert named(None)[1] == vocabulary.digest
    assert not [key for key in identity_of(config, vocabulary, None).settings if key.startswith("explore")]
    for a, b in ((None, explored), (explored, more)):
        assert all(x != y for x, y in zip(named(a), named(b), strict=True))
    assert identity_of(config, vocabulary, None, explored).settings["explore.planner"] == "someone 0a1b"
