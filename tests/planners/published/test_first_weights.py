"""Weights begin as the public agents draw theirs (see the records' origin).

`python -m experiments.parity <public checkout> --python <its interpreter> --what start --cases ltf diffusiondrive
gtrs_dense --record tests/planners/published/recorded` writes the records anew.
"""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from planners.models.planner import build_planner
from tests.planners.published.formula import inputs
from tests.planners.published.ours import preset
from tests.planners.published.start import Start, apart, our_start, read_start, start_kind

RECORDS = Path(__file__).parent / "recorded"
PICTURE = 256, 64
ARRAYS = {"anchors": inputs(*PICTURE)["anchors"], "vocabulary": inputs(*PICTURE)["vocabulary"]}


@pytest.mark.slow
@pytest.mark.parametrize("case", ["ltf", "diffusiondrive", "gtrs_dense"])
def test_weights_begin_as_the_public_agent_draws_them(case: str) -> None:
    public, of, origin = read_start(RECORDS / f"{case}_start.npz")
    assert of == case and "SimScale commit f51ad645" in origin
    assert apart(public, our_start(case, PICTURE, ARRAYS)) == []


@pytest.mark.slow
def test_as_torch_draws_them_they_begin_otherwise() -> None:
    public, _, _ = read_start(RECORDS / "diffusiondrive_start.npz")
    torch.manual_seed(1)
    ours = start_kind(build_planner(preset("diffusiondrive", PICTURE, "planner.settings.variant=paper"), ARRAYS))
    said = " ".join(apart(public, ours))
    for part in ("latent.layer1.0.bn2.weight", "exchanges.0.blocks.0.project.bias", "own.query.weight", "a copy of"):
        assert part in said, part


def test_draws_of_one_distribution_are_alike_and_of_another_are_told() -> None:
    torch.manual_seed(0)
    one, same, wider = (start_kind(nn.Linear(n, 64)) for n in (300, 300, 200))
    assert apart(one, same) == [] and one.twins == {}
    widened = replace(wider, spread={name: (m, d, one.spread[name][2]) for name, (m, d, _) in wider.spread.items()})
    assert [line.split(":")[0] for line in apart(one, widened)] == ["weight"]
    assert apart(one, Start({}, {})) == ["bias: only one side has it", "weight: only one side has it"]


def test_copies_are_told_by_the_first_and_constants_are_none() -> None:
    model = nn.ModuleList([nn.Linear(3, 3), nn.Linear(3, 3), nn.LayerNorm(3)])
    model[1].load_state_dict(model[0].state_dict())
    assert start_kind(model).twins == {"1.weight": "0.weight", "1.bias": "0.bias"}
