"""The recovery expert: the human trajectory that leads back to the log (paper, section "Recovery-based Expert").

From a table of human trajectories it retrieves the one whose matching vector
    m = [vx at the start, vy at the start, heading at the start, x, y, heading at the end],  in the start pose's frame,
is nearest in the L1 norm to the ego's: its present velocity, heading 0, and the LOGGED pose 4 s later. As published the
tracker follows it directly; by default it is first made feasible from the ego's actual start state.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import osqp
from scipy import sparse

from tasks.experts.protocol import Plan
from tasks.settings import FEASIBLE_DEFAULTS, FeasibleSettings, RecoverySettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import AX, HEADING, PACIFICA, STEERING, VX, VY, to_local, to_world, wrap_angle
from tasks.world.vocabulary import checked_trajectories, trajectories_digest

# A retrieved trajectory made drivable from the ego's true start: two small QPs and an exact integration.
#
# A human trajectory of another drive starts with another speed and another steering angle. Followed as it is, the
# tracker answers with a kick that no human would give. The QPs find the nearest motion that starts where the ego is:
#
# 1. Along the path. With jerk j_k, constant over each step of dt = 0.1 s, the states are linear in it:
#        a_{k+1} = a_k + dt j_k,   v_{k+1} = v_k + dt a_k + dt^2/2 j_k,
#        s_{k+1} = s_k + dt v_k + dt^2/2 a_k + dt^3/6 j_k.
#        minimise  sum_k w_s (s_k - s_ref_k)^2 + w_j j_k^2
#        subject to  v >= 0,  a_min <= a <= a_max,  |j| <= j_max;  s_0 = 0, v_0 and a_0 those of the ego.
# 2. Across it, with that speed profile. With curvature rate u_k, constant over a step, and m_k = (v_k + v_{k+1}) / 2:
#        kappa_{k+1} = kappa_k + dt u_k,                          curvature
#        h_{k+1} = h_k + dt m_k (kappa_k + kappa_{k+1}) / 2,      heading
#        d_{k+1} = d_k + dt m_k ((h_k + h_{k+1}) / 2 - g_k),      lateral distance, g_k the reference heading at s
#        minimise  sum_k w_d d_k^2 + w_h (h_k - h_ref(s_k))^2 + w_u (m_k u_k)^2
#        subject to  |kappa| <= min(kappa_max, yaw_rate_max / v, lateral_accel_max / v^2),
#                    |u| <= min(u_max, yaw_accel_max / v);  d_0 = 0, h_0 = 0, kappa_0 = tan(steering) / wheel base.
#    (Linearised in the reference's frame: sin(h - h_ref) = h - h_ref.)
# 3. x, y from h and v by the midpoint rule: the poses are those of a car, whatever the linearisation left out.
#
# Where the start state itself breaks a bound, the bound is widened to what the largest rate allows from there, so that
# both problems always have a solution. Limits are those of the reward's comfort rules (docs/reward.md 2i) with a
# margin, because the tracker adds its own.

N = HORIZON_STEPS
SLOW_MPS = 0.5  # limits that divide by the speed stop growing below it


def make_feasible(trajectory: Array, ego_state: Array, settings: FeasibleSettings = FEASIBLE_DEFAULTS) -> Array | str:
    """The nearest drivable trajectory (40, 3) to `trajectory` (40, 3), both in the frame of `ego_state` (11,).

    Returns the reason as text where a QP does not reach the tolerance within its iterations.
    """
    reference = np.concatenate([np.zeros((1, 3)), trajectory])
    heading = np.unwrap(reference[:, 2])
    middle = (heading[1:] + heading[:-1]) / 2.0
    step = np.diff(reference[:, :2], axis=0)
    forward = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    progress = np.maximum.accumulate(np.concatenate([[0.0], np.cumsum(forward)]))  # a human's car does not back here

    along = _along(progress[1:], float(ego_state[VX]), float(ego_state[AX]), settings)
    if isinstance(along, str):
        return along
    distance, speed = along
    kappa0 = float(np.tan(ego_state[STEERING]) / PACIFICA.wheel_base)
    turned = _across(_at(distance, progress, heading), speed, kappa0, settings)
    if isinstance(turned, str):
        return turned
    mean_heading = (turned[1:] + turned[:-1]) / 2.0
    moved = (speed[1:] + speed[:-1]) / 2.0 * STEP_S
    x, y = np.cumsum(moved * np.cos(mean_heading)), np.cumsum(moved * np.sin(mean_heading))
    return np.stack([x, y, turned[1:]], axis=-1)


def _at(distance: Array, progress: Array, heading: Array) -> Array:
    """Reference heading at arc lengths; where the reference stands, its last heading there; constant beyond its end."""
    last = np.concatenate([np.diff(progress) > 0.0, [True]])
    return np.interp(distance, progress[last], heading[last])


@cache
def _integrators() -> tuple[Array, Array, Array]:
    """(40, 40) matrices from jerks to acceleration, speed and distance after each step."""
    lag = np.arange(N)[:, None] - np.arange(N)[None]  # whole steps since the jerk's step ended
    past = lag >= 0
    since = (lag + 1) * STEP_S  # time since the jerk's step began
    before = lag * STEP_S
    accel = np.where(past, STEP_S, 0.0)
    speed = np.where(past, (since**2 - before**2) / 2.0, 0.0)
    distance = np.where(past, (since**3 - before**3) / 6.0, 0.0)
    return accel, speed, distance


def _along(wanted: Array, speed0: float, accel0: float, settings: FeasibleSettings) -> tuple[Array, Array] | str:
    """Distance and speed (41,) each at 0 .. 4.0 s."""
    to_accel, to_speed, to_distance = _integrators()
    t = np.arange(1, N + 1) * STEP_S
    free_speed = speed0 + accel0 * t
    free_distance = speed0 * t + accel0 * t**2 / 2.0

    # what the start state can reach at the largest jerk towards rest of acceleration
    release, released = np.empty(N), np.empty(N)
    accel = accel0
    for k in range(N):
        release[k] = np.clip(-accel / STEP_S, -settings.jerk_max_mps3, settings.jerk_max_mps3)
        accel = accel + STEP_S * release[k]
        released[k] = accel
    low_speed = np.minimum(0.0, free_speed + to_speed @ release)
    low_accel = np.minimum(settings.accel_min_mps2, released)
    high_accel = np.maximum(settings.accel_max_mps2, released)
    jerk = _solve(
        hessian=settings.weight_progress * to_distance.T @ to_distance + settings.weight_jerk * np.eye(N),
        gradient=settings.weight_progress * to_distance.T @ (free_distance - wanted),
        rows=np.concatenate([to_speed, to_accel, np.eye(N)]),
        low=np.concatenate([low_speed - free_speed, low_accel - accel0, np.full(N, -settings.jerk_max_mps3)]),
        high=np.concatenate([np.full(N, np.inf), high_accel - accel0, np.full(N, settings.jerk_max_mps3)]),
        settings=settings,
        what="longitudinal",
    )
    if isinstance(jerk, str):
        return jerk
    distance = np.concatenate([[0.0], free_distance + to_distance @ jerk])
    speed = np.concatenate([[speed0], free_speed + to_speed @ jerk])
    return distance, speed


def _across(wanted: Array, speed: Array, kappa0: float, settings: FeasibleSettings) -> Array | str:
    """Headings (41,) at 0 .. 4.0 s; `wanted` (41,) is the reference heading at the driven distance."""
    mean_speed = (speed[1:] + speed[:-1]) / 2.0
    step = mean_speed * STEP_S
    to_kappa = STEP_S * np.tril(np.ones((N, N)))
    half_sum = np.eye(N) / 2.0 + np.eye(N, k=-1) / 2.0  # mean of a step's two ends, without the start's part
    to_heading = np.cumsum(step[:, None] * (half_sum @ to_kappa), axis=0)
    to_lateral = np.cumsum(step[:, None] * (half_sum @ to_heading), axis=0)
    free_heading = np.cumsum(step * kappa0)
    wanted_mean = (wanted[1:] + wanted[:-1]) / 2.0
    start_half = np.concatenate([[0.0], free_heading[:-1]])
    free_lateral = np.cumsum(step * ((free_heading + start_half) / 2.0 - wanted_mean))

    fast = np.maximum(np.abs(speed), SLOW_MPS)
    rate = np.minimum(settings.curvature_rate_max_1pms, settings.yaw_accel_max_radps2 / fast[:-1])
    bound = np.minimum(settings.curvature_max_1pm, settings.yaw_rate_max_radps / fast[1:])
    bound = np.minimum(bound, settings.lateral_accel_max_mps2 / fast[1:] ** 2)
    bound = np.maximum(bound, abs(kappa0) - STEP_S * np.cumsum(rate))
    change = _solve(
        hessian=settings.weight_lateral * to_lateral.T @ to_lateral
        + settings.weight_heading * to_heading.T @ to_heading
        + settings.weight_yaw_accel * np.diag(np.maximum(mean_speed, SLOW_MPS) ** 2),
        gradient=settings.weight_lateral * to_lateral.T @ free_lateral
        + settings.weight_heading * to_heading.T @ (free_heading - wanted[1:]),
        rows=np.concatenate([to_kappa, np.eye(N)]),
        low=np.concatenate([-bound - kappa0, -rate]),
        high=np.concatenate([bound - kappa0, rate]),
        settings=settings,
        what="lateral",
    )
    if isinstance(change, str):
        return change
    return np.concatenate([[0.0], free_heading + to_heading @ change])


def _solve(
    hessian: Array, gradient: Array, rows: Array, low: Array, high: Array, settings: FeasibleSettings, what: str
) -> Array | str:
    """argmin 1/2 x' H x + g' x, low <= rows x <= high; or why there is none.

    The solver is fresh and its step size adapts by iteration count, never by the clock: the result does not depend on
    what was solved before or on how busy the machine is.
    """
    solver = osqp.OSQP()
    solver.setup(
        P=sparse.csc_matrix(np.triu(hessian)),
        q=gradient,
        A=sparse.csc_matrix(rows),
        l=low,
        u=high,
        verbose=False,
        max_iter=settings.max_iterations,
        eps_abs=settings.tolerance,
        eps_rel=settings.tolerance,
        adaptive_rho=1,
        adaptive_rho_interval=25,
        check_termination=25,
        warm_starting=False,
        polishing=False,
    )
    result = solver.solve(raise_error=False)
    if result.info.status != "solved":
        return f"{what} QP: {result.info.status} after {result.info.iter} iterations"
    return np.asarray(result.x, dtype=np.float64)


# The table of human trajectories, and the expert that searches it.

FIT_STEPS = 5  # the start velocity is that of a parabola through the origin and the first 0.5 s
START_HEADING, END_HEADING = 2, 5  # columns of the matching vector that are angles


def start_velocities(trajectories: Array) -> Array:
    """Velocity (M, 2) [m/s] at the start of trajectories (M, 40, 3), by least squares p(t) = v t + a t^2 / 2."""
    t = STEP_S * np.arange(1, FIT_STEPS + 1)
    weights = np.linalg.pinv(np.stack([t, t**2 / 2.0], axis=1))[0]
    velocities: Array = (trajectories[:, :FIT_STEPS, :2] * weights[:, None]).sum(axis=1)
    return velocities


@dataclass(frozen=True)
class RecoveryTable:
    """M human trajectories, ready to be searched. Raises ValueError on a wrong shape or values that are not finite."""

    trajectories: Array  # (M, 40, 3) x [m], y [m], heading [rad] in the start pose's frame at 0.1 .. 4.0 s
    features: Array = field(init=False)  # (M, 6) vx0, vy0, heading0, x_end, y_end, heading_end
    digest: str = field(init=False)  # 16 hex digits of the trajectories

    def __post_init__(self) -> None:
        trajectories = checked_trajectories(np.asarray(self.trajectories), "recovery table")
        start = np.zeros((len(trajectories), 1))  # heading 0 in the start pose's own frame
        features = np.concatenate([start_velocities(trajectories), start, trajectories[:, -1]], axis=1)
        for name, value in (("trajectories", trajectories), ("features", features)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "digest", trajectories_digest(trajectories))

    def __len__(self) -> int:
        return len(self.trajectories)

    def nearest(self, target: Array, weights: Array) -> int:
        """The first row with the least weighted L1 distance to `target` (6,); angles are compared around the circle."""
        difference = self.features - target
        for column in (START_HEADING, END_HEADING):
            difference[:, column] = wrap_angle(difference[:, column])
        return int((np.abs(difference) * weights).sum(axis=1).argmin())


@dataclass(frozen=True)
class RecoveryExpert:
    """Drives back to the log the way some human once did."""

    table: RecoveryTable
    settings: RecoverySettings = field(default_factory=RecoverySettings)
    name: str = "recovery"

    def digest(self) -> str:
        """Of the table and every setting."""
        return hashlib.sha256(f"{self.table.digest}\x1f{self.settings!r}".encode()).hexdigest()[:16]

    def retrieve(self, scene: Scene) -> int:
        """Row of the table for this scene. Raises ValueError where the clip ends within 4 s."""
        end = scene.step + HORIZON_STEPS
        if end >= len(scene.clip.ego_states):
            raise ValueError(f"recovery needs the log at step {end}; the clip has {len(scene.clip.ego_states)}")
        ego = scene.ego_state
        goal = to_local(ego[: HEADING + 1], scene.clip.ego_states[end, : HEADING + 1])
        target = np.concatenate([[ego[VX], ego[VY], 0.0], goal])
        return self.table.nearest(target, np.array(self.settings.weights))

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The retrieved trajectory from here; "no_plan" where the smoothing finds no solution."""
        row = self.retrieve(scene)
        trajectory: Array | str = self.table.trajectories[row]
        if self.settings.smooth:
            trajectory = make_feasible(self.table.trajectories[row], scene.ego_state, self.settings.feasible)
        if isinstance(trajectory, str):
            return Rejected("expert", "no_plan", f"table row {row}: {trajectory}")
        return Plan(to_world(scene.ego_state[: HEADING + 1], trajectory))
