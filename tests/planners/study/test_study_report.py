"""A study's tables are made of its per-frame rows alone, and are those of the evaluations' own folders."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.exits import BAD_CONFIG
from planners.evaluation.aggregation import BOUNDS, MEASURES, name_of, scores_of, scores_of_clips
from planners.evaluation.frames import FrameKey
from planners.evaluation.frames_file import FRAMES, rows_of
from planners.evaluation.score_rows import FrameRow, read_rows, write_rows
from planners.study.report import compared, main, read_study, write_study, write_tables
from planners.study.setups import Comparison, Setup
from tests.planners.made_rows import row

STUDY = Path(__file__).parents[3] / "docs" / "study"
REAL, MORE = Setup("ltf", "real", 0, "steps"), Setup("ltf", "pdm_closed", 5, "steps")
COMPARISONS = (Comparison("main", REAL, None, 2, "steps"), Comparison("main", MORE, REAL, 2, "steps"))
LABELS = [*(setup.label_of(seed) for setup in (REAL, MORE) for seed in range(2)), *BOUNDS]
LOGS = {f"clip{i}": f"town-{i // 4}-{i // 2:04d}-curve" for i in range(8)}


def scored(seed: int, plans_follow_ups: bool = True) -> list[FrameRow]:
    """Eight clips of four logs of two towns; frames lie where the benchmark has them, ends where the planner's are."""
    place, rng = np.random.default_rng(0), np.random.default_rng(seed)
    rows = []
    for clip_id in LOGS:
        keys = FrameKey.logged(clip_id)
        starts = place.uniform(-300.0, 300.0, (2, 2))
        ends = starts + rng.normal(scale=0.5, size=(2, 2))
        one, *both = rng.uniform(size=3)
        rows.append(row("one_stage", keys[0], one, one + 0.1, tuple(starts[0]), tuple(ends[0])))
        for key, score, start, end in zip(keys, both, starts, ends):
            rows.append(row("stage_one", key, score, score + 0.1, tuple(start), tuple(end)))
        for i in range(3):
            for side, key in enumerate(FrameKey.follow_up(clip_id, i)):
                score = rng.uniform() if plans_follow_ups else np.nan
                start = starts[side] + place.normal(scale=0.7, size=2)
                rows.append(row("stage_two", key, score, start=tuple(start), end=(score, 0.0)))
    return rows


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Evaluated planners, their benchmark's document, and the report's rows."""
    for seed, label in enumerate(LABELS):
        (tmp_path / "evaluations" / label).mkdir(parents=True)
        write_rows(tmp_path / "evaluations" / label, scored(seed, label != "human"))
    clips = [{"clip_id": clip, "log_id": log, "follow_ups": [0, 1, 2]} for clip, log in LOGS.items()]
    (tmp_path / "benchmark.json").write_text(json.dumps({"format": 1, "clips": clips, "left_out": []}))
    (tmp_path / "report").mkdir()
    facts = [{"training": label, "real": 10, "simulated": 5 * n} for n, label in enumerate(LABELS[:4])]
    rows = rows_of(LABELS, tmp_path / "evaluations", str(tmp_path))
    write_study(tmp_path / "report" / FRAMES, rows, facts, COMPARISONS)
    return tmp_path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_scores_of_the_file_are_those_of_the_folders(study: Path) -> None:
    write_tables(study / "report", study / "report", "unfiltered")
    trainings = {row["training"]: row for row in table(study / "report" / "trainings.csv")}
    bounds = {row["planner"]: row for row in table(study / "report" / "bounds.csv")}
    assert [*trainings, *bounds] == LABELS
    for label, found in {**trainings, **bounds}.items():
        for name, score in scores_of(study / "evaluations" / label).items():
            assert float(found[name]) == pytest.approx(score, abs=1e-4, nan_ok=True), (label, name)
    assert trainings[LABELS[1]]["simulated"] == "5"
    assert float(trainings[LABELS[0]]["stage_two"]) != pytest.approx(float(trainings[LABELS[0]]["follow_ups"]), abs=0.1)


def test_plans_ends_and_logs_come_back_to_the_last_digit(study: Path) -> None:
    clips = read_study(study / "report" / FRAMES).clips
    for label in LABELS:
        groups = {clip.clip_id: clip for clip in clips[label]}
        for kept in read_rows(study / "evaluations" / label):
            side = int(kept.key.kind.endswith("before"))
            group = groups[kept.key.clip_id].groups[side]
            assert groups[kept.key.clip_id].log_id == LOGS[kept.key.clip_id]
            if kept.stage == "stage_one":
                assert group.endpoint_xy.tolist() == kept.end[:2].tolist()
            if kept.stage == "stage_two":
                assert group.starts_xy[kept.key.candidate_index].tolist() == kept.start[:2].tolist()


def test_the_tables_are_made_again_to_the_byte_of_the_file_alone(study: Path, tmp_path: Path) -> None:
    write_tables(study / "report", study / "report", "unfiltered")
    alone = tmp_path / "alone"
    assert main([f"folder={study / 'report'}", f"out={alone}"]) == 0
    made = {path.name: path.read_bytes() for path in alone.iterdir()}
    assert set(made) == {"trainings.csv", "bounds.csv", "clips.csv", "comparisons.csv", "tables.md", "differences.png"}
    for name, content in made.items():
        assert (study / "report" / name).read_bytes() == content, name


def test_intervals_stand_over_clips_logs_and_towns_for_both_filters(study: Path) -> None:
    text = write_tables(study / "report", study / "report", "filtered")
    assert "two-stage EPDMS, filtered" in text
    rows = table(study / "report" / "comparisons.csv")
    finals = [row for row in rows if row["stage"] == "final" and row["reference"]]
    assert [row["human_filter"] for row in finals] == ["unfiltered", "filtered"]
    for found in finals:
        for level in ("", "_log", "_town"):
            assert float(found[f"low{level}"]) <= float(found["difference"]) <= float(found[f"high{level}"])
    said = (study / "report" / "tables.md").read_text()
    assert said.startswith("Scores are filtered") and "; logs " in said and "; towns " in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "frames",
    [path.with_name(FRAMES) for path in sorted(STUDY.glob("**/trainings.csv")) if path.with_name(FRAMES).is_file()],
    ids=lambda path: path.parent.name,
)
def test_the_committed_tables_are_those_of_the_committed_rows(frames: Path) -> None:
    kept = read_study(frames)
    scores = {label: scores_of_clips(clips) for label, clips in kept.clips.items()}
    trainings, comparisons = (table(frames.parent / f"{name}.csv") for name in ("trainings", "comparisons"))
    assert [row["training"] for row in trainings] == [facts["training"] for facts in kept.trainings]
    for training in trainings:
        for name, score in scores[training["training"]].items():
            assert float(training[name]) == pytest.approx(score, abs=1e-4)
    assert len(comparisons) == len(MEASURES) * len(kept.comparisons)
    for one, first in zip(kept.comparisons, range(0, len(comparisons), len(MEASURES))):
        for line, (stage, human_filter) in zip(comparisons[first:], MEASURES):
            assert (line["setup"], line["stage"], line["human_filter"]) == (one.setup.label, stage, human_filter)
            each = [scores[one.setup.label_of(seed)][name_of(stage, human_filter)] for seed in range(one.seeds)]
            assert float(line["epdms"]) == pytest.approx(np.mean(each), abs=1e-4)
    (drawn, *_) = (one for one in kept.comparisons if one.reference is not None)
    for line, made in zip(
        comparisons[len(MEASURES) * kept.comparisons.index(drawn) :], compared(replace(kept, comparisons=(drawn,)))
    ):
        for name in ("difference", "low", "high", "low_log", "high_log", "low_town", "high_town"):
            if made[name] == "":  # one held-out log has no interval over logs
                assert line[name] == ""
            else:
                assert float(line[name]) == pytest.approx(made[name], abs=1e-4)


def test_what_is_no_study_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"folder={tmp_path}"]) == BAD_CONFIG
    assert "frames.parquet" in capsys.readouterr().err
    write_rows(tmp_path, scored(0))
    assert main([f"folder={tmp_path}"]) == BAD_CONFIG
    assert "no rows of a study" in capsys.readouterr().err
    assert main([f"folder={tmp_path}", "human_filter=none"]) == BAD_CONFIG
    assert "human_filter" in capsys.readouterr().err
    assert main([str(tmp_path)]) == BAD_CONFIG
    assert "expected one of folder=" in capsys.readouterr().err
