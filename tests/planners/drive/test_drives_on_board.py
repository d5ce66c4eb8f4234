"""Drives in the dashboard and the report of a run whose folder they are written to."""

import json
from pathlib import Path

import pytest

from factory.exits import COMPLETE
from factory.store.location import Location
from factory.store.samples import Store
from factory.views.board.overview import SCHEMA, Drives, drives_as_json
from factory.views.board.server import Board
from planners.drive import work
from planners.drive.drive import main
from tests.planners.drive.test_drive import towns as towns  # the fixture
from tests.planners.drive.test_drive import words


def test_the_board_reads_columns_that_the_table_has() -> None:
    for field in SCHEMA:
        assert work.SCHEMA.field(field.name).type == field.type


@pytest.mark.slow
def test_the_board_shows_drives_as_they_are_committed_and_their_films(towns: Path, tmp_path: Path) -> None:
    board = Board(Store(Location.parse(tmp_path)))
    assert json.loads(board.answer("/api/drives").body) == {"total": 0, "lines": [], "drives": []}
    assert main(words(towns, tmp_path, "limit=1", "films=all", "seconds=1")) == COMPLETE
    answer = json.loads(board.answer("/api/drives").body)
    (line,), (one,) = answer["lines"], answer["drives"]
    assert (answer["total"], line["planner"], line["start"], line["drives"]) == (1, "constant_velocity", "logged", 1)
    assert one["failure_reason"] == "" and one["film"] == f"films/{one['drive_id']}.mp4"
    film = board.answer(f"/film/{one['drive_id']}.mp4")
    assert (film.status, film.kind) == (200, "video/mp4") and len(film.body) > 1000
    assert board.answer("/film/0123.mp4").status == 404
    assert board.answer("/film/..%2Frun.json").status == 404
    assert main(words(towns, tmp_path, "seconds=1")) == COMPLETE
    assert json.loads(board.answer("/api/drives").body)["total"] == 2


def test_those_that_failed_come_first_and_a_file_of_its_own_names_no_films(tmp_path: Path) -> None:
    facts = dict.fromkeys(SCHEMA.names, "") | dict.fromkeys(SCHEMA.names[7:], 0.0) | {"dist_traveled_m": 100.0}
    rows = [
        facts | {"drive_id": name, "start": start, "score": score, "offroad_or_collision_at_fault": float(score == 0)}
        | {"planner": "a", "pictures": "none"}
        for name, start, score in (("a", -1, 0.9), ("b", 0, 0.0), ("c", 1, 0.7))
    ]  # fmt: skip
    found = drives_as_json(rows, with_films=False)
    assert [row["drive_id"] for row in found["drives"]] == ["b", "c", "a"]
    assert "film" not in found["drives"][0]
    logged, perturbed = found["lines"]
    assert (logged["m_between_incidents"], perturbed["m_between_incidents"]) == (None, pytest.approx(200.0))
    assert Drives(Location.parse(tmp_path)).rows() == []
