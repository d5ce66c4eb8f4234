"""What arms learn from, what is held out, and what the report makes of rows that are made up."""

import csv
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.config.words import ConfigError
from planners.ab.ab import Part, check_apart, folds_of, main, parts_of, planned, runs_ahead
from planners.ab.report import holm, write_report
from planners.ab.rows import Trained, read_ab_rows, read_frames, write_ab_rows
from planners.ab.rows import frames_of as kept_frames
from planners.ab.settings import AbSettings, Arm, settings_of
from planners.evaluation.aggregation import ClipResult, collect_scores, group_by_clip
from planners.evaluation.compare import CompareSettings, compare
from planners.evaluation.score_rows import FrameRow, write_rows
from tests.planners.made_rows import clip_rows
from tests.planners.samples import sample, write_table
from tests.planners.small_benchmark import write_benchmark_folder

ROOT = Path(__file__).parents[3]
KEPT = ROOT / "experiments" / "study" / "frames" / "towns.parquet"
TOWNS = 6
ASKED = {"reference": "real", "claim": "pdm_closed", "confidence": 0.95, "steps": 10}
ARMS = ("real", "jitter", "pdm_closed")
BAD = (("drives=[a,b]", "one for each"), ("arms.jitter.added=3", "of the tables under sim"))


def settings(out: Path, **more: Any) -> AbSettings:
    """Two arms over one table of real and simulated samples."""
    arms = {"real": Arm(), "recovery": Arm(sim=("t",), experts=("recovery",)), "pdm_closed": Arm(sim=("t",))}
    values: dict[str, Any] = {"out": str(out), "real": ("t",), "runs": {"t": ""}, "benchmark": ("b",), "arms": arms}
    return AbSettings(**{**values, "planners": {"mlp": "planner=ego_mlp_small"}, **more})


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Six real samples and nine simulated ones, of three logs."""
    experts = ["human"] * 6 + ["recovery"] * 3 + ["pdm_closed"] * 6
    write_table(tmp_path / "t", [sample(i, expert, log_id=f"log{i % 3}") for i, expert in enumerate(experts)])
    return tmp_path


def test_every_arm_has_equal_steps_and_as_many_simulated_samples(table: Path) -> None:
    one = settings(table, seeds=2, steps=7)
    found = {training.label: training for training in planned(one, folds_of(one, ["elsewhere"]))}
    assert list(found)[:4] == ["mlp-real-0", "mlp-recovery-0", "mlp-pdm_closed-0", "mlp-real-1"]
    assert all("steps=7" in training.overrides for training in found.values())
    assert "data.sim=[]" in found["mlp-real-0"].overrides
    limits = [word for training in found.values() for word in training.overrides if "limit_sim" in word]
    assert limits == ["data.limit_sim=3"] * 4, "as many as the arm with the fewest has"
    everything = planned(replace(one, added="all"), [frozenset()])
    assert not any("limit_sim" in word for training in everything for word in training.overrides)
    half = replace(one, arms={**one.arms, "half": replace(one.chosen["pdm_closed"], added=1)})
    few = {t.facts["arm"]: w for t in planned(half, [frozenset()]) for w in t.overrides if "limit_sim" in w}
    assert few == {"recovery": "data.limit_sim=3", "pdm_closed": "data.limit_sim=3", "half": "data.limit_sim=1"}


def test_with_folds_each_log_is_held_out_once_and_learned_from_by_no_arm_then(table: Path) -> None:
    one = settings(table, folds="each", seeds=1)
    folds = folds_of(one, ["log0", "log1", "log2"])
    assert folds == [{"log0"}, {"log1"}, {"log2"}]
    without = [w for t in planned(one, folds) if t.facts["arm"] == "recovery" for w in t.overrides if "without" in w]
    assert without == [f"data.without_logs=[log{i}]" for i in range(3)]
    parts = parts_of(folds, [["log0", "log0", "log2"], ["log1", "elsewhere"]])
    assert parts == [Part(0, 0, ("log0",)), Part(1, 1, ("log1",)), Part(0, 2, ("log2",))], "each where it is held out"
    with pytest.raises(ConfigError, match="of 2 towns or logs, too few"):
        folds_of(replace(one, folds=3), ["town-1-0000-curve", "town-1-0001-curve", "town-2-0000-curve"])


def test_an_arm_that_learns_from_what_it_is_scored_on_is_refused(table: Path) -> None:
    check_apart(settings(table), ["elsewhere"])
    with pytest.raises(ConfigError, match="arm real learns from log0 and 1 more, which the benchmark holds"):
        check_apart(settings(table), ["log0", "log2"])


def test_arms_come_and_go_on_the_command_line(tmp_path: Path) -> None:
    found = settings_of(["arms.recovery=null", "arms.mine={sim: [runs/x]}", "seeds=3"])
    assert "recovery" not in found.chosen and found.chosen["mine"] == Arm(sim=("runs/x",)) and found.seeds == 3
    assert {"real", "more", "jitter", "logged", "pdm_closed"} < set(found.chosen)
    for word, said in (("claim=other", "no arm"), ("claim=real", "reference itself"), ("folds=1", "at least 2"), *BAD):
        with pytest.raises(ConfigError, match=said):
            settings_of([word])
    (tmp_path / "mine.yaml").write_text("[1]")
    assert main([str(tmp_path / "mine.yaml")]) == main([str(tmp_path / "none.yaml")]) == 2


def test_an_experiment_says_its_cost_by_its_first_training_and_goes_on(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_benchmark_folder(table / "b")
    file = table / "mine.yaml"
    file.write_text(
        f"{{out: {table}/out, real: [{table}/t], benchmark: [{table}/b], planners: {{mlp: planner=ego_mlp_small}}, "
        f"train: planner.training.batch_size=2 workers=1, steps: 2, seeds: 1, "
        f"arms: {{real: {{}}, pdm_closed: {{sim: [{table}/t], experts: [pdm_closed]}}}}}}"
    )
    assert main([str(file), "minutes=0.0001"]) == 4, "nothing was begun"
    assert main([str(file)]) == 0
    ahead = re.search(
        r"still to train: 1 of mlp, (\d+) CPU s to train and (\d+) to score each: at most (\d+) s of CPU",
        (told := capsys.readouterr()).err,
    )
    assert ahead and 0 < int(ahead[3]) <= int(ahead[1]) + int(ahead[2]) + 1
    assert "pdm_closed against real, mlp, 1 seed: two-stage EPDMS" in told.out.splitlines()[-1]
    assert "follow_ups is the plain mean" in (table / "out" / "commands.log").read_text(), "the commands' own tables"
    assert main([str(file)]) == 0
    again = capsys.readouterr()
    assert "still to train: none" in again.err and again.out == told.out


def test_what_the_runs_will_take_is_said_before_any_is_made(tmp_path: Path) -> None:
    town = "clips=synthetic_towns clips.n_towns=1 clips.settings.cameras=[] clips.settings.lidar_beams=0 render=none"
    (tmp_path / "done").mkdir()
    (tmp_path / "done" / "report.json").write_text("{}")  # of a run that came to its end
    expected, then = runs_ahead(settings(tmp_path, runs={"t": town, "done": town}, folds=3)).splitlines()[1:]
    assert re.fullmatch(r"t: expected for 9 clips: \d+ attempts, .* core-hours", expected)
    assert then == "then 6 trainings of 1500 steps, for each of 3 parts that is held out: the first says what they cost"
    assert not (tmp_path / "t").exists(), "nothing is made"
    (then,) = runs_ahead(settings(tmp_path, runs={}, folds="each")).splitlines()[1:]
    assert then == "then 6 trainings of 1500 steps, for each log that is held out: the first says what they cost"


def frames_of(bonus: float) -> list[FrameRow]:
    """Two clips in each of the towns, whose score rises from town to town."""
    ends, follow_ups = ((0.0, 0.0), (0.0, 0.0)), [((1.0, 1.0), (0.0, 0.0), (0.0, 0.0))]
    found = []
    for i in range(2 * TOWNS):
        score, log = 0.3 + bonus * (1 + i // 2) / TOWNS, f"town-{i // 2}-000{i % 2}-curve"
        found += clip_rows(f"clip{i:02}", score, (score, score), ends, follow_ups, log)
    return found


def final_score(clips: Sequence[ClipResult]) -> float:
    one = collect_scores([clips], "score")["final", "unfiltered"]
    return float((one.scores * one.weights).sum() / one.weights.sum())


def drives_of(label: str, score: float, failed: int = 0) -> list[dict[str, Any]]:
    return [
        {"training": label, "log_id": f"town-{i}-0000-curve", "clip_id": f"clip{2 * i:02}", "pictures": "none"}
        | {"start": -1, "score": score * (i >= failed), "dist_traveled_m": 1000.0}
        | {"offroad_or_collision_at_fault": float(i < failed)}
        for i in range(TOWNS)
    ]


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Of two seeds: jitter is as good as real, pdm_closed better the later the town, up to 12 points."""
    trained = [Trained("bev", arm, seed, 30, 9 * (arm == "pdm_closed")) for seed in (0, 1) for arm in ARMS]
    frames = {one.label: frames_of(0.12 * (one.arm == "pdm_closed")) for one in trained}
    frames |= {"constant_velocity": frames_of(-0.1), "go_straight": frames_of(-0.1), "pdm_closed": frames_of(0.5)}
    drives = [row for label in frames for row in drives_of(label, 0.8, 2 if "real" in label else 1)]
    for label, rows in frames.items():
        (tmp_path / label).mkdir()
        write_rows(tmp_path / label, rows)
    write_ab_rows(tmp_path / "out", trained, ASKED, [kept_frames(tmp_path / label, label) for label in frames], drives)
    return tmp_path / "out"


