"""Shares, rates and their intervals, of drives made up."""

from typing import Any

import numpy as np
import pytest

from planners.drive.summary import picture_source_effects, summarise_drives, summary_text

FLAGS = ("collision_at_fault", "offroad", "left_corridor_laterally", "offroad_or_collision_at_fault")


def row(clip: int, *, planner: str = "a", pictures: str = "none", start: int = -1, **more: Any) -> dict[str, Any]:
    """A kilometre without an incident, of a clip that is a town of its own."""
    facts = {"planner": planner, "pictures": pictures, "start": start, "clip_id": f"{clip}"}
    facts |= {"log_id": f"town-{clip}-0000-straight", "dist_traveled_m": 1000.0} | dict.fromkeys(FLAGS, 0.0)
    return facts | {"score": 1.0, "progress_rel_to_total": 1.0} | more


def test_metres_between_incidents_are_all_metres_over_all_incidents() -> None:
    """3 km with an incident in one of three clips: a bootstrap draws 0 to 3 times that clip of three."""
    (line,) = summarise_drives([row(0, offroad_or_collision_at_fault=1.0, collision_at_fault=1.0), row(1), row(2)])
    mean, low, high = line.m_between_incidents
    assert (line.km, line.incidents, mean) == (3.0, 1, pytest.approx(3000.0))
    assert (low, high) == (pytest.approx(1000.0), np.inf)
    assert line.shares["collision_at_fault"].b == pytest.approx(1 / 3)


def test_without_an_incident_there_is_no_bound() -> None:
    (line,) = summarise_drives([row(0), row(1)])
    assert line.m_between_incidents == (np.inf, np.inf, np.inf)


def test_a_longer_drive_counts_by_its_metres() -> None:
    """One incident in 1 km of one clip and none in 9 km of the other: 10 km each."""
    (line,) = summarise_drives([row(0, offroad_or_collision_at_fault=1.0), row(1, dist_traveled_m=9000.0)])
    assert line.m_between_incidents[0] == pytest.approx(10_000.0)


def test_whole_towns_are_drawn_and_from_one_nothing_can_be() -> None:
    spread, alone = (
        [row(clip, log_id=f"town-{town}-0000-x") for clip, town in enumerate(towns)] for towns in ((0, 1), (0, 0))
    )
    assert summarise_drives(spread)[0].level == "town"
    (line,) = summarise_drives(alone)
    assert line.level == "clip"


def test_planners_pictures_and_kinds_of_starts_are_told_apart() -> None:
    rows = [row(0), row(0, start=0), row(0, start=1), row(0, planner="b", pictures="truth")]
    assert [(line.planner, line.pictures, line.start, line.drives) for line in summarise_drives(rows)] == [
        ("a", "none", "logged", 1),
        ("a", "none", "perturbed", 2),
        ("b", "truth", "logged", 1),
    ]


def test_what_the_engine_changes_is_over_the_starts_that_both_were_driven_from() -> None:
    """Three starts with the painter's pictures, of which two were driven with the engine's as well."""
    truth = [row(i, pictures="truth", score=0.5) for i in range(3)]
    engine = [row(i, pictures="engine", score=0.5 - 0.1 * i) for i in range(2)]
    (one,) = picture_source_effects([*truth, *engine])
    assert one.drives == 2
    assert one.shares["score"].difference == pytest.approx(-0.05)
    assert one.shares["score"].low == pytest.approx(-0.1)
    assert one.shares["collision_at_fault"].difference == 0.0
    assert picture_source_effects(truth) == []


def test_of_one_drive_there_is_no_interval_and_the_text_has_a_dash() -> None:
    told = summary_text(summarise_drives([row(0)]), [], 0.95)
    assert "[-, -]" in told and "nan" not in told


def test_the_text_names_every_planner_and_what_its_brackets_are() -> None:
    rows = [row(0, pictures="truth"), row(1, pictures="truth"), row(0, pictures="engine"), row(1, pictures="engine")]
    told = summary_text(summarise_drives(rows), picture_source_effects(rows), 0.95)
    assert "engine - truth" in told
    assert told.endswith("[95 % intervals over towns; -: from one alone nothing can be drawn]")
