"""How the others move, and the bounds of it."""

from dataclasses import dataclass, fields
from typing import Literal

# Settings that are gone, as they always were: keys of tables hold them still, so that older ones go on.
REMOVED = {"lateral_accel_max": 3.0, "snap_distance_m": 3.0, "enter_clearance_m": 30.0, "corridor_margin_m": 0.1}
IMITATION = "tasks.rollout.learned.imitation:from_file"  # the policy that is fitted to logs here
MOST = 1000.0  # of any setting, and of speeds [m/s]: the length of paths grows with it


@dataclass(frozen=True)
class TrafficSettings:
    """How the others move. IDM's parameters are the public benchmark's (docs/reward.md 5).

    `navsim` asks for the first five and the exponent; its other rules are the public code's own. `learned` asks for
    those of the ways (target speed, comfortable deceleration), and the gap of who enters.
    """

    mode: Literal["idm", "replay", "navsim", "learned"] = "idm"  # navsim: the public code's; learned: a policy's
    target_speed_mps: float = 10.0  # where the lane has no speed limit
    min_gap_m: float = 1.0
    headway_s: float = 1.5
    accel_max: float = 1.0  # m/s2
    decel_max: float = 2.0  # m/s2, comfortable
    exponent: float = 4.0  # of the free-road term
    emergency_decel: float = 8.0  # m/s2, what tyres can; the public traffic knows no limit
    lookahead_m: float = 60.0
    blend_length_m: float = 20.0  # over which a start beside the path fades onto it
    yields: bool = True  # idm: drivers keep the intent of their log, and give way where paths cross or merge
    weights: str | None = None  # learned: the policy's file, as `python -m planners train_traffic` makes one
    policy: str = IMITATION  # learned: a class, or function, that makes a policy of that file

    def __post_init__(self) -> None:
        if self.mode not in ("idm", "replay", "navsim", "learned"):
            raise ValueError(f"traffic mode must be idm, replay, navsim or learned, not {self.mode!r}")
        if self.mode == "learned" and self.policy == IMITATION and not self.weights:
            raise ValueError(
                "traffic weights is missing: mode=learned needs a file that `python -m planners train_traffic` makes"
            )
        for name in ("target_speed_mps", "headway_s", "accel_max", "decel_max", "blend_length_m"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"traffic {name} must be positive, not {getattr(self, name)}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("mode", "yields", "weights", "policy") and not 0.0 <= value <= MOST:
                raise ValueError(f"traffic {field.name} must lie within 0 .. {MOST:g}, not {value}")

    @property
    def leaves_out_touching(self) -> bool:
        """Whether who touches the ego at the start is left out of the score: not in the public reactive evaluation."""
        return self.mode != "navsim"
