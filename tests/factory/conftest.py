"""A small town that several files of tests read: painted once for all of them and for all their processes."""

import os
from pathlib import Path

import pytest

from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings


@pytest.fixture(scope="session")
def small_town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One clip's log, with one small camera and a lidar. Nobody writes into it."""
    own = tmp_path_factory.getbasetemp()  # of this process; that of all processes of a session is above it
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    sensors = TownSettings(cameras=("ring_front_center",), width=64, height=36, lidar_beams=32, lidar_azimuths=300)
    reader = SyntheticReader(shared / "towns", 1, 0, sensors)
    reader.index()
    return reader.root
