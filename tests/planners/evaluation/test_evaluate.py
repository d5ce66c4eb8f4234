"""A command's whole way on two streets: who may be evaluated, what is written, what is done again, what is refused."""

import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from factory.config.compose import ConfigError
from planners.data.batch import Batch, BevLayout, ImageLayout, Needs
from planners.evaluation.aggregation import SummaryLine, group_by_clip
from planners.evaluation.benchmark_folder import MADE_BY
from planners.evaluation.evaluate import EvaluateSettings, evaluate, main, settings_of, what_decides
from planners.evaluation.frames import FrameKey
from planners.evaluation.planner_names import EvaluatedPlanner, find_planner, find_planners
from planners.evaluation.planning import all_plans, plan_samples, without_future
from planners.evaluation.score_rows import read_record, read_rows
from planners.training.checkpoint import save_checkpoint
from tasks.reward.aggregate import COLUMNS
from tests.planners.made_rows import clip_rows
from tests.planners.small_benchmark import StreetBenchmark, straight
from tests.planners.toy import Toy, ToySettings

SCORE = COLUMNS.index("score")


class Steady:
    """By sample: goes on as fast as it drives."""

    planned: ClassVar[int] = 0

    def plan(self, sample: Mapping[str, Any]) -> np.ndarray:
        Steady.planned += 1
        return straight(float(sample["ego_status"][0]))[4::5]


class SteadyBatch:
    """By batch: the same."""

    needs = Needs()
    digest = "steady"

    def plan(self, batch: Batch) -> Tensor:
        time_s = torch.arange(1, 9) * 0.5
        along = batch.status[:, 4:5] * time_s
        return torch.stack([along, torch.zeros_like(along), torch.zeros_like(along)], dim=-1)


class Seeing(SteadyBatch):
    """Needs pictures."""

    needs = Needs(image=ImageLayout())


class FromAbove(SteadyBatch):
    """Sees a raster and the nearest vehicle, and stops where one is near."""

    needs = Needs(bev=BevLayout(cell_m=1.0), n_agents=1)

    def plan(self, batch: Batch) -> Tensor:
        assert batch.bev is not None and batch.agents is not None and batch.agents_valid is not None
        assert batch.bev.shape == (len(batch), 1, 32, 64) and batch.bev.any()
        near = batch.agents_valid[:, 0] & (batch.agents[:, 0, 0] < 20.0)
        return super().plan(batch) * (~near)[:, None, None]


class Racing:
    """Ends 80 m ahead, where no follow-up starts."""

    def plan(self, sample: Mapping[str, Any]) -> np.ndarray:
        return straight(20.0)


class Dazed:
    """Plans nothing that could be driven."""

    def plan(self, sample: Mapping[str, Any]) -> np.ndarray:
        return np.full((8, 3), np.nan)


def settings(out: Path) -> EvaluateSettings:
    return EvaluateSettings(benchmark="streets", out=str(out), batch_size=5)


@pytest.fixture(scope="module")
def benchmark() -> StreetBenchmark:
    return StreetBenchmark()


def named(*specs: str) -> list[EvaluatedPlanner]:
    return find_planners(None, specs, bounds=False)


def test_both_faces_of_a_planner_and_the_bounds_are_scored_in_one_table(
    benchmark: StreetBenchmark, tmp_path: Path
) -> None:
    who = named("human", "pdm_closed", "test_evaluate:Steady", "test_evaluate:SteadyBatch")
    lines = evaluate(benchmark, who, settings(tmp_path))
    by = {(line.planner, line.stage, line.human_filter): line for line in lines}
    sample, batch = (by[f"test_evaluate.{name}", "final", "filtered"].columns for name in ("Steady", "SteadyBatch"))
    np.testing.assert_allclose(sample, batch, atol=1e-6)
    # a steady street: the human drives 8 m/s too, and nothing touches him
    assert by["human", "one_stage", "unfiltered"].columns[SCORE] > 0.9
    assert np.isnan(by["human", "final", "filtered"].columns).all()
    assert by["pdm_closed", "final", "filtered"].columns[SCORE] > 0.3
    table = list(csv.DictReader((tmp_path / "summary.csv").open()))
    assert len(table) == len(lines) == 4 * 8
    assert (table[6]["stage"], table[6]["score"]) == ("final", "")  # of the human
    rows = read_rows(tmp_path / "test_evaluate.Steady")
    assert len(rows) == 2 * (1 + 2 + 4)


