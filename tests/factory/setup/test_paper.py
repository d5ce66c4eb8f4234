"""A run says in what it differs from the paper's set-up; the preset in no setting, and yet in what none decides."""

from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import RunConfig, load_config
from factory.setup.calibrate import (
    differences_from_paper,
    paper_config,
    paper_deviations_line,
    plan_text,
)
from factory.setup.settings import assemble, choose_vocabulary
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return Vocabulary(kinematic_trajectories(16384, seed=0))


def paper(*overrides: str) -> RunConfig:
    return load_config(["preset=paper", "vocabulary.file=/mine.npy", *overrides])


def test_the_preset_has_the_paper_s_settings(vocabulary: Vocabulary) -> None:
    config = paper()
    assert differences_from_paper(config, vocabulary) == []
    assert (config.rounds, config.vocabulary.k, config.render.width, config.render.height) == (5, 16384, 1920, 1080)
    assert (config.render.psnr_min, config.render.camera_psnr_min) == (27.0, 0.0)
    assert (config.perturb.epdms_min, config.reward.progress_above) == (0.8, 0.5)


def test_the_preset_is_read_as_hydra_composes_it() -> None:
    assert paper_config() == load_config(["preset=paper", "vocabulary.file=given", "out=anywhere"])


@pytest.mark.parametrize(
    "more", ["", "reward.labels=none", "vocabulary.file=human.npy", "reward.label_vocabulary=human.npy"]
)
def test_labels_of_trajectories_that_nobody_drove_are_remarked(
    more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("human.npy", kinematic_trajectories(4, seed=1))
    street = ["clips=custom", "clips._target_=tests.factory.street_reader.StreetReader", "render=none"]
    run = assemble(load_config([*street, "experts=[human]", "vocabulary.k=4", *more.split()]))
    said = plan_text(run, run.refs).splitlines()
    told = [line for line in said if "learns little" in line and "give vocabulary.file=" in line]
    assert len(told) == (0 if more else 1), said


def test_the_defaults_differ_in_vocabulary_pictures_and_gates() -> None:
    config = load_config(["preset=none"])
    found = differences_from_paper(config, choose_vocabulary(config.vocabulary))
    assert found == [
        "vocabulary of 1,024 kinematic trajectories (16,384 human ones)",
        "expert.recovery.match=log (paper)",
        "traffic.yields=True (False)",
        "reward.off_route=True (False)",
        "reward.after=True (False)",
        "reward.near_log=True (False)",
        "render.frames=history (all)",
        "render.width=320 (1920)",
        "render.height=180 (1080)",
        "render.camera_psnr_min=20.0 (0.0)",
        "render.psnr_min=24.0 (27.0)",
        "render.gate.enabled=True (False)",
    ]
    said = paper_deviations_line(config, choose_vocabulary(config.vocabulary), {"recovery": 8192, "mine": 103_288})
    assert "\n" not in said and "expert.mine" not in said
    assert said.endswith("expert.recovery: 8,192 trajectories to retrieve (103,288, all of navtrain's)")


def test_every_setting_of_the_paper_s_table_is_watched(vocabulary: Vocabulary) -> None:
    others = {
        "perturb.epdms_min=0.5": "perturb.epdms_min=0.5 (0.8)",
        "perturb.max_longitudinal_m=8": "perturb.max_longitudinal_m=8.0 (20.0)",
        "reward.off_route=true": "reward.off_route=True (False)",
        "reward.progress_above=-1": "reward.progress_above=-1.0 (0.5)",
        "traffic=replay": "traffic.mode=replay (idm)",
        "render.frames=now": "render.frames=now (all)",
    }
    assert set(others.values()) <= set(differences_from_paper(paper(*others), vocabulary))


def test_the_preset_asks_for_the_human_vocabulary(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"vocabulary: file is missing: give vocabulary\.file="):
        load_config(["preset=paper"])
    np.save(tmp_path / "few.npy", kinematic_trajectories(100, seed=0))
    with pytest.raises(ValueError, match="first 16384 of 100"):
        choose_vocabulary(paper(f"vocabulary.file={tmp_path / 'few.npy'}").vocabulary)
