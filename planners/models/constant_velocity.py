"""Goes straight on at the speed of now: the least that a planner may do."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from planners.data.batch import Batch, Needs
from planners.models.planner import Planner, straight_on
from tasks.world.arrays import FloatArray


@dataclass(frozen=True)
class ConstantVelocitySettings:
    """Nothing to set."""


class ConstantVelocity(Planner):
    """Speed stays, the heading does not turn; learns nothing."""

    name: ClassVar[str] = "constant_velocity"
    settings_type = ConstantVelocitySettings

    def __init__(self, settings: ConstantVelocitySettings, arrays: Mapping[str, FloatArray]) -> None:
        super().__init__(settings, arrays)

    @property
    def needs(self) -> Needs:
        return Needs()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Raises ValueError: there is nothing to train."""
        raise ValueError("constant_velocity has nothing to train: evaluate it as it is")

    def plan(self, batch: Batch) -> Tensor:
        return straight_on(batch)
