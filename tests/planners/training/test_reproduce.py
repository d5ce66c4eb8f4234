"""The trainings of docs/reproduce.md run as the page has them, but of small planners on a small table.

That every other command of the page is one its program takes is tests/test_readme.py's; checkpoints are imported in
tests/planners/published, navhard and navtest evaluated by name in tests/planners/evaluation.
"""

from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import compose, fill
from planners.models.ltf import LtfSettings
from planners.models.planner import settings_of
from planners.training.checkpoint import load_planner, newest, read_record
from planners.training.train import PlannerEntry, main
from tests.pages import commands
from tests.planners.samples import grey_pictures, sample, write_table

TRAININGS = [list(one.words) for one in commands("docs/reproduce.md") if "train" in one.words]
BY_LABELS = [words for words in TRAININGS if not any(word.startswith("planner.settings.vocabulary=") for word in words)]


def test_the_page_trains_the_published_families() -> None:
    chosen = {word for words in TRAININGS for word in words if word.startswith("planner=")}
    assert chosen == {"planner=ltf_public", "planner=diffusiondrive_public", "planner=gtrs_dense_public"}
    entry = fill(PlannerEntry, compose("train", ["planner=ltf_public"])["planner"], "planner")
    settings = settings_of(entry)
    assert isinstance(settings, LtfSettings) and settings.image.decoding == "full"


@pytest.mark.slow
@pytest.mark.parametrize("words", BY_LABELS, ids=[words[6] for words in BY_LABELS])
def test_a_training_of_the_page_runs_and_keeps_its_pictures(words: list[str], tmp_path: Path) -> None:
    table, kept, out = tmp_path / "table", tmp_path / "pictures", tmp_path / "out"
    rows = [sample(i, "pdm_closed" if i > 11 else "human", **grey_pictures(5 * i)) for i in range(36)]
    for i, row in enumerate(rows):  # no plan is another's, so that anchors can be made of them
        row["label_2hz"] = np.linspace((0.5 + i, 0.0, 0.0), (4.0 + 8.0 * i, i / 10.0, 0.0), 8, dtype=np.float32)
        row["agent_kinds"] = ["VEHICLE"] * len(row["agent_kinds"])
        row["agent_valid"] = np.zeros_like(row["agent_valid"])  # nobody is there
    write_table(table, rows, group_rows=6)
    own = {
        "planner": next(word for word in words if word.startswith("planner=")).replace("_public", "_small")[8:],
        "data.real": f"[{table}]",
        "data.sim": f"[{table}]",
        "data.pictures": str(kept),
        "workers": "2",
        "out": str(out),
    }
    assert words[:6] == ["torchrun", "--nproc-per-node", "8", "-m", "planners", "train"]
    given = dict(word.split("=", 1) for word in words[6:])
    assert given.keys() >= own.keys()
    small = ["planner.settings.image.decoding=full", "planner.training.batch_size=6", "steps=2"]
    assert main([*(f"{name}={value}" for name, value in {**given, **own}.items()), *small]) == 0
    assert read_record(out)["step"] == 2
    assert load_planner(newest(out)).needs.image is not None
    assert 12 <= len(list(kept.rglob("*.rgb"))) <= 36, "two batches, and those that were decoded ahead"
