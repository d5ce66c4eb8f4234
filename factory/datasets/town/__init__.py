"""A seeded town written to disk in AV2 layout: test data and a first look, not training data."""

from factory.datasets.town.settings import TownClips, TownsClips

READERS = {"SyntheticReader": TownClips, "SyntheticTownsReader": TownsClips}
KERNELS = {"town": "factory.datasets.town.town:paint_smallest"}
