"""The constants of the smooth planner. Light: importing it loads no numpy."""

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class SmoothSettings:
    """PDM-Closed's proposals, with what bounds their change; raises ValueError where a value makes no sense."""

    speed_fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the lane's speed limit, as PDM-Closed
    lateral_offsets_m: tuple[float, ...] = (0.0, -1.0, 1.0)  # + is to the left, as PDM-Closed
    merge_s: tuple[float, ...] = (1.5, 2.5, 4.0)  # over which the ego's own offset and direction fade into a path's
    merge_least_m: float = 10.0
    line_smoothing_m: float = 2.0  # standard deviation of the Gaussian over which the centre line is averaged
    fallback_speed_mps: float = 15.0  # where the lane has no speed limit
    min_gap_m: float = 1.0
    headway_s: float = 1.5
    accel_max_mps2: float = 1.5
    decel_comfort_mps2: float = 1.5  # towards a lower speed on a free road
    decel_max_mps2: float = 3.0  # behind others
    exponent: float = 4.0  # of IDM's free-road term
    response_s: float = 1.0  # time constant with which acceleration follows what IDM wants
    jerk_max_mps3: float = 3.5  # comfort: 4.13
    lateral_accel_max_mps2: float = 2.0  # in bends, which the speed is fitted to
    bend_decel_mps2: float = 1.0  # before them
    score_step: float = 0.02  # of the score: within it the smoother proposal is the better one

    def __post_init__(self) -> None:
        for name in ("speed_fractions", "lateral_offsets_m", "merge_s"):
            values = getattr(self, name)
            if not values or not all(map(math.isfinite, values)):
                raise ValueError(f"{name} must be finite numbers, at least one, not {list(values)}")
        for name in ("speed_fractions", "merge_s"):
            if min(getattr(self, name)) <= 0.0:
                raise ValueError(f"{name} must be positive, not {list(getattr(self, name))}")
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, tuple) and not 0.0 < value < math.inf:
                raise ValueError(f"{field.name} must be positive and finite, not {value}")


DEFAULTS = SmoothSettings()
