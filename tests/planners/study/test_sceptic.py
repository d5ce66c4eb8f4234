"""The sceptic's experiment: fair arms on towns that nobody has seen, and that the whole of it runs."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from factory.config.compose import compose, fill
from factory.config.run import load_config
from factory.exits import COMPLETE, INTERRUPTED
from factory.run import main as run
from planners.drive import drive
from planners.drive.settings import settings_of
from planners.evaluation.evaluate import main as evaluate
from planners.study import recipe, sweep
from planners.study.experiment import BEGIN, ExperimentSettings, comparisons, planned
from planners.study.sceptic import main
from planners.study.sweep import EVALUATIONS
from planners.training.many import DONE, Training, folder_of
from planners.training.train import main as train
from tests.planners.faults import interrupted_after_one

MORE, REDRAWN, LOGGED, EXPERT = "more", "redrawn", "logged", "pdm_closed"
ADDED = {MORE: 9, REDRAWN: 8, LOGGED: 9, EXPERT: 9}
FIRST_UNSEEN = 300  # no town of this seed or a later one was looked at before the settings were written


def settings(*words: str) -> ExperimentSettings:
    return fill(ExperimentSettings, compose("sceptic", words, ExperimentSettings), "sceptic")


def option(overrides: tuple[str, ...], name: str) -> str | None:
    return next((one.split("=", 1)[1] for one in overrides if one.startswith(f"{name}=")), None)


def towns_of(clips: dict[str, Any]) -> set[int]:
    return set(range(clips["first_seed"], clips["first_seed"] + clips["n_towns"]))


def test_nobody_is_scored_on_towns_that_anybody_learns_from_or_was_tuned_on() -> None:
    chosen = settings()
    runs = {name: load_config([*text.split(), f"out=here/{name}"]) for name, text in chosen.runs.items()}
    towns = {name: towns_of(run.clips) for name, run in runs.items()}
    driven = towns_of(settings_of([*chosen.drives.split(), "planner=constant_velocity"]).clips)
    learned = towns["train"] | towns["more"] | towns["redrawn"] | towns["logged"]
    assert min(learned | towns["hard"] | driven) >= FIRST_UNSEEN > max(towns["begin"])
    assert learned == towns["train"] and driven == towns["hard"] and not learned & driven
    assert runs["hard"].render.mode == runs["more"].render.mode == "painter", "true pictures"
    same = {"perturb", "render", "traffic", "vocabulary", "rounds", "seed", "clips"}
    for name in ("logged", "redrawn"):
        differs = {key for key in same if getattr(runs[name], key) != getattr(runs["train"], key)}
        assert differs == ({"perturb"} if name == "redrawn" else set())
    first, more = (runs[name].clips for name in ("train", "more"))
    assert more["first_log"] >= first["logs_per_town"], "other logs"


def test_arms_differ_in_what_is_added_and_in_nothing_else() -> None:
    chosen = settings()
    everyone = planned(chosen, ADDED)
    arms = [one for one in everyone if one.facts["data"] != BEGIN]
    assert len(arms) == 5 * chosen.seeds and len(everyone) == len(arms) + 1
    assert len({one.label for one in everyone}) == len(everyone)
    free = ("data.", "seed=")
    rest = {tuple(word for word in one.overrides if not word.startswith(free)) for one in arms}
    assert len(rest) == 1 and f"steps={chosen.steps}" in next(iter(rest))
    real = {one.facts["data"]: option(one.overrides, "data.real") for one in arms}
    assert len({real[name] for name in ("real", REDRAWN, LOGGED, EXPERT)}) == 1
    assert real[MORE] == real["real"][:-1] + f",{chosen.out}/more]"  # type: ignore[index]
    sim = {one.facts["data"]: [option(one.overrides, f"data.{key}") for key in ("sim", "experts")] for one in arms}
    assert sim["real"] == sim[MORE] == [None, None]
    assert sim[REDRAWN] == [f"[{chosen.out}/redrawn]", "[logged]"]
    assert sim[LOGGED] == [f"[{chosen.out}/logged]", "[logged]"]
    assert sim[EXPERT] == [f"[{chosen.out}/train]", "[pdm_closed]"]
    for one in arms:
        limit = option(one.overrides, "data.limit_sim")
        assert limit == (str(ADDED[str(one.facts["data"])]) if one.facts["rounds"] else None)


def test_every_arm_is_held_against_real_alone_and_the_expert_against_each_control() -> None:
    found = [(one.setup.data, one.reference.data) for one in comparisons(settings()) if one.reference]
    assert {(data, "real") for data in ADDED} <= set(found)
    assert {(EXPERT, MORE), (EXPERT, LOGGED), (LOGGED, REDRAWN)} <= set(found)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("steps=0", "steps=0"),
        ("seeds=0", "seeds=0"),
        ("rounds=0", "of experts and of rounds"),
        ("arms.more.run=others", "runs lacks others"),
        ("arms.logged.rounds=0", "of experts and of rounds"),
        ("+arms.logged.expert=[logged]", "arms.logged.expert"),
        ("+parts.other=[logged,recovery]", "recovery is no arm"),
        ("added=others", "added"),
    ],
)
def test_what_is_no_experiment_is_refused(word: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        settings(word)


TINY = [  # one log to learn from and another one, of the same town, for all the rest: a window of it each
    "common.samples='clips=synthetic_towns clips.split=train reward.labels=none render.frames=now executor=local'",
    "common.towns='clips.seeds=[3] clips.logs_per_town=1'",
    "common.rendered='${common.samples} ${common.towns} vocabulary.k=2000 rounds=1 limit=1 render.scene=discs "
    "render.psnr_min=0 render.gate.enabled=false render.width=64 render.height=36 clips.settings.width=64 "
    "clips.settings.height=36 clips.settings.lidar_beams=8 clips.settings.steps_per_photo=5'",
    "common.painted='render=painter render.width=64 render.height=36 clips.settings.cameras=[] "
    "clips.settings.lidar_beams=0'",
    "runs.begin='${common.samples} ${common.towns} ${common.painted} clips.first_log=1 limit=1 experts=[human]'",
    "runs.train='${common.rendered} experts=[human,pdm_closed] ${common.ungated}'",
    "runs.more='${common.samples} ${common.towns} ${common.painted} clips.first_log=1 clips.first_window=1 limit=1 "
    "experts=[human]'",
    "runs.hard='preset=hard_benchmark clips=synthetic_towns clips.split=test ${common.towns} clips.first_log=1 "
    "clips.first_window=2 vocabulary.k=8000 rounds=1 benchmark.min_follow_ups=1 executor=local ${common.painted}'",
    "drives='clips=synthetic_towns clips.split=test clips.seeds=[3] clips.logs_per_town=1 clips.first_log=1 "
    "clips.first_window=2 clips.settings.cameras=[] clips.settings.lidar_beams=0 render.width=64 render.height=36 "
    "seconds=1'",
    "train=['planner.training.batch_size=1','workers=1','planner.settings.image.width=64',"
    "'planner.settings.image.height=32','planner.settings.fusion.image_tokens=[1,2]']",
    "begin_steps=1",
    "steps=2",
    "psnr_db=0",
    "rounds=1",
    "seeds=1",
]


@pytest.fixture
def in_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs, trainings and evaluations without a process each, which is most of their time at this size."""

    def factory(name: str, *words: str) -> None:
        assert name == "run" and run([*words, "graph.isolated=never"]) == COMPLETE

    def train_all(trainings: Sequence[Training], out: Path, means: object) -> None:
        for one in trainings:
            assert train([*one.overrides, f"out={folder_of(out, one)}"]) == COMPLETE
            (folder_of(out, one) / DONE).write_text(json.dumps(list(one.overrides)))

    def evaluate_all(everyone: Sequence[Training], out: Path, benchmark: str, means: object, *more: str) -> None:
        named = ",".join(f"{one.label}: '{one.spec(out)}'" for one in everyone)
        assert evaluate([f"benchmark={benchmark}", f"planners={{{named}}}", f"out={out / EVALUATIONS}"]) == COMPLETE

    monkeypatch.setattr(recipe, "factory", factory)
    monkeypatch.setattr(sweep, "train_all", train_all)
    monkeypatch.setattr(sweep, "evaluate_all", evaluate_all)


