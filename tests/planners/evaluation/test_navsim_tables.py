"""NAVSIM's tables: written as its scripts write them, read back, and held against each other by `compare`."""

import csv
import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planners.ab.compare import main
from planners.evaluation.aggregation import summarise
from planners.evaluation.evaluate import EvaluateSettings, evaluate
from planners.evaluation.frames import FrameKey
from planners.evaluation.navsim import file_name, read_table, score_of_columns, write_tables
from planners.evaluation.planner_names import find_planners
from planners.evaluation.score_rows import FrameRow, read_rows
from tasks.reward.aggregate import COLUMNS, FrameScores
from tests.planners.small_benchmark import StreetBenchmark

SCORE, EC, DAC = (COLUMNS.index(name) for name in ("score", "ec", "dac"))
HEAD = [  # of the released files
    *("no_at_fault_collisions", "drivable_area_compliance", "driving_direction_compliance", "traffic_light_compliance"),
    *("ego_progress", "time_to_collision_within_bound", "lane_keeping", "history_comfort"),
    "two_frame_extended_comfort",
]
NOWHERE = np.full(3, np.nan)


def scores(ep: float, ec: float = 1.0, left_the_road: bool = False) -> FrameScores:
    """All well but progress; what leaves the road is forgiven."""
    row = np.ones(len(COLUMNS))
    row[COLUMNS.index("ep")], row[EC] = ep, ec
    row[SCORE] = score_of_columns(row[None])[0]
    unfiltered = row.copy()
    if left_the_road:
        unfiltered[[DAC, SCORE]] = 0.0
    return FrameScores(unfiltered, row)


def lone(clip_id: str, of_frame: FrameScores) -> FrameRow:
    return FrameRow("one_stage", FrameKey.logged(clip_id).now, of_frame, 1.0, np.zeros(3), np.zeros(3))


def pairs(clip_id: str, starts: tuple[float, float]) -> list[FrameRow]:
    """One stage, stage one whose plans end at x = 0, and two pairs of follow-ups that start at these x."""
    now, before = FrameKey.logged(clip_id)
    rows = [lone(clip_id, scores(1.0))]
    rows += [replace(rows[0], stage="stage_one", key=now, scores=scores(0.5, left_the_road=True))]
    rows += [replace(rows[0], stage="stage_one", key=before, scores=scores(0.25))]
    for i, x in enumerate(starts):
        for key, ep in zip(FrameKey.follow_up(clip_id, i), (0.2 + 0.4 * i, 0.8)):
            rows.append(FrameRow("stage_two", key, scores(ep, 0.0), 1.0, np.array([x, 0.0, 0.0]), NOWHERE))
    return rows


def tokens_of(rows: list[FrameRow]) -> dict[FrameKey, str]:
    return {row.key: f"{row.key.clip_id}-{row.key.kind}-{row.key.candidate_index}" for row in rows}


def written(folder: Path, rows: list[FrameRow]) -> Path:
    folder.mkdir()
    write_tables(folder, rows, tokens_of(rows))
    return folder


def test_one_stage_is_a_row_a_token_and_their_mean_under_the_public_names(tmp_path: Path) -> None:
    rows = [lone("b", scores(0.5, np.nan)), lone("a", scores(0.8, 0.0, left_the_road=True))]
    folder = written(tmp_path / "out", rows)
    table = list(csv.reader((folder / "navsim_unfiltered.csv").open()))
    assert table[0] == ["", "token", "valid", *HEAD, "score"]
    # extended comfort is not known of the first: (5 * 0.5 + 5 + 2 + 2) / 14; of the second 0: (5 * 0.8 + 9) / 16
    assert table[1] == ["0", "b-human--1", "True", *["1.0"] * 4, "0.5", *["1.0"] * 3, "", repr(11.5 / 14)]
    assert table[2] == ["1", "a-human--1", "True", *["1.0"] * 4, "0.8", *["1.0"] * 3, "0.0", "0.0"]
    assert table[3] == ["2", "average_all_frames", "True", *["1.0"] * 4, "0.65", *["1.0"] * 3, "0.0", repr(11.5 / 28)]
    assert len(table) == 4
    filtered = list(csv.reader((folder / "navsim_filtered.csv").open()))
    assert [row[:-1] for row in filtered] == [row[:-1] for row in table]
    assert float(filtered[2][-1]) == pytest.approx(13 / 16)
    assert float(filtered[3][-1]) == pytest.approx((11.5 / 14 + 13 / 16) / 2)


