"""What the sampling expert tries, and what it takes for another mode. Light: importing it loads no numpy."""

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class VocabularySettings:
    """How trajectories are chosen; raises ValueError where a value makes no sense.

    Distances are between the poses at which two drives end, in the frame of one of them.
    """

    mode: int = 1  # which of the diverse modes is the plan: 1 is the best, 2 the best that is unlike it, ...
    rollouts: int = 64  # trajectories at most that are driven among answering traffic
    speed_off_mps: float = 2.0  # of a trajectory's start at most from the ego's
    yaw_rate_off_radps: float = 0.2  # the same of its yaw rate
    blend_s: float = 1.0  # time constant with which a start speed that is off fades into the trajectory's own
    apart_along_m: float = 1.0  # of what is driven: nearer ends, along and across, are one and the same
    apart_across_m: float = 0.25
    mode_along_m: float = 8.0  # of modes
    mode_across_m: float = 1.5
    score_step: float = 0.02  # of the score: within it the smoother drive is the better one

    def __post_init__(self) -> None:
        for name in ("mode", "rollouts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for field in fields(VocabularySettings):
            value = getattr(self, field.name)
            if field.name not in ("mode", "rollouts") and not 0.0 < value < math.inf:
                raise ValueError(f"{field.name} must be positive and finite, not {value}")
