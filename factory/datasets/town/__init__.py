"""A seeded town written to disk in AV2 layout: test data and a first look, not training data."""

import tempfile
from pathlib import Path

from factory.datasets.town.settings import TownClips, TownsClips, TownSettings

READERS = {"SyntheticReader": TownClips, "SyntheticTownsReader": TownsClips}


def compile_kernels() -> None:
    """Writes the smallest log of a town into a folder that is thrown away."""
    from factory.datasets.town.town import write_town

    settings = TownSettings(cameras=("ring_front_center",), width=16, height=16, lidar_beams=1, lidar_azimuths=8)
    with tempfile.TemporaryDirectory() as folder:
        write_town(Path(folder), 1, 0, settings, threads=1)