def test_a_planner_that_is_done_is_left_until_it_changes(benchmark: StreetBenchmark, tmp_path: Path) -> None:
    Steady.planned = 0
    who = named("test_evaluate:Steady")
    first = evaluate(benchmark, who, settings(tmp_path))
    assert Steady.planned == len(benchmark.keys) == 12
    asked = benchmark.asked
    again = evaluate(benchmark, who, settings(tmp_path))
    assert Steady.planned == 12 and benchmark.asked == asked
    for a, b in zip(first, again):
        np.testing.assert_array_equal(a.columns, b.columns)
    # other rules: scored again from the same plans
    evaluate(benchmark, who, replace(settings(tmp_path), one_stage_traffic=settings(tmp_path).two_stage_traffic))
    assert Steady.planned == 12 and benchmark.asked > asked
    evaluate(benchmark, [replace(who[0], digest="other")], settings(tmp_path))
    assert Steady.planned == 24
    evaluate(StreetBenchmark(("a",)), [replace(who[0], digest="other")], settings(tmp_path))  # other clips
    assert Steady.planned == 30


def test_a_checkpoint_is_scored_again_when_its_weights_changed(benchmark: StreetBenchmark, tmp_path: Path) -> None:
    training, out = tmp_path / "training", tmp_path / "out"

    def scored(step: int, weight: float) -> tuple[list[SummaryLine], str]:
        toy = Toy(ToySettings(), {})
        for parameter in toy.parameters():
            torch.nn.init.constant_(parameter, weight)
        save_checkpoint(training, step, toy, {}, {})
        lines = evaluate(benchmark, [find_planner(str(training), "toy")], settings(out))
        return lines, read_record(out / "toy")["planner_digest"]

    first, digest = scored(1, 0.0)  # it stands where it is
    same, same_digest = scored(2, 0.0)
    other, other_digest = scored(3, 0.1)
    assert digest == same_digest != other_digest
    for line, again, moved in zip(first, same, other):
        np.testing.assert_array_equal(line.columns, again.columns)
        assert line.stage == moved.stage
    assert any((line.columns != moved.columns).any() for line, moved in zip(first, other))