@pytest.mark.slow
def test_the_whole_of_it_runs_and_says_the_same_again(
    tmp_path: Path, in_one_process: None, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [f"out={tmp_path / 'out'}", f"report={tmp_path / 'report'}", *TINY]
    words = [word.replace("clips.seeds", f"clips.cache_dir={tmp_path / 'towns'} clips.seeds") for word in words]
    with interrupted_after_one(drive):
        assert main(words) == INTERRUPTED
    assert "what is driven is kept, and the same command goes on" in capsys.readouterr().err
    assert main(words) == COMPLETE, capsys.readouterr().err
    report = tmp_path / "report"
    made = {path.name: path.read_bytes() for path in report.iterdir()}
    assert {"arms.md", "driving.csv", "driving_differences.csv", "bounds_held.csv", "tables.md"} <= set(made)
    told = capsys.readouterr().out
    assert made["arms.md"].decode() in told
    rows = list(csv.DictReader((report / "driving.csv").open()))
    arms = ["ltf-real-steps", "ltf-more-steps", "ltf-redrawn1-steps", "ltf-logged1-steps", "ltf-pdm_closed1-steps"]
    assert list(dict.fromkeys(row["arm"] for row in rows)) == [*arms, "human", "pdm_closed", "constant_velocity"]
    counts = {row["data"]: (row["real"], row["simulated"]) for row in csv.DictReader((report / "trainings.csv").open())}
    assert counts == {
        "begin": ("1", "0"),
        "real": ("2", "0"),
        "more": ("3", "0"),
        **dict.fromkeys((REDRAWN, LOGGED, EXPERT), ("2", "1")),
    }
    assert main([*words, "minutes=0"]) == COMPLETE
    assert {path.name: path.read_bytes() for path in report.iterdir()} == made
