"""One export of a few samples, for all tests that only look at it."""

from pathlib import Path

import pytest

from factory.datasets.navsim.export import ExportSummary, export
from factory.datasets.navsim.frames import ExportSettings
from factory.store.samples import Store
from tests.factory.datasets.navsim.navsim_samples import exported
from tests.planners.samples import write_table


@pytest.fixture(scope="session")
def street_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of six samples: a human one, two rounds of PDM-Closed, one of recovery; a row group each."""
    out = tmp_path_factory.mktemp("street") / "out"
    rows = [exported(0, "human"), exported(1, "pdm_closed", 0), exported(2, "pdm_closed", 1, split="val")]
    write_table(out, [*rows, exported(3, "recovery", 0)], group_rows=1)
    return out


@pytest.fixture(scope="session")
def openscene(street_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ExportSummary]:
    """All of it, exported."""
    to = tmp_path_factory.mktemp("openscene")
    return to, export(Store(street_run).samples, to, ExportSettings(), say=lambda line: None)