def test_the_report_is_made_of_rows_alone_and_says_one_verdict(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"rows={kept}"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    # Student's t of 2, 4 .. 12 points: 7 +- 2.5706 * sqrt(14 / 6); six of one sign are 1 in 32.
    assert last.startswith(
        "pdm_closed against real, bev, 2 seeds: two-stage EPDMS 37.0 against 30.0, +7.0 (95 % over 6"
    )
    assert "t +3.1 to +10.9" in last and "p 0.031), better; scene score" in last
    assert "no difference told from zero; of 36 differences told here, for which Holm makes p" in last
    made = {path.name: path.read_bytes() for path in kept.iterdir()}
    assert {"ab.md", "ab.svg", "differences.csv", "frames.parquet", "drives.parquet"} == set(made)
    write_report(kept)
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == made
    text = made["ab.md"].decode()
    assert (
        "| `pdm_closed` | 30 + 9 | 37.0 (**+7.0**:" in text
        and "| `jitter` | 30 + 0 | 30.0 (**-7.0**:" in text
        and "| `(go_straight)` |" in text
    )
    assert "| town-5 | +0.0 | +12.0 |" in text
    rows = list(csv.DictReader((kept / "differences.csv").open()))
    jitter = next(row for row in rows if (row["who"], row["measure"]) == ("jitter", "two-stage EPDMS"))
    assert (float(jitter["difference"]), float(jitter["low"]), float(jitter["p"])) == (0.0, 0.0, 1.0)
    picture = ET.fromstring(made["ab.svg"])
    assert len(picture.findall("{http://www.w3.org/2000/svg}circle")) >= 5 * TOWNS


def test_rows_come_back(kept: Path) -> None:
    found = read_ab_rows(kept)
    assert [one.label for one in found.trained][:2] == ["bev-real-0", "bev-jitter-0"] and found.asked == ASKED
    expected = final_score(group_by_clip(frames_of(0.12)))
    assert final_score(found.frames["bev-pdm_closed-1"]) == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match=r"no rows of `python -m planners ab`"):
        (kept / "frames.parquet").write_bytes(KEPT.read_bytes())
        read_ab_rows(kept)


