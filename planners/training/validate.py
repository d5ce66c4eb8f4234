"""How near plans come to the human ones of clips that nothing is learned from: looked at while a planner is trained."""

from collections.abc import Callable
from dataclasses import replace

import torch

from planners.data.feed import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from planners.models.planner import Planner
from planners.training.processes import World

LARGEST_BATCH = 32


def validation(
    data: DataSettings, planner: Planner, world: World, workers: int
) -> Callable[[Planner], dict[str, float]]:
    """A function that plans for all human samples of the tables `data.val`: ade_m and fde_m, mean and final distance.

    Raises ValueError where the tables are not what the planner needs.
    """
    dataset = open_data(DataSettings(real=data.tables("val"), storage_options=data.storage_options, copy=data.copy))
    needs = replace(planner.needs, labels=None)
    size = max(n for n in range(1, LARGEST_BATCH + 1) if len(dataset) % n == 0)  # no sample is left out
    loader = Loader(dataset, needs, MixSettings(), size, workers=workers)

    def measure(trained: Planner) -> dict[str, float]:
        trained.eval()
        distances = []
        with torch.no_grad():
            for batch in loader.epoch(0):
                here = batch.to(world.device)
                plans = trained.plan(here)
                labels = here.plan_2hz if plans.shape[1] == here.plan_2hz.shape[1] else here.plan_10hz
                distances.append((plans[..., :2].float() - labels[..., :2]).norm(dim=-1).cpu())
        off = torch.cat(distances)
        return {"ade_m": float(off.mean()), "fde_m": float(off[:, -1].mean())}

    return measure
