"""A Work whose rows are fit to be made into episodes and pictures: a world of the right size, times of a log."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from factory.graph.steps import AcceptedDrive, SampleColumns
from tests.factory.toy import ToyWork
from tests.planners.samples import FRONT_YAWS, jpeg, pictures, plain, sample

VIEW = pictures(dict.fromkeys(FRONT_YAWS, jpeg(plain((90, 120, 60), 32, 18))))
WORLD = {name: value for name, value in sample(0).items() if name.startswith(("agent_", "lane_", "light_", "now_pose"))}

TIMES = {"clip_start_s": 2.0, "now_s": 5.5, "world_from_ego": None}


@dataclass(frozen=True)
class FilmedWork(ToyWork):
    """Rows that an episode can be made of."""

    shown: Mapping[str, Any] = field(default_factory=lambda: {**WORLD, **VIEW, **TIMES})

    def drawn(self, driven: AcceptedDrive) -> SampleColumns:
        drawn = super().drawn(driven)
        assert isinstance(drawn, SampleColumns)
        return SampleColumns({**drawn.row, **self.shown})
