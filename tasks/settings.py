"""The settings of perturbation, gate, traffic and experts. Light: importing it loads no numpy."""

import math
from dataclasses import Field, dataclass, field, fields
from typing import Any, Literal, TypeVar

from tasks.subscores import JUDGED

T = TypeVar("T")
FIXED = "fixed"  # in the metadata of a field


def constant(value: T) -> T:
    """The default of a field that no configuration sets: a constant with its reason behind it, recorded with the rest.

    Code that makes the settings itself, such as a test or a bench, may give another value.
    """
    constant: Any = field(default=value, metadata={FIXED: True})
    return constant


def configurable_fields(shape: type[Any]) -> list[Field[Any]]:
    """The fields of a dataclass of settings that configuration may set."""
    return [each for each in fields(shape) if FIXED not in each.metadata]


@dataclass(frozen=True)
class PerturbSettings:
    """Paper, supplement, table of the curation pipeline."""

    max_heading_deg: float = 20.0
    max_longitudinal_m: float = 20.0
    max_lateral_m: float = 2.0
    step_longitudinal_m: float = 5.0
    step_lateral_m: float = 0.5
    epdms_min: float = 0.8  # /14 score, without EC
    interleaved: bool = True  # every second cell of the grid, as on a chessboard; False: every cell
    order: Literal["drawn", "spread"] = "drawn"  # of the candidates: as drawn, or see spread_out
    at_most: int | None = None  # candidates a clip; None: all there are
    at_log: bool = False  # the only candidate is the log itself, whatever it scores: what is made of no perturbation

    def __post_init__(self) -> None:
        gates = ("max_heading_deg", "max_longitudinal_m", "max_lateral_m")
        for name in (*gates, "step_longitudinal_m", "step_lateral_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"perturb {name} must be positive and finite, not {getattr(self, name)}")
        if not 0.0 <= self.epdms_min <= 1.0:
            raise ValueError(f"perturb epdms_min must be from 0 to 1, not {self.epdms_min}")
        if self.at_most is not None and self.at_most < 1:
            raise ValueError(f"perturb at_most must be positive, or null for no bound, not {self.at_most}")


@dataclass(frozen=True)
class ExpertGate:
    """Which sub-scores an expert's rollout must reach (paper, supplement: S_m = 1 for all but EP, EP > 0.5).

    And what the paper does not ask: what its end leads to, and that it is not the log again (docs/reward.md 2m).
    """

    full: tuple[str, ...] = JUDGED  # EC needs an earlier plan: there is none
    progress_above: float = 0.5  # EP that a drive must exceed
    off_route: bool = True  # refuse a drive that ends beside the route's lanes, or where none of them goes on
    after: bool = True  # refuse one after which somebody is hit within a second, at its speed and braking alike
    near_log: bool = True  # refuse one that is the log's own, to which a perturbation adds nothing

    def __post_init__(self) -> None:
        unknown = [name for name in self.full if name not in JUDGED]
        if unknown:
            raise ValueError(f"full names {', '.join(unknown)}; an expert's drive is judged by {', '.join(JUDGED)}")


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
    exponent: float = constant(4.0)  # of the free-road term
    emergency_decel: float = constant(8.0)  # m/s2, what tyres can; the public traffic knows no limit
    lookahead_m: float = constant(60.0)
    blend_length_m: float = constant(20.0)  # over which a start beside the path fades onto it
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
        for name in (each.name for each in fields(self) if each.name not in ("mode", "yields", "policy")):
            if not 0.0 <= (value := getattr(self, name)) <= MOST:
                raise ValueError(f"traffic {name} must lie within 0 .. {MOST:g}, not {value}")

    @property
    def leaves_out_touching(self) -> bool:
        """Whether who touches the ego at the start is left out of the score: not in the public reactive evaluation."""
        return self.mode != "navsim"


@dataclass(frozen=True)
class FeasibleSettings:
    """Limits and weights of the two QPs."""

    accel_min_mps2: float = -3.6  # comfort: -4.05
    accel_max_mps2: float = 2.1  # comfort: 2.40
    jerk_max_mps3: float = 3.5  # comfort: 4.13
    lateral_accel_max_mps2: float = 4.0  # comfort: 4.89
    yaw_rate_max_radps: float = 0.8  # comfort: 0.95
    yaw_accel_max_radps2: float = 1.5  # comfort: 1.93
    curvature_max_1pm: float = 0.2  # turning circle of a car of this size, 10 m across
    curvature_rate_max_1pms: float = 0.2  # steering wheel speed at standstill
    weight_progress: float = 1.0  # w_s, of distances along the path
    weight_jerk: float = 0.3  # w_j
    weight_lateral: float = 1.0  # w_d, of distances beside it
    weight_heading: float = 10.0  # w_h
    weight_yaw_accel: float = 0.1  # w_u
    weight_end: float = 10.0  # as many times do the last 0.3 s count


FEASIBLE_DEFAULTS = FeasibleSettings()


@dataclass(frozen=True)
class RecoverySettings:
    """How the recovery trajectory is chosen, and how near to the log its drive has to end."""

    match: Literal["log", "paper"] = "log"  # paper: the one human trajectory of the published equation, as it is
    retrieved: int = constant(8)  # human trajectories that are tried, behind the log's own from here
    fades_s: tuple[float, ...] = constant((2.5, 1.5, 4.0))  # over which the log's own drive comes back to its lane
    max_off_m: float = constant(2.0)  # from the log's pose and speed at T+2H
    max_off_deg: float = constant(10.0)
    max_off_mps: float = constant(5.0)
    feasible: FeasibleSettings = constant(FEASIBLE_DEFAULTS)

    def __post_init__(self) -> None:
        if self.match not in ("log", "paper"):
            raise ValueError(f"match must be log or paper, not {self.match!r}")
