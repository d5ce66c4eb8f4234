"""A planner may be told where to go by another rule than NAVSIM's: of the row's route, as AlpaSim would send it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from planners.data.batch import COMMANDS, Batch, BevLayout, Needs
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from planners.evaluation.planning import batch_samples, columns_to_read
from planners.models.planner import build_planner
from planners.models.settings import PlannerChoice
from planners.navsim.serve import AgentPlanner
from tests.planners.navsim.trained import saved
from tests.planners.samples import sample, write_table
from tests.tasks.world.test_commands import arc

ROWS = [sample(i, command="right", route_centerline=np.float32(arc(radius, 1.0))) for i, radius in enumerate((60, 300))]


def told(batch: Batch) -> list[str]:
    return [COMMANDS[int(one)] for one in batch.status[:, :4].argmax(dim=1)]


@pytest.mark.parametrize(
    ("rule", "commands"),
    [("navsim", ["right"] * 2), ("curvature", ["left", "straight"]), ("simscale", ["left"] * 2)],
)
def test_in_training_and_evaluation_the_command_is_that_of_the_rule(
    tmp_path: Path, rule: str, commands: list[str]
) -> None:
    needs = Needs(command=rule)  # type: ignore[arg-type]
    write_table(tmp_path, ROWS)
    loader = Loader(open_data(DataSettings(real=str(tmp_path))), needs, MixSettings(), 2, workers=1)
    batch = next(iter(loader.epoch(0)))
    order = np.argsort(batch.attempt_ids)
    assert [told(batch)[i] for i in order] == commands
    assert told(batch_samples(ROWS, needs)) == commands
    for asked in (needs, replace(needs, bev=BevLayout())):
        columns = columns_to_read(asked)
        assert len(columns) == len(set(columns))
        assert ("route_centerline" in columns) == (rule != "navsim" or asked.bev is not None)


def test_navsim_s_agent_gives_its_own_command_alone(tmp_path: Path) -> None:
    planner = build_planner(PlannerChoice("ego_mlp", {"hidden": [8], "command": "curvature"}), {})
    assert planner.needs.command == planner.needs_to_plan.command == "curvature"
    with pytest.raises(ConfigError, match="trained on commands by curvature, and NAVSIM gives its own"):
        AgentPlanner(saved(planner, tmp_path))
