"""The town as one object, and its logs' plans: pure functions of the seed, nothing is written here."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from factory.readers.settings import LOG_STEPS, LOGS_PER_TOWN
from factory.readers.town.drive import TownDrive, parked_cars, plan_drive
from factory.readers.town.ego import SCENARIOS
from factory.readers.town.plan import build_streets
from factory.readers.town.scenery import Scenery, build_scenery
from factory.readers.town.streets import Streets
from factory.readers.town.traffic import TownTrack

WINDOWS_PER_LOG = 3  # of 9.5 s at stride 1 s


@dataclass(frozen=True)
class Town:
    """Streets, what is parked there, what it looks like, and its weather."""

    seed: int
    number: int
    streets: Streets
    parked: tuple[TownTrack, ...]
    sun_azimuth: float
    sun_elevation: float
    sky_seed: int

    @property
    def name(self) -> str:
        """As the files of its map say it."""
        return f"SYN{self.number:02d}"

    @cached_property
    def scenery(self) -> Scenery:
        """Houses, trees, road marks: seconds to build, so logs that nobody sees go without."""
        return build_scenery(self.streets, np.random.default_rng([self.seed, self.number, 2]))


@lru_cache(maxsize=1)
def build_town(seed: int, number: int) -> Town:
    """Town `number` of a seed."""
    streets = build_streets(np.random.default_rng([seed, number, 0]))
    parked = parked_cars(streets, np.random.default_rng([seed, number, 1]))
    rng = np.random.default_rng([seed, number, 3])
    return Town(
        seed,
        number,
        streets,
        parked,
        float(rng.uniform(-np.pi, np.pi)),
        float(np.deg2rad(rng.uniform(35.0, 55.0))),
        int(rng.integers(1 << 20)),
    )


def log_name(seed: int, index: int) -> str:
    """The log's id; sorts in the order of the logs."""
    kind = SCENARIOS[index % LOGS_PER_TOWN].kind.lower().replace(" ", "-")
    return f"town-{seed}-{index:04d}-{kind}"


def plan_log(seed: int, index: int) -> tuple[Town, TownDrive]:
    """The drive of log `index`, and the town it leads through."""
    town = build_town(seed, index // LOGS_PER_TOWN)
    return town, plan_drive(town.streets, town.parked, SCENARIOS[index % LOGS_PER_TOWN], LOG_STEPS, [seed, index, 4])
