"""Drives that end badly, from the run's settings to the funnel: refused under a reason of their own, if that is on."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from factory.config.run import load_config
from factory.graph.steps import HUMAN_CANDIDATE, PreparedClip, SampleColumns, run_attempt
from factory.pipeline import FactoryWork
from factory.setup.settings import assemble
from factory.store.funnel import Funnel, funnel_of
from factory.store.samples import Store
from factory.views.card import card
from tasks.experts.protocol import Expert
from tests.factory.toy import executed
from tests.tasks.bad_ends import Aside, Close

UNSCORED = ["reward.full=[]", "reward.progress_above=-1", "reward.labels=none", "traffic=replay", "render=none"]
STREET = ["clips=custom", "clips._target_=tests.factory.street_reader.StreetReader", "vocabulary.k=150"]


def work_of(experts: Mapping[str, Expert], out: Path, *words: str) -> FactoryWork:
    """A run whose sub-scores refuse nothing."""
    work = assemble(load_config([*UNSCORED, "experts=[human]", f"out={out}", *words])).work
    simulated = assemble(load_config([*UNSCORED, "experts=[pdm_closed]", f"out={out}", *words])).work
    return replace(simulated, experts={**experts, **work.experts})


def ran(work: FactoryWork, out: Path) -> tuple[Store, Funnel]:
    store = Store(out)
    executed(work, work.reader.index().refs[:1], [*work.experts], 2, store)
    return store, funnel_of(store)


def rows_of(funnel: Funnel, expert: str) -> tuple[int, dict[str, int]]:
    """Accepted attempts, and the others by reason."""
    reasons: dict[str, int] = {}
    own = [row for row in funnel.rows if row.expert == expert]
    for row in own:
        reasons |= {name: reasons.get(name, 0) + n for name, n in row.reasons.items()}
    return sum(row.accepted for row in own), reasons


@pytest.mark.slow
def test_drives_that_end_beside_the_town_s_route_are_counted_as_such(small_town: Path, tmp_path: Path) -> None:
    town = ["clips=av2", f"clips.root={small_town}", "vocabulary.k=300"]
    work = work_of({"aside": Aside(9.0)}, tmp_path / "on", *town)
    store, funnel = ran(work, tmp_path / "on")
    accepted, reasons = rows_of(funnel, "aside")
    assert accepted == 0 and set(reasons) == {"reward.off_route"} and reasons["reward.off_route"] > 3
    assert f"off_route {reasons['reward.off_route']}" in funnel.text()
    details = store.outcomes.read(["reason", "detail"]).to_pylist()
    assert {row["detail"] for row in details if row["reason"]} == {"ends on no lane of the route"}
    assert rows_of(funnel, "human") == (1, {})
    lenient = work_of({"aside": Aside(9.0)}, tmp_path / "off", *town, "reward.off_route=false", "reward.after=false")
    assert rows_of(ran(lenient, tmp_path / "off")[1], "aside") == (2, {})


@pytest.mark.slow
def test_drives_that_end_a_moment_before_a_collision_are_counted_as_such(tmp_path: Path) -> None:
    for name, words in (("on", []), ("off", ["reward.after=false"])):
        work = work_of({"close": Close(), "aside": Aside(2.0)}, tmp_path / name, *STREET, *words)
        store, funnel = ran(work, tmp_path / name)
        accepted, reasons = rows_of(funnel, "close")
        if name == "on":
            assert accepted == 0 and set(reasons) == {"reward.after"}
        else:
            assert (accepted, reasons) == (2, {})
        assert ("a second after it without a collision" in card(store)) == (name == "on")
        assert "lead on along the route" in card(store)


def test_the_log_s_own_drive_is_never_refused_for_its_end(tmp_path: Path) -> None:
    """Here the street's junction is off the route, and the human drives through it."""
    work = work_of({}, tmp_path, *STREET)
    prepared = work.prepare(work.reader.index().refs[0])
    assert isinstance(prepared, PreparedClip)
    clip = prepared.payload.clip  # type: ignore[attr-defined]
    route = replace(clip.route, lane_ids=frozenset({"in"}), roadblock_ids=("rb_in", "rb_elsewhere"))
    elsewhere = replace(prepared, payload=replace(prepared.payload, clip=replace(clip, route=route)))  # type: ignore[type-var]
    assert isinstance(run_attempt(work, elsewhere, HUMAN_CANDIDATE, "human"), SampleColumns)
