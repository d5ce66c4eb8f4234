"""Which labels teach most: equally many of each expert's, of clips that nobody is scored on; and that it runs."""

import csv
from pathlib import Path

import pytest

from factory.config.compose import compose, fill
from factory.config.run import load_config
from factory.exits import COMPLETE
from planners.drive.settings import settings_of
from planners.study.experiment import BEGIN, ExperimentSettings, comparisons, planned
from planners.study.labels import main
from tests.planners.study.test_sceptic import FIRST_UNSEEN, in_one_process, option, towns_of

__all__ = ["in_one_process"]  # a fixture

EXPERTS = ["recovery", "pdm_closed"]


def settings(*words: str) -> ExperimentSettings:
    return fill(ExperimentSettings, compose("labels", words, ExperimentSettings), "labels")


def test_nobody_is_scored_on_towns_that_anybody_learns_from() -> None:
    chosen = settings()
    runs = {name: load_config([*text.split(), f"out=here/{name}"]) for name, text in chosen.runs.items()}
    towns = {name: towns_of(run.clips) for name, run in runs.items()}
    driven = towns_of(settings_of([*chosen.drives.split(), "planner=constant_velocity"]).clips)  # type: ignore[union-attr]
    assert driven == towns["hard"] and min(driven) >= FIRST_UNSEEN
    assert not driven & (towns["begin"] | towns["train"])
    assert towns["train"] == towns["more"] == towns["logged"]
    n = runs["train"].clips["logs_per_town"]
    first = [runs[name].clips["first_log"] for name in ("train", "more", "more_too")]
    assert first == [0, n, 2 * n] and runs["more"].clips["logs_per_town"] == n, "other logs"
    assert not towns["begin"] & towns["train"]


def test_arms_differ_in_whose_labels_are_added_and_in_nothing_else() -> None:
    chosen = settings()
    arms = [one for one in planned(chosen, dict.fromkeys(chosen.arms, 7)) if one.facts["data"] != BEGIN]
    assert [one.facts["data"] for one in arms[:5]] == ["real", "more", "logged", *EXPERTS]
    assert len({tuple(w for w in one.overrides if not w.startswith(("data.", "seed="))) for one in arms}) == 1
    real = {option(one.overrides, "data.real") for one in arms if one.facts["data"] != "more"}
    assert (
        len(real) == 1
        and option(arms[1].overrides, "data.real") == real.pop()[:-1] + f",{chosen.out}/more,{chosen.out}/more_too]"
    )  # type: ignore[index]
    assert {option(one.overrides, "data.limit_sim") for one in arms} == {None, "7"}
    held = {(one.setup.data, one.reference.data) for one in comparisons(chosen) if one.reference}
    assert {(name, "real") for name in chosen.arms} <= held
    assert {(name, "pdm_closed") for name in chosen.arms if name not in ("pdm_closed", "more")} <= held


TINY = [  # one town: a log to begin with, one to learn from, a third to be scored on
    "common.begin='${.blind} clips.split=train clips.seeds=[3] clips.logs_per_town=1 limit=2 rounds=1'",
    "common.train='${.blind} clips.split=train clips.seeds=[3] clips.logs_per_town=1 clips.first_log=1 limit=1 "
    "executor=local rounds=1'",
    "common.states='vocabulary.k=4000'",
    "runs.train='${common.train} ${common.states} ${common.ungated} experts=[human,recovery,pdm_closed]'",
    "runs.more='${common.begin} clips.first_log=2 limit=1 experts=[human]'",
    "runs.more_too='${common.begin} clips.first_log=3 limit=1 experts=[human]'",
    "runs.hard='preset=hard_benchmark ${common.blind} clips.split=test clips.seeds=[3] clips.logs_per_town=1 "
    "clips.first_log=2 clips.first_window=2 vocabulary.k=8000 rounds=1 benchmark.min_follow_ups=1 executor=local'",
    "train=['planner.training.batch_size=1','workers=1']",
    "begin_steps=1",
    "steps=2",
    "rounds=1",
    "seeds=1",
    "drives=null",
]


@pytest.mark.slow
def test_the_whole_of_it_runs(tmp_path: Path, in_one_process: None, capsys: pytest.CaptureFixture[str]) -> None:
    words = [f"out={tmp_path / 'out'}", f"report={tmp_path / 'report'}", *TINY]
    words = [word.replace("clips.seeds", f"clips.cache_dir={tmp_path / 'towns'} clips.seeds") for word in words]
    assert main(words) == COMPLETE, capsys.readouterr().err
    report = tmp_path / "report"
    made = {path.name: path.read_bytes() for path in report.iterdir()}
    assert "arms.md" not in made, "nothing is driven"
    rows = list(csv.DictReader((report / "trainings.csv").open()))
    counts = {row["data"]: (row["real"], row["simulated"]) for row in rows}
    assert counts == {"begin": ("2", "0"), "real": ("3", "0"), "more": ("5", "0")} | dict.fromkeys(
        ["logged", *EXPERTS], ("3", "1")
    )
    assert main([*words, "minutes=0"]) == COMPLETE
    assert {path.name: path.read_bytes() for path in report.iterdir()} == made
