"""The mean of several scorers."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from factory.config.compose import ConfigError
from planners.data.batch import ImageLayout
from planners.evaluation.planner_names import find_planner
from planners.models.gtrs_dense import Ensemble, average_scores
from planners.training.checkpoint import load_planner, save_checkpoint
from tests.planners.models.test_gtrs_dense import TINY, labelled, planner
from tests.planners.toy import Toy, ToySettings


def test_scores_are_averaged_as_probabilities_before_they_are_weighted() -> None:
    batch, _ = labelled(4)
    models = [planner(seed=seed).eval() for seed in range(3)]
    together = Ensemble([(str(i), model) for i, model in enumerate(models)])
    each = [model.scores(batch) for model in models]
    scores = together.scores(batch)
    torch.testing.assert_close(scores["ep"], (each[0]["ep"] + each[1]["ep"] + each[2]["ep"]) / 3)
    torch.testing.assert_close(scores["imitation"].sum(dim=1), torch.ones(4))
    assert torch.equal(together.plan(batch), models[0].choices[models[0].choose(average_scores(each))])


def test_members_that_have_nothing_to_average_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="one model at least"):
        Ensemble([])
    with pytest.raises(ValueError, match=r"b\.pt chooses from vocabulary .* and a\.pt from"):
        Ensemble([("a.pt", planner()), ("b.pt", planner(k=12))])
    with pytest.raises(ValueError, match=r"b\.pt sees .*width=96.* and a\.pt sees .*width=64"):
        Ensemble([("a.pt", planner()), ("b.pt", planner(replace(TINY, image=ImageLayout(width=96, height=32))))])


def saved(out: Path, seed: int) -> str:
    model = planner(replace(TINY, variant="small", sizes=None), seed=seed)
    save_checkpoint(out, 1, model, {}, {"version": 1})
    return str(out)


def test_trainings_joined_by_plus_are_evaluated_as_their_ensemble(tmp_path: Path) -> None:
    batch, _ = labelled(4)
    a, b = saved(tmp_path / "a", 0), saved(tmp_path / "b", 1)
    both = find_planner(f"{a}+{b}", "both")
    assert len({both.digest, find_planner(a).digest, find_planner(b).digest}) == 3
    made = both.load()
    assert torch.equal(made.plan(batch), Ensemble([("a", load_planner(a)), ("b", load_planner(b))]).plan(batch))


def test_only_settings_of_planning_change_after_training(tmp_path: Path) -> None:
    a = saved(tmp_path / "a", 0)
    few = find_planner(a, "few", {"inference_entries": 3})
    assert few.digest != find_planner(a).digest
    assert len(few.load().choices) == 3
    with pytest.raises(ConfigError, match="encoder of gtrs_dense cannot change after training; free: inf"):
        load_planner(a, {"encoder": "fused"})


def test_an_ensemble_of_planners_without_scores_is_refused(tmp_path: Path) -> None:
    torch.manual_seed(0)
    save_checkpoint(tmp_path / "toy", 1, Toy(ToySettings(), {}), {}, {"version": 1})
    with pytest.raises(ConfigError, match=r"averages the scores of gtrs_dense models, not .*toy"):
        find_planner(f"{saved(tmp_path / 'a', 0)}+{tmp_path / 'toy'}").load()