def test_p_of_many_is_adjusted_as_holm_has_it() -> None:
    assert holm([0.01, np.nan, 0.04, 0.03]) == pytest.approx([0.03, np.nan, 0.06, 0.06], nan_ok=True)
    assert holm([0.9, 0.8]) == [1.0, 1.0]


FAMILIES = ("ltf", "diffusiondrive", "gtrs_dense")


@pytest.mark.slow
def test_what_the_readme_says_of_simulated_samples_is_what_the_kept_frames_say() -> None:
    clips = read_frames(KEPT)

    def means(what: str, seeds: str) -> list[list[ClipResult]]:
        return [clips[f"{family}-{what}-{seed}"] for family in FAMILIES for seed in seeds]

    readme = " ".join((ROOT / "README.md").read_text().split())
    rules = CompareSettings(a="", b="")
    found = compare(means("real-steps", "012"), means("pdm_closed5-epochs", "012"), rules)
    final = found["final", "unfiltered"]["town"]
    low, high = f"{100 * final.low:+.1f}", f"{100 * final.high:+.1f}"
    row = f"| {100 * final.a:.1f} | {100 * final.b:.1f} | {100 * final.difference:+.1f} ({low} to {high}) |"
    assert row in readme, row
    assert not final.is_clear, "zero lies inside"
    assert f"{100 * final_score(clips['constant_velocity']):.1f} in the study, whose" in readme
