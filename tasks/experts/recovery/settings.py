"""How the recovery expert retrieves, and what makes a retrieved trajectory drivable."""

from dataclasses import dataclass

from tasks.settings import fixed


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
    max_iterations: int = 4000  # of a QP
    tolerance: float = 1e-4  # of a QP


DEFAULTS = FeasibleSettings()


@dataclass(frozen=True)
class RecoverySettings:
    """How to retrieve and what to do with what was found."""

    smooth: bool = True  # False: the retrieved trajectory as it is, as published
    # Of the matching vector: vx, vy, heading now; x, y, heading at the end. The paper weighs none.
    weights: tuple[float, float, float, float, float, float] = fixed((1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
    feasible: FeasibleSettings = fixed(DEFAULTS)  # of the smoothing
