"""Our half of a comparison of the weights that trainings begin with: how each array is spread, and which are twins.

Generators and the order of drawing differ, so that numbers cannot be equal; a backbone that the public code always
reads from a file (V2-99) is left out.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from planners.models.planner import build_planner
from tasks.world.arrays import Array
from tests.planners.published.ours import preset

ALWAYS_READ = "tokens.backbone."  # V2-99's
DEVIATIONS = 6.0  # that two draws of one distribution may be apart


@dataclass(frozen=True)
class Start:
    """How a planner's weights are spread before a training."""

    spread: Mapping[str, tuple[float, float, int]]  # parameter -> mean, deviation, numbers
    twins: Mapping[str, str]  # parameter -> the first with the same numbers, of which it is a copy


def start_kind(planner: nn.Module) -> Start:
    """Of a planner as it was built."""
    spread, first, twins = {}, dict[bytes, str](), {}
    for name, parameter in planner.named_parameters():
        if name.startswith(ALWAYS_READ):
            continue
        values = parameter.detach().double()
        deviation = float(values.std(unbiased=False))
        spread[name] = float(values.mean()), deviation, values.numel()
        if deviation > 0.0:
            twin = first.setdefault(parameter.detach().numpy().tobytes(), name)
            if twin != name:
                twins[name] = twin
    return Start(spread, twins)


def our_start(case: str, picture: tuple[int, int], arrays: Mapping[str, Array]) -> Start:
    """Of the planner of conf/planner/<case>_public.yaml."""
    torch.manual_seed(1)
    return start_kind(build_planner(preset(case, picture), arrays))


def apart(public: Start, ours: Start) -> list[str]:
    """What is spread otherwise, in a sentence each."""
    said = [f"{name}: only one side has it" for name in sorted(public.spread.keys() ^ ours.spread.keys())]
    for name in public.spread.keys() & ours.spread.keys():
        (mean, deviation, n), (our_mean, our_deviation, _) = public.spread[name], ours.spread[name]
        share = DEVIATIONS / math.sqrt(n)
        size = max(deviation, our_deviation)
        alike = abs(mean - our_mean) <= 1.5 * share * size + 1e-6
        if n == 1 and mean and our_mean:  # one number that is drawn has no deviation
            alike = alike or max(abs(mean), abs(our_mean)) < 1.0
        if not alike or abs(deviation - our_deviation) > share * size:
            said.append(f"{name}: {mean:.3g} +- {deviation:.3g} there, {our_mean:.3g} +- {our_deviation:.3g} here")
        if public.twins.get(name) != ours.twins.get(name):
            said.append(f"{name}: a copy of {public.twins.get(name)} there, of {ours.twins.get(name)} here")
    return sorted(said)


def read_start(path: Path) -> tuple[Start, str, str]:
    """A start, its case and its origin."""
    with np.load(path, allow_pickle=False) as stored:
        told, spread = json.loads(str(stored["told"])), stored["spread"].tolist()
    spreads = {name: (mean, deviation, int(n)) for name, (mean, deviation, n) in zip(told["names"], spread)}
    return Start(spreads, told["twins"]), told["case"], told["origin"]
