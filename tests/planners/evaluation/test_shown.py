"""What an evaluated planner gets is what it was trained on, for all that is known at now."""

from pathlib import Path

import numpy as np
import pytest
import torch

from factory.store.reader import SampleTable
from planners.data.batch import BevLayout, ImageLayout, Needs
from planners.data.index import DataSettings, open_dataset
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from planners.evaluation.planning import batch_samples, columns_to_read, without_future
from tests.planners.samples import grey_pictures, sample, write_table

NEEDS = Needs(image=ImageLayout(width=48, height=12), bev=BevLayout(cell_m=1.0), n_agents=3)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = [sample(i, **grey_pictures(20 * i)) for i in range(4)]
    rows += [sample(i, "pdm_closed", **grey_pictures(20 * i)) for i in range(4, 8)]
    for row in rows:
        row["agent_kinds"] = ["VEHICLE"] * len(row["agent_kinds"])
        row["agent_boxes"] = np.nan_to_num(row["agent_boxes"], nan=2.0)
    out = tmp_path_factory.mktemp("samples")
    write_table(out, rows)
    return out


def test_a_batch_is_the_loaders_but_for_the_plans(table: Path) -> None:
    dataset = open_dataset(DataSettings(real=str(table), sim=str(table)))
    (loaded,) = Loader(dataset, NEEDS, MixSettings(), batch_size=8, workers=1).epoch(0)
    rows = SampleTable(table)
    shown = batch_samples(
        [without_future(rows.sample(name, columns_to_read(NEEDS))) for name in loaded.attempt_ids], NEEDS
    )
    assert shown.attempt_ids == loaded.attempt_ids
    for name in ("status", "history", "image", "bev", "agents", "agents_valid", "simulated"):
        mine, theirs = getattr(shown, name), getattr(loaded, name)
        assert mine.dtype == theirs.dtype and torch.equal(mine, theirs), name
    assert loaded.plan_2hz.any() and not shown.plan_2hz.any() and not shown.imitate.any()


def test_only_what_is_needed_is_read() -> None:
    small = columns_to_read(Needs())
    assert "images" not in small and "agent_boxes" not in small
    assert set(columns_to_read(NEEDS)) > {"images", "cameras", "agent_boxes", *small}
    everything = columns_to_read(None)
    assert "images" in everything and not {"stage2_score", "label_subscores"} & set(everything)


def test_a_sample_without_its_picture_is_named(table: Path) -> None:
    row = dict(SampleTable(table)[0])
    row["images"] = None
    with pytest.raises(ValueError, match=r"sample attempt00000: no image of camera"):
        batch_samples([row], NEEDS)
