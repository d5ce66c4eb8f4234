"""The sentence that says whether a planner got better: of scores and of drives, by closed forms."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from factory.store.location import Location, write_shard
from planners.ab.compare import main
from planners.drive.work import DRIVES, SCHEMA, open_drives
from planners.evaluation.bootstrap import Interval
from planners.evaluation.compare import difference_sentence
from planners.evaluation.score_rows import write_record, write_rows
from tests.planners.made_rows import clip_rows

TOWNS = 4


def test_a_sentence_says_what_an_interval_says() -> None:
    def said(low: float, high: float) -> str:
        return difference_sentence("EPDMS", Interval(0.045, low, high, 0.265, 0.31, n=8), "town", 0.95)

    numbers = "EPDMS 31.0 against 26.5, +4.5"
    assert said(-0.023, 0.113) == f"{numbers} (95 % over 8 towns: -2.3 to +11.3), no difference told from zero"
    assert said(0.01, 0.08) == f"{numbers} (95 % over 8 towns: +1.0 to +8.0), better"
    assert said(np.nan, np.nan) == f"{numbers} (no interval)"
    few = Interval(0.045, -0.02, 0.12, 0.265, 0.31, 6, (-0.02, 0.11), (-0.01, 0.12), 0.1875)
    assert difference_sentence("EPDMS", few, "town", 0.95) == (
        f"{numbers} (95 % over 6 towns: -2.0 to +12.0; t -2.0 to +11.0, wild bootstrap -1.0 to +12.0; p 0.19), "
        "no difference told from zero"
    )
    worse = difference_sentence("routes", Interval(-0.1, -0.2, -0.05, 0.5, 0.4, n=3), "log", 0.9, " %")
    assert worse == "routes 40.0 % against 50.0 %, -10.0 (90 % over 3 logs: -20.0 to -5.0), worse"


def evaluated(folder: Path, score: float) -> str:
    """A planner of this score in both stages, in a clip of each of the towns."""
    folder.mkdir()
    follow_ups = [((score, score), (0.0, 0.0), (0.0, 0.0))]
    ends = ((0.0, 0.0), (0.0, 0.0))
    rows = [clip_rows(f"c{i}", score, (1.0, 1.0), ends, follow_ups, f"town-{i}-0000-curve") for i in range(TOWNS)]
    write_rows(folder, [row for clip in rows for row in clip])
    write_record(folder, {"planner": folder.name, "planner_digest": folder.name, "benchmark_digest": "", "rules": {}})
    return str(folder)


def driven(out: Path, *rows: dict[str, Any]) -> None:
    """A table of drives; of what is not told of one, zeros."""
    blank = {field.name: {pa.string(): "", pa.bool_(): False}.get(field.type, 0) for field in SCHEMA}
    blank |= {"settings": "{}", "ego_states": [], "plans": []}
    named = [blank | {"drive_id": f"{i}"} | row for i, row in enumerate(rows)]
    table = open_drives(Location.parse(out))
    table.claim()
    table.commit([write_shard(table.location, DRIVES, pa.Table.from_pylist(named, schema=SCHEMA))])


def drive(planner: str, town: int, score: float, **more: Any) -> dict[str, Any]:
    where = {"clip_id": f"c{town}", "log_id": f"town-{town}-0000-curve", "start": -1, "pictures": "none"}
    return where | {"planner_digest": planner, "score": score} | more


def test_the_last_line_tells_scores_and_drives_over_towns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tenth better in every clip; of four drives one more scores, so zero lies within."""
    a, b = evaluated(tmp_path / "real", 0.5), evaluated(tmp_path / "mixed", 0.6)
    failed = {"real": 2, "mixed": 1}
    rows = [drive(who, i, float(i >= n)) for who, n in failed.items() for i in range(TOWNS)]
    driven(tmp_path / "drives", *rows)
    assert main([f"a={a}", f"b={b}", f"drives={tmp_path / 'drives'}", "draws=200"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    scores = (
        "mixed against real: two-stage EPDMS 60.0 against 50.0, +10.0 "
        "(95 % over 4 towns: +10.0 to +10.0; p 0.12), better"
    )
    half = 100 * 3.182446 * 0.25  # Student's t of three degrees of freedom, times the standard error
    student = f"{25 - half:+.1f} to +100.0"  # no mean leaves the range of its scores
    ends = f"-100.0 to +100.0; t {student}, wild bootstrap -100.0 to +100.0; p 1"
    routes = f"75.0 % against 50.0 %, +25.0 (95 % over 4 towns: {ends}), no difference told from zero"
    assert last == f"{scores}; scene scores driven {routes}"
    assert main([f"a={a}", f"b={b}", "draws=200"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == scores


def test_drives_from_other_starts_are_not_held_against_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [f"a={evaluated(tmp_path / 'real', 0.5)}", f"b={evaluated(tmp_path / 'mixed', 0.6)}", "draws=50"]
    real, mixed = ([drive(who, i, 1.0) for i in range(2)] for who in ("real", "mixed"))
    others = [{"start": 0}, {"settings": '{"loop": {"seconds": 5.0}}'}, {"pictures": "truth"}]
    tables = [[], [*real, mixed[0]], *([*real, mixed[0], mixed[1] | other] for other in others)]
    for n, (rows, mine) in enumerate(zip(tables, (0, 2, 2, 2, 2))):
        if rows:
            driven(tmp_path / f"{n}", *rows)
        assert main([*runs, f"drives={tmp_path / f'{n}'}"]) == 2
        assert f"from the same starts are needed, there are of real {mine}, mixed" in capsys.readouterr().err
    assert main(["a=first.csv", "b=second.csv", f"drives={tmp_path}"]) == 2
    assert "drives= goes with folders" in capsys.readouterr().err