def test_two_stages_stand_side_by_side_with_the_summary_that_the_planner_has(tmp_path: Path) -> None:
    rows = [*pairs("z", (0.0, 0.5)), *pairs("c", (0.0, 9.0))]
    folder = written(tmp_path / "out", rows)
    head, *table = csv.reader((folder / "navsim_filtered.csv").open())
    assert head == ["", "token", "valid", *(n + "_stage_one" for n in HEAD), *(n + "_stage_two" for n in HEAD), "score"]
    assert [row[0] for row in table] == [str(i) for i in range(4 + 8 + 3)]
    assert [row[1] for row in table[:3]] == ["z-human--1", "z-human_before--1", "c-human--1"]
    assert all(set(row[12:21]) == {""} and "" not in row[3:12] for row in table[:4])
    assert all(set(row[3:12]) == {""} and "" not in row[12:21] for row in table[4:12])
    one, two, both = table[-3:]
    assert [row[1] for row in table[-3:]] == [f"extended_pdm_score_{n}" for n in ("stage_one", "stage_two", "combined")]
    assert set(one[12:21]) == set(two[3:12]) == {""}
    assert both[3:12] == one[3:12] and both[12:21] == two[12:21]
    told = summarise(rows).two_stage
    assert told is not None
    means = told.stage_one.filtered[SCORE], told.stage_two[SCORE], told.final.filtered[SCORE]
    np.testing.assert_allclose([float(row[-1]) for row in (one, two, both)], means, rtol=0, atol=1e-15)
    # progress of stage two, by hand: z now weighs 1 : exp(-0.25 / 0.2), c now the first alone, before 0.8 each
    z = (0.2 + 0.6 * np.exp(-1.25)) / (1.0 + np.exp(-1.25))
    assert float(two[head.index("ego_progress_stage_two")]) == pytest.approx((z + 0.2 + 0.8 + 0.8) / 4, abs=1e-15)
    unfiltered = list(csv.reader((folder / "navsim_unfiltered.csv").open()))
    assert [float(row[-1]) for row in unfiltered[1:5]] == [0.0, float(table[1][-1])] * 2
    assert float(unfiltered[-1][-1]) == pytest.approx(told.final.unfiltered[SCORE], abs=1e-15)


def test_what_was_written_is_read_back_whole_and_packed_too(tmp_path: Path) -> None:
    rows = pairs("a", (0.0, 0.5))
    path = written(tmp_path / "out", rows) / "navsim_unfiltered.csv"
    packed = tmp_path / "packed.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    for table in (read_table(path), read_table(packed)):
        assert (table.stage, table.human_filter, table.failed) == ("stage_one", "unfiltered", ())
        named = {**table.logged, **table.follow_ups}
        for row in rows[1:]:
            np.testing.assert_array_equal(named[tokens_of(rows)[row.key]], row.scores.published)
        assert set(table.summary) == {"stage_one", "stage_two", "final"} and len(table.follow_ups) == 4
        # a paper's file holds the filtered score too: that of its own columns
        filtered = table.scores("filtered")
        assert filtered is not None and filtered["a-human--1"][SCORE] == pytest.approx(13.5 / 16)
    today = read_table(path.with_name("navsim_filtered.csv"))
    assert today.human_filter == "filtered" and today.scores("unfiltered") is None


def test_a_planner_without_plans_from_follow_ups_has_failed_there(tmp_path: Path) -> None:
    nothing = FrameScores(*[np.full(len(COLUMNS), np.nan)] * 2)
    rows = [replace(row, scores=nothing) if row.stage == "stage_two" else row for row in pairs("a", (0.0, 0.5))]
    path = written(tmp_path / "out", rows) / "navsim_filtered.csv"
    valid = [row["valid"] for row in csv.DictReader(path.open())]
    assert valid == ["True"] * 2 + ["False"] * 7
    table = read_table(path)
    assert len(table.logged) == 2 and len(table.failed) == 4 and not table.follow_ups
    assert np.isnan(table.summary["final"]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:-1], "no row extended_pdm_score_combined: it was not written to its end"),
        (lambda lines: [*lines[:1], *lines[2:]], "stage_one says .* its 1 rows make .*: rows are missing"),
        (lambda lines: [*lines[:2], *lines[1:]], "line 3: token a-human--1 stands there twice"),
        (lambda lines: [lines[0].replace("ego_progress", "progress"), *lines[1:]], "no table of NAVSIM's"),
        (lambda lines: [*lines[:3], lines[3] + ",1.0", *lines[4:]], "line 4: 23 cells, the head has 22"),
        (lambda lines: [*lines[:3], lines[3].replace("True,", "True,x"), *lines[4:]], "line 4: could not convert"),
        (lambda lines: [], "no table of NAVSIM's"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    path = written(tmp_path / "out", pairs("a", (0.0, 0.5))) / "navsim_filtered.csv"
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))
    with pytest.raises(ValueError, match=message):
        read_table(path)


