"""The constants of PDM-Closed, and which of the published planner's faults it keeps."""

import math
from dataclasses import dataclass

from tasks.settings import fixed


@dataclass(frozen=True)
class PdmSettings:
    """PDM-Closed as published with NAVSIM (docs/reward.md 4); raises ValueError where a value makes no sense.

    The three switches at the end are faults of the published planner, kept so that plans and progress compare with
    everything published; False corrects each. The fixed numbers are the published IDM's: another expert has others.
    """

    speed_fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the lane's speed limit
    lateral_offsets_m: tuple[float, ...] = (0.0, -1.0, 1.0)  # + is to the left
    fallback_speed_mps: float = fixed(15.0)  # where the lane has no speed limit
    min_gap_m: float = fixed(1.0)
    headway_s: float = 1.5
    accel_max_mps2: float = fixed(1.5)
    decel_max_mps2: float = fixed(3.0)
    exponent: int = fixed(10)  # of IDM's free-road term
    shared_lead_memory: bool = True  # within one path, a speed inherits lead fields its own search did not write
    brakes_at_first_step: bool = True  # no lead is looked for before 0.2 s: until then one seems to stand at the bumper
    speed_below_zero: bool = True  # a stop before an oncoming car overshoots into creeping backwards

    def __post_init__(self) -> None:
        for name in ("speed_fractions", "lateral_offsets_m"):
            values = getattr(self, name)
            if not values or not all(map(math.isfinite, values)):
                raise ValueError(f"pdm {name} must be finite numbers, at least one, not {list(values)}")
        if min(self.speed_fractions) <= 0.0:
            raise ValueError(f"pdm speed_fractions must be positive, not {list(self.speed_fractions)}")
        for name in ("fallback_speed_mps", "min_gap_m", "accel_max_mps2", "decel_max_mps2", "exponent"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"pdm {name} must be positive and finite, not {getattr(self, name)}")
        if not 0.0 <= self.headway_s < math.inf:
            raise ValueError(f"pdm headway_s must be finite and not negative, not {self.headway_s}")


DEFAULTS = PdmSettings()
