"""How the others move, and the bounds of it."""

from dataclasses import dataclass, fields
from typing import Literal

from tasks.settings import fixed

MOST = 1000.0  # of any setting, and of speeds [m/s]: the length of paths grows with it


@dataclass(frozen=True)
class TrafficSettings:
    """How the others move. IDM's parameters are the public benchmark's (docs/reward.md 5).

    `navsim` asks for the first five and the exponent; its other rules are the public code's own. `custom` asks for
    those of the ways (target speed, comfortable deceleration), and the gap of who enters. What is fixed is the shape
    of the model, not a style of driving.
    """

    mode: Literal["idm", "replay", "navsim", "custom"] = "idm"  # navsim: the public code's; custom: a policy's
    target_speed_mps: float = 10.0  # where the lane has no speed limit
    min_gap_m: float = 1.0
    headway_s: float = 1.5
    accel_max: float = 1.0  # m/s2
    decel_max: float = 2.0  # m/s2, comfortable
    exponent: float = fixed(4.0)  # of the free-road term
    emergency_decel: float = fixed(8.0)  # m/s2, what tyres can; the public traffic knows no limit
    lookahead_m: float = fixed(60.0)
    blend_length_m: float = fixed(20.0)  # over which a start beside the path fades onto it
    yields: bool = True  # idm: drivers keep the intent of their log, and give way where paths cross or merge
    policy: str | None = None  # custom: a class, or function, that makes one: my_package.my_module:MyPolicy

    def __post_init__(self) -> None:
        if self.mode not in ("idm", "replay", "navsim", "custom"):
            raise ValueError(f"traffic mode must be idm, replay, navsim or custom, not {self.mode!r}")
        if (self.mode == "custom") != (self.policy is not None):
            raise ValueError(f"traffic.policy={self.policy} with traffic={self.mode}: traffic=custom takes one, alone")
        for name in ("target_speed_mps", "headway_s", "accel_max", "decel_max", "blend_length_m"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"traffic {name} must be positive, not {getattr(self, name)}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("mode", "yields", "policy") and not 0.0 <= value <= MOST:
                raise ValueError(f"traffic {field.name} must lie within 0 .. {MOST:g}, not {value}")

    @property
    def leaves_out_touching(self) -> bool:
        """Whether who touches the ego at the start is left out of the score: not in the public reactive evaluation."""
        return self.mode != "navsim"