def test_a_file_and_a_folder_are_held_against_each_other_from_either_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The released file of the paper's era has unfiltered scores, and both of its measures come out."""
    first = [*pairs("a", (0.0, 0.5)), *pairs("b", (0.5, 0.0))]
    second = [replace(row, scores=scores(0.9, 1.0)) for row in first]
    mine, theirs = written(tmp_path / "mine", first), written(tmp_path / "theirs", second)
    released = tmp_path / "released.csv"
    (mine / "navsim_unfiltered.csv").rename(released)
    (mine / "navsim_filtered.csv").unlink()
    said = {}
    for a, b in ((released, theirs), (theirs, released)):
        assert main([f"a={a}", f"b={b}", "draws=50", f"out={tmp_path / 'found.csv'}"]) == 0
        assert "no interval" in capsys.readouterr().out
        with (tmp_path / "found.csv").open() as file:
            said[a.name] = {(row["stage"], row["human_filter"]): row for row in csv.DictReader(file)}
    before, after = summarise(first).two_stage, summarise(second).two_stage
    assert before is not None and after is not None
    wanted = {
        ("stage_one", "unfiltered"): after.stage_one.unfiltered - before.stage_one.unfiltered,
        ("stage_one", "filtered"): after.stage_one.filtered - before.stage_one.filtered,
        ("follow_ups", "none"): after.follow_ups - before.follow_ups,
        ("stage_two", "none"): after.stage_two - before.stage_two,
        ("final", "unfiltered"): after.final.unfiltered - before.final.unfiltered,
    }
    assert set(said["released.csv"]) == set(said["theirs"]) == set(wanted)
    for name, difference in wanted.items():
        assert float(said["released.csv"][name]["difference"]) == pytest.approx(difference[SCORE], abs=1e-12)
        assert float(said["theirs"][name]["difference"]) == pytest.approx(-difference[SCORE], abs=1e-12)
        assert (said["theirs"][name]["low"] == "") == (name[0] in ("stage_two", "final"))


def test_tables_of_other_tokens_or_stages_and_folders_without_any_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = written(tmp_path / "two", pairs("a", (0.0, 0.5))) / "navsim_filtered.csv"
    other = written(tmp_path / "other", pairs("b", (0.0, 0.5)))
    one = written(tmp_path / "one", [lone("a", scores(0.5))]) / "navsim_filtered.csv"
    (tmp_path / "bare").mkdir()
    for b, message in (
        (other, "tokens stand on one side alone, such as a-"),
        (one, "nothing to hold against it"),
        (tmp_path / "bare", "no navsim_unfiltered.csv: evaluate writes it"),
        (tmp_path / "nowhere.csv", "nowhere.csv"),
    ):
        assert main([f"a={two}", f"b={b}"]) == 2
        assert message in capsys.readouterr().err
    assert main([f"a=[{two},{other}]", f"b={two}"]) == 2
    assert "differ in 4 tokens" in capsys.readouterr().err


def test_evaluate_writes_them_where_frames_have_tokens(tmp_path: Path) -> None:
    streets = StreetBenchmark()
    who, settings = find_planners("pdm_closed", None, bounds=False), EvaluateSettings("streets", out=str(tmp_path))
    evaluate(streets, who, settings)
    assert not (tmp_path / "pdm_closed" / file_name("filtered")).exists()
    streets.tokens = {key: str(number) for number, key in enumerate(streets.keys)}
    evaluate(streets, who, replace(settings, out=str(tmp_path / "named")))
    folder = tmp_path / "named" / "pdm_closed"
    rows = {(row.stage, streets.tokens[row.key]): row for row in read_rows(folder)}
    table = read_table(folder / file_name("filtered"))
    assert set(table.logged) == {"0", "1", "6", "7"} and len(table.follow_ups) == 8
    for token, columns in table.logged.items():
        np.testing.assert_array_equal(columns, rows["stage_one", token].scores.filtered)
    for token, columns in table.follow_ups.items():
        np.testing.assert_array_equal(columns, rows["stage_two", token].scores.filtered)