def test_a_kill_while_scoring_keeps_the_plans(
    benchmark: StreetBenchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Steady.planned = 0
    who = named("test_evaluate:Steady")
    with monkeypatch.context() as patch:
        patch.setattr("planners.evaluation.evaluate.score_clip", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            evaluate(benchmark, who, settings(tmp_path))
    assert not (tmp_path / "test_evaluate.Steady" / "record.json").exists()
    killed = evaluate(benchmark, who, settings(tmp_path))
    assert Steady.planned == 12
    for a, b in zip(killed, evaluate(benchmark, who, settings(tmp_path / "whole"))):
        np.testing.assert_array_equal(a.columns, b.columns)


@pytest.mark.parametrize(("at_once", "batch_size"), [(1, 5), (2, 3), (8, 100)])
def test_planners_plan_the_same_alone_and_together(
    benchmark: StreetBenchmark, tmp_path: Path, at_once: int, batch_size: int
) -> None:
    who = named("test_evaluate:Steady", "test_evaluate:SteadyBatch", "test_evaluate:FromAbove")
    planning = [(one, tmp_path, {"who": one.label}) for one in who]
    found = all_plans(benchmark, benchmark.keys, planning, batch_size, at_once, "cpu")
    assert list(found) == [one.label for one in who]
    steady, batch, above = (found[one.label] for one in who)
    for key in benchmark.keys:
        np.testing.assert_allclose(steady[key], batch[key], atol=1e-5)
    # the car ahead is 30 m away; follow-ups came nearer to it where they drove faster than it, and none did
    assert all((above[key] == batch[key]).all() for key in benchmark.keys)


def test_rows_of_other_rules_never_stand_under_an_older_record(
    benchmark: StreetBenchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    who, first = named("test_evaluate:Steady"), settings(tmp_path)
    expected = evaluate(benchmark, who, first)
    with monkeypatch.context() as patch:
        patch.setattr("planners.evaluation.evaluate.write_record", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            evaluate(benchmark, who, replace(first, two_stage_traffic=first.one_stage_traffic))
    for a, b in zip(expected, evaluate(benchmark, who, first)):
        np.testing.assert_array_equal(a.columns, b.columns)


def test_planners_of_the_same_benchmark_and_rules_stay_in_the_table(benchmark: StreetBenchmark, tmp_path: Path) -> None:
    other = replace(settings(tmp_path), two_stage_traffic=settings(tmp_path).one_stage_traffic)
    evaluate(benchmark, named("test_evaluate:Racing"), other)
    for spec in ("test_evaluate:SteadyBatch", "constant_velocity", "test_evaluate:Steady"):
        lines = evaluate(benchmark, named(spec), settings(tmp_path))
    labels = ["constant_velocity", "test_evaluate.SteadyBatch", "test_evaluate.Steady"]
    assert list(dict.fromkeys(line.planner for line in lines)) == labels
    with (tmp_path / "summary.csv").open() as file:
        assert list(dict.fromkeys(line["planner"] for line in csv.DictReader(file))) == labels
    alone = evaluate(benchmark, named("test_evaluate:Steady"), replace(settings(tmp_path), tables=False))
    assert {line.planner for line in alone} == {"test_evaluate.Steady"}


def test_it_is_said_what_a_score_rests_on_and_which_difference_means_nothing() -> None:
    """Three towns of a clip; follow-ups now at 0 and 0.5 m from the plan's end, before at 9 m, where both weigh alike.

    Weights now 0.777300 and 0.222700, so that 1 / (0.777300^2 + 0.222700^2) = 1.53 of them count.
    """

    def planner(*final: float) -> list[Any]:
        after = [((1.0, 1.0), (10.0, 0.0), (19.0, 0.0)), ((1.0, 1.0), (10.0, 0.5), (19.0, 0.0))]
        made = [
            clip_rows(f"{n}", 0.0, (score, score), ((10.0, 0.0), (10.0, 0.0)), after, f"town-{n}-0000-a")
            for n, score in enumerate(final)
        ]
        return group_by_clip([row for rows in made for row in rows])

    real, better = planner(0.2, 0.4, 0.6), planner(0.3, 0.5, 0.7)
    told = what_decides({"constant_velocity": planner(0.1, 0.5, 0.7), "real": real, "better": better})
    assert told[0] == "final (unfiltered), decided by 3 clips of 3 logs of 3 towns; 95 % intervals over towns:"
    # Student's t of two degrees of freedom, 4.303 standard errors of 11.547, no further than the scores: 20 to 60
    assert told[2].startswith("  real: 40.0 (20.0 to 60.0), stage two on 5 of 12 follow-ups; 3 of 6 plans end beyond")
    against = "  real against constant_velocity: -3.3 (-50.0 to +50.0), by 3 clips: no difference told from zero"
    assert told[4] == against  # of three the wild bootstrap refuses nothing
    assert told[5] == "  better against real: +10.0 (+10.0 to +10.0), by 3 clips"
    assert what_decides({"alone": planner(0.5)})[1].startswith("  alone: 50.0 (no interval)")


def test_a_record_says_what_was_evaluated(benchmark: StreetBenchmark, tmp_path: Path) -> None:
    evaluate(benchmark, named("human"), settings(tmp_path))
    record = read_record(tmp_path / "human")
    assert (record["planner_digest"], record["benchmark_digest"], record["clips"]) == ("human", "street", 2)
    assert record["rules"]["one_stage"]["mode"] == "replay" and record["rules"]["two_stage"]["mode"] == "idm"
    assert json.loads((tmp_path / "human" / "record.json").read_text()) == record


def test_a_planner_sees_nothing_that_comes_after_now(benchmark: StreetBenchmark) -> None:
    for key in (benchmark.keys[0], FrameKey.follow_up("a", 0)[0]):
        sample = benchmark.sample(key)
        shown = without_future(sample)
        assert not shown["label_10hz"].any() and sample["label_10hz"].any()
        assert np.isnan(shown["agent_boxes"][:, 16:]).all() and not shown["agent_valid"][:, 16:].any()
        np.testing.assert_array_equal(shown["agent_boxes"][:, :16], sample["agent_boxes"][:, :16])
        assert "stage2_score" not in shown and not shown["light_states"][:, 16:].any()
        for name in ("ego_history_10hz", "ego_status", "command", "route_centerline", "lane_polygons"):
            assert shown[name] is sample[name]
    assert np.isnan(without_future(benchmark.sample(benchmark.keys[0]))["parent_states"][1]).all()


def test_a_planner_that_needs_images_is_refused_by_name_before_any_plans(
    benchmark: StreetBenchmark, tmp_path: Path
) -> None:
    Steady.planned = 0
    with pytest.raises(ConfigError, match=r"test_evaluate.Seeing needs images, and 12 of 12 .* clip a, frame h"):
        evaluate(benchmark, named("test_evaluate:Steady", "test_evaluate:Seeing"), settings(tmp_path))
    assert Steady.planned == 0


def test_a_plan_that_is_none_is_refused_with_planner_and_sample(benchmark: StreetBenchmark, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"planner test_evaluate.Dazed: sample b-follow_up_before-1: a plan must be"):
        evaluate(benchmark, named("test_evaluate:Dazed"), settings(tmp_path))


def test_a_batch_planner_must_answer_for_every_sample(benchmark: StreetBenchmark) -> None:
    class Short(SteadyBatch):
        def plan(self, batch: Batch) -> Tensor:
            return super().plan(batch)[:-1]

    with pytest.raises(ValueError, match=r"batch of 3 returned \(2, 8, 3\)"):
        plan_samples(Short(), [benchmark.sample(key) for key in benchmark.keys[:3]])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("runs/nowhere", "neither a folder nor one of human, pdm_closed"),
        ("ltf", "has to be trained first"),
        ("no_such_module:Planner", "there is no module no_such_module"),
        ("test_evaluate:NoSuchClass", "NoSuchClass"),
        ("test_evaluate:SCORE", "is a int: name a class"),
        ("test_evaluate:settings", "without arguments"),
        ("pathlib:Path", "has no method plan"),
    ],
)
def test_nobody_is_evaluated_under_a_name_that_means_nobody(spec: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        find_planner(spec)


def test_a_folder_without_a_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no checkpoint"):
        find_planner(str(tmp_path))


def test_labels_are_unique_and_bounds_come_once() -> None:
    with pytest.raises(ConfigError, match="planner is missing"):
        find_planners(None, [], bounds=True)
    found = find_planners(None, {"mine": "test_evaluate:Steady", "yours": "test_evaluate:Steady"}, bounds=False)
    assert [one.label for one in found] == ["mine", "yours"]
    with pytest.raises(ConfigError, match="two are called"):
        find_planners("test_evaluate:Steady", {"test_evaluate.Steady": "human"}, bounds=False)
    assert [one.label for one in find_planners("human", ["human"], bounds=False)] == ["human"]


def test_the_command_line_is_typed_and_complains_by_name(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert settings_of(["benchmark=x"]) == EvaluateSettings(benchmark="x", out="evaluations")
    assert settings_of(["benchmark=x", "planners={a: runs/a}"]).planners == {"a": "runs/a"}
    assert settings_of(["benchmark=x", "planners=[runs/a]", "planner=a:B"]).planner == "a:B"
    assert settings_of(["benchmark=navhard"]).two_stage_traffic.mode == "navsim"
    assert settings_of(["benchmark=navhard", "traffic@two_stage_traffic=idm"]).two_stage_traffic.mode == "idm"
    for argv, message in (
        (["planner=human"], f"benchmark is missing: give benchmark=runs/hard; make it, to its end: {MADE_BY}"),
        (["planner=human", "benchmrak=x"], "did you mean benchmark="),
        ([f"benchmark={tmp_path}", "planer=human"], "planer"),
        ([f"benchmark={tmp_path}", "planner=human", "batch_size=0"], "batch_size"),
        ([f"benchmark={tmp_path}", "planner=human"], str(tmp_path)),
    ):
        assert main(argv) == 2
        assert message in capsys.readouterr().err
    assert main(["--help"]) == 0 and "one_stage_traffic" in capsys.readouterr().out
