"""Checkpoints of freshly made planners, one of each family, as their small files of conf/planner have them."""

from pathlib import Path

import numpy as np
import torch
import yaml

from factory.config.compose import conf_dir
from planners.models.planner import Planner, build_planner
from planners.models.settings import PlannerChoice
from planners.training.checkpoint import save_checkpoint
from tasks.world.arrays import FloatArray
from tests.planners import scenes

FAMILIES = ("ego_mlp_small", "ltf_small", "diffusiondrive_small", "gtrs_dense_small")


def made(name: str, command: str = "navsim", **image: object) -> Planner:
    """The planner of conf/planner/<name>.yaml with random weights, so that no two inputs are planned alike."""
    content = yaml.safe_load((conf_dir() / "planner" / f"{name}.yaml").read_text())
    settings = content.get("settings", {}) | ({} if command == "navsim" else {"command": command})
    if image:
        settings["image"] = settings["image"] | image
    trajectories = scenes.vocabulary(64)
    arrays: dict[str, dict[str, FloatArray]] = {
        "gtrs_dense": {"vocabulary": trajectories},
        "diffusiondrive": {"anchors": np.asarray(trajectories[:20, 4::5, :2], np.float32)},
    }
    torch.manual_seed(3)
    planner = build_planner(PlannerChoice(content["name"], settings), arrays.get(content["name"], {}))
    with torch.no_grad():  # heads that begin at zero plan the same whatever they see
        for parameter in planner.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return planner.eval()


def saved(planner: Planner, out: Path) -> str:
    """A training's folder with this planner as its only checkpoint."""
    save_checkpoint(out, 1, planner, {}, {})
    return str(out)
