"""The files of conf/planner that come with the planners say what the code and the paper say."""

from dataclasses import replace
from typing import Any

import pytest
import yaml

from factory.config.compose import conf_dir, fill
from planners.models.settings import (
    BackboneSettings,
    DiffusionDriveSettings,
    EgoMlpBevSettings,
    EgoMlpSettings,
    GtrsDenseSettings,
    LtfSettings,
    PlannerChoice,
    settings_of,
)
from planners.training.optim import TrainingSettings

NAMES = ("constant_velocity", "ego_mlp", "ego_mlp_small", "ego_mlp_bev", "ego_mlp_bev_small", "ltf", "ltf_small")
NAMES += ("diffusiondrive", "diffusiondrive_small", "gtrs_dense", "gtrs_dense_v2_99", "gtrs_dense_small")


def read(name: str) -> dict[str, Any]:
    content = yaml.safe_load((conf_dir() / "planner" / f"{name}.yaml").read_text())
    assert isinstance(content, dict)
    return content


def choice(name: str) -> PlannerChoice:
    content = read(name)
    return PlannerChoice(content["name"], content.get("settings", {}))


@pytest.mark.parametrize("name", [*NAMES, "ltf_public"])
def test_every_file_fills_its_planner(name: str) -> None:
    settings_of(choice(name))
    if name != "constant_velocity":
        fill(TrainingSettings, read(name)["training"], "training")


def test_the_unmarked_files_are_the_defaults() -> None:
    defaults = {"ltf": LtfSettings(), "ego_mlp": EgoMlpSettings(), "ego_mlp_bev": EgoMlpBevSettings()}
    for name, expected in defaults.items():
        assert settings_of(choice(name)) == expected and "settings" not in read(name)
    assert settings_of(choice("diffusiondrive")) == DiffusionDriveSettings()
    for name in ("gtrs_dense", "gtrs_dense_v2_99"):
        assert replace(settings_of(choice(name)), encoder="fused") == GtrsDenseSettings()


# WarmupCosLR of the public agents steps where an epoch ends (Lightning's default): warm-up over 3, then a cosine to
# min_lr. OpenDriveLab/SimScale @ f51ad64, navsim/agents/{diffusiondrive/transfuser_agent,gtrs_dense/gtrs_agent}.py.
BY_EPOCH: dict[str, Any] = {"optimiser": "adamw", "schedule": "cosine", "warmup_epochs": 3, "by_epoch": True}
GTRS_TRAINING = TrainingSettings(50, 352, 4e-4, **BY_EPOCH, lowest_rate=1e-8, backbone_decay=0.0)
PUBLIC_TRAININGS = {
    "ltf": TrainingSettings(100, 512, 2.83e-4),  # Adam at one rate; epochs, batch and rate are the paper's
    "diffusiondrive": TrainingSettings(100, 512, 6e-4, **BY_EPOCH, lowest_rate=1e-6, weight_decay=1e-4),
    "gtrs_dense": GTRS_TRAINING,
    "gtrs_dense_v2_99": GTRS_TRAINING,
}


@pytest.mark.parametrize("name", PUBLIC_TRAININGS)
def test_public_planners_train_as_the_public_agents_set_their_optimisers(name: str) -> None:
    assert fill(TrainingSettings, read(f"{name}_public")["training"], "training") == PUBLIC_TRAININGS[name]
    assert settings_of(choice(f"{name}_public")).is_public
    paper = fill(TrainingSettings, read(name)["training"], "training")
    public = PUBLIC_TRAININGS[name]
    assert (paper.epochs, paper.batch_size, paper.learning_rate) == (
        public.epochs,
        public.batch_size,
        public.learning_rate,
    )


def test_ltf_small_is_narrow_and_not_another_planner() -> None:
    small = settings_of(choice("ltf_small"))
    assert small.fusion.backbone == BackboneSettings(name="small")
    assert small.network.layers > 1 and small.network.agents > 0 and small.bev_weight > 0.0
