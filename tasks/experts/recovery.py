"""The recovery expert: from the perturbed state back to the log's pose, heading and speed at T+2H.

As published (`match=paper`; paper, section "Recovery-based Expert") it retrieves, from a table of human trajectories,
the one whose matching vector
    m = [vx at the start, vy at the start, heading at the start, x, y, heading at the end],  in the start pose's frame,
is nearest in the L1 norm to the ego's: its present velocity, heading 0, and the LOGGED pose 4 s later. The tracker
follows it as it is. That ends metres off the log, says nothing of the speed there, and starts with a kick.

By default several human trajectories are tried, each led to the log's end and made feasible from where the ego is: the
log's own drive, onto which the ego comes back within a few seconds, then those of the table that are nearest in start
velocity, end pose and end speed, each divided by its spread in the table. The first whose drive among answering
traffic the reward accepts, and which ends at the log, is the sample. Where the limits of a car let none of them end
there, as from 10 m ahead of a log that stops, the state is out of reach.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache

import numpy as np

from tasks.experts.protocol import Goal, Plan
from tasks.quadratic import minimum
from tasks.settings import FEASIBLE_DEFAULTS, FeasibleSettings, RecoverySettings
from tasks.stages import Rejected
from tasks.world.arrays import Array, Ints
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
T_S: Array = STEP_S * np.arange(1, N + 1, dtype=np.float64)
END_STEPS = 3  # that decide where and how fast a trajectory ends
SLOW_MPS = 0.5  # limits that divide by the speed stop growing below it
TO_CURVATURE: Array = STEP_S * np.tril(np.ones((N, N)))  # from its rates to what they add to it after each step
HALF_SUM: Array = np.eye(N) / 2.0 + np.eye(N, k=-1) / 2.0  # mean of a step's two ends, without the start's part
TO_MEAN_CURVATURE: Array = HALF_SUM @ TO_CURVATURE


def make_feasible(trajectory: Array, ego_state: Array, settings: FeasibleSettings = FEASIBLE_DEFAULTS) -> Array | str:
    """The nearest drivable trajectory (40, 3) to `trajectory` (40, 3), both in the frame of `ego_state` (11,).

    Returns the reason as text where a QP has no solution.
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
    _, to_speed, to_distance = _integrators()
    free_distance, free_speed, low, high = _along_from(speed0, accel0, settings)
    weight = settings.weight_progress * _at_the_end(settings)
    hessian, rows = _along_matrices(settings)
    gradient = to_distance.T @ (weight[:, 0] * (free_distance - wanted))
    jerk = minimum(hessian, gradient, rows, low, high)
    if isinstance(jerk, str):
        return f"longitudinal QP: {jerk}"
    distance = np.concatenate([[0.0], free_distance + to_distance @ jerk])
    speed = np.concatenate([[speed0], free_speed + to_speed @ jerk])
    return distance, speed


@lru_cache(maxsize=4)  # several plans are tried from one start
def _along_from(speed0: float, accel0: float, settings: FeasibleSettings) -> tuple[Array, Array, Array, Array]:
    """Distance and speed (40,) each without a jerk, and the bounds (120,) of the problem along the path."""
    _, to_speed, _ = _integrators()
    free_speed = speed0 + accel0 * T_S
    free_distance = speed0 * T_S + accel0 * T_S**2 / 2.0

    # what the start state can reach at the largest jerk towards rest of acceleration
    release, released = np.empty(N), np.empty(N)
    accel = accel0
    for k in range(N):
        release[k] = min(max(-accel / STEP_S, -settings.jerk_max_mps3), settings.jerk_max_mps3)
        accel = accel + STEP_S * release[k]
        released[k] = accel
    low_speed = np.minimum(0.0, free_speed + to_speed @ release)
    low_accel = np.minimum(settings.accel_min_mps2, released)
    high_accel = np.maximum(settings.accel_max_mps2, released)
    low = np.concatenate([np.full(N, -settings.jerk_max_mps3), low_speed - free_speed, low_accel - accel0])
    high = np.concatenate([np.full(N, settings.jerk_max_mps3), np.full(N, np.inf), high_accel - accel0])
    return free_distance, free_speed, low, high


@cache
def _along_matrices(settings: FeasibleSettings) -> tuple[Array, Array]:
    """(hessian, rows) of the problem along the path, wherever it starts."""
    to_accel, to_speed, to_distance = _integrators()
    weight = settings.weight_progress * _at_the_end(settings)
    hessian = to_distance.T @ (weight * to_distance) + settings.weight_jerk * np.eye(N)
    return hessian, np.concatenate([to_speed, to_accel])


def _across(wanted: Array, speed: Array, kappa0: float, settings: FeasibleSettings) -> Array | str:
    """Headings (41,) at 0 .. 4.0 s; `wanted` (41,) is the reference heading at the driven distance."""
    mean_speed = (speed[1:] + speed[:-1]) / 2.0
    step = mean_speed * STEP_S
    to_heading = np.cumsum(step[:, None] * TO_MEAN_CURVATURE, axis=0)
    to_lateral = np.cumsum(step[:, None] * (HALF_SUM @ to_heading), axis=0)
    free_heading = np.cumsum(step * kappa0)
    wanted_mean = (wanted[1:] + wanted[:-1]) / 2.0
    start_half = np.concatenate([[0.0], free_heading[:-1]])
    free_lateral = np.cumsum(step * ((free_heading + start_half) / 2.0 - wanted_mean))

    fast = np.maximum(np.abs(speed), SLOW_MPS)
    rate = np.minimum(settings.curvature_rate_max_1pms, settings.yaw_accel_max_radps2 / fast[:-1])
    bound = np.minimum(settings.curvature_max_1pm, settings.yaw_rate_max_radps / fast[1:])
    bound = np.minimum(bound, settings.lateral_accel_max_mps2 / fast[1:] ** 2)
    bound = np.maximum(bound, abs(kappa0) - STEP_S * np.cumsum(rate))
    more = _at_the_end(settings)
    change = minimum(
        hessian=to_lateral.T @ (settings.weight_lateral * more * to_lateral)
        + to_heading.T @ (settings.weight_heading * more * to_heading)
        + settings.weight_yaw_accel * np.diag(np.maximum(mean_speed, SLOW_MPS) ** 2),
        gradient=to_lateral.T @ (settings.weight_lateral * more[:, 0] * free_lateral)
        + to_heading.T @ (settings.weight_heading * more[:, 0] * (free_heading - wanted[1:])),
        rows=TO_CURVATURE,
        low=np.concatenate([-rate, -bound - kappa0]),
        high=np.concatenate([rate, bound - kappa0]),
    )
    if isinstance(change, str):
        return f"lateral QP: {change}"
    return np.concatenate([[0.0], free_heading + to_heading @ change])


@cache
def _at_the_end(settings: FeasibleSettings) -> Array:
    """(40, 1) by how much each step counts: the last ones are where, and how fast, it has to end."""
    share: Array = np.ones((N, 1))
    share[-END_STEPS:] = settings.weight_end
    return share


# The table of human trajectories, and the expert that searches it.

FIT_STEPS = 5  # the start velocity is that of a parabola through the origin and the first 0.5 s
END_HEADING = 4  # column of a feature that is an angle


def start_velocities(trajectories: Array) -> Array:
    """Velocity (M, 2) [m/s] at the start of trajectories (M, 40, 3), by least squares p(t) = v t + a t^2 / 2."""
    t = STEP_S * np.arange(1, FIT_STEPS + 1)
    weights = np.linalg.pinv(np.stack([t, t**2 / 2.0], axis=1))[0]
    velocities: Array = (trajectories[:, :FIT_STEPS, :2] * weights[:, None]).sum(axis=1)
    return velocities


def end_speeds(trajectories: Array) -> Array:
    """Speed (M,) [m/s] forward over the last 0.2 s of trajectories (M, 40, 3)."""
    heading = trajectories[:, -1, 2]
    step = trajectories[:, -1, :2] - trajectories[:, -3, :2]
    speeds: Array = (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / (2.0 * STEP_S)
    return speeds


@dataclass(frozen=True)
class RecoveryTable:
    """M human trajectories, ready to be searched. Raises ValueError on a wrong shape or values that are not finite."""

    trajectories: Array  # (M, 40, 3) x [m], y [m], heading [rad] in the start pose's frame at 0.1 .. 4.0 s
    features: Array = field(init=False)  # (M, 6) vx0, vy0, x_end, y_end, heading_end, speed_end
    digest: str = field(init=False)  # 16 hex digits of the trajectories

    def __post_init__(self) -> None:
        trajectories = checked_trajectories(np.asarray(self.trajectories), "recovery table")
        ends = [trajectories[:, -1], end_speeds(trajectories)]
        features = np.column_stack([start_velocities(trajectories), *ends])
        for name, value in (("trajectories", trajectories), ("features", features)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "digest", trajectories_digest(trajectories))

    def __len__(self) -> int:
        return len(self.trajectories)

    @cached_property
    def spreads(self) -> Array:
        """(6,) mean distance of each feature from its median, in its unit; 1 where all are alike."""
        spreads: Array = np.abs(self.features - np.median(self.features, axis=0)).mean(axis=0)
        return np.where(spreads > 0.0, spreads, 1.0)

    def nearest(self, target: Array, k: int) -> Ints:
        """The k rows, nearest first, whose features are nearest to `target` (6,) in L1, each over its spread."""
        return self._nearest(target, 1.0 / self.spreads, k)

    def published(self, target: Array) -> int:
        """The row of the published equation: metres, radians and m/s alike, whatever the speed at the end."""
        return int(self._nearest(target, np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]), 1)[0])

    def _nearest(self, target: Array, weights: Array, k: int) -> Ints:
        difference = self.features - target
        difference[:, END_HEADING] = wrap_angle(difference[:, END_HEADING])
        return np.argsort((np.abs(difference) * weights).sum(axis=1), kind="stable")[:k]


@dataclass(frozen=True)
class RecoveryExpert:
    """Drives back to the log the way some human once did."""

    table: RecoveryTable
    settings: RecoverySettings = field(default_factory=RecoverySettings)
    name: str = "recovery"

    def digest(self) -> str:
        """Of the table and every setting."""
        return hashlib.sha256(f"{self.table.digest}\x1f{self.settings!r}".encode()).hexdigest()[:16]

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The plan that is tried first; "no_plan" and "out_of_reach" as of `plans`."""
        return next(self.plans(scene, rng))

    def plans(self, scene: Scene, rng: np.random.Generator) -> Iterator[Plan | Rejected]:
        """The ways back that end at the log, its own drive from here first; where there is none, why.

        "no_plan": a quadratic program has no solution; "out_of_reach": no way ends at the log. Where its own does not
        the table is not asked. Raises ValueError where the clip ends within 4 s.
        """
        ego, log = scene.ego_state, scene.log_ahead
        end = to_local(ego[: HEADING + 1], log[-1, : HEADING + 1])
        target = np.concatenate([ego[[VX, VY]], end, log[-1, [VX]]])
        if self.settings.match == "paper":
            yield Plan(to_world(ego[: HEADING + 1], self.table.trajectories[self.table.published(target)]))
            return
        refused = list[Rejected]()
        own = (fading_back(ego, log, fade_s) for fade_s in self.settings.fades_s)
        for made in (self._drivable_plan(wanted, ego, log[-1]) for wanted in own):
            if isinstance(made, Plan):
                yield made
            else:
                refused.append(made)
        if len(refused) == len(self.settings.fades_s):
            yield refused[0]
            return
        for row in self.table.nearest(target, self.settings.retrieved):
            made = self._drivable_plan(warped_to_end(self.table.trajectories[row], end), ego, log[-1])
            if isinstance(made, Plan):
                yield made

    def _drivable_plan(self, wanted: Array, ego: Array, end: Array) -> Plan | Rejected:
        """The drivable plan nearest to `wanted` (40, 3), the ego's frame, if it ends at the log's state `end` (11,)."""
        made = make_feasible(wanted, ego, self.settings.feasible)
        if isinstance(made, str):
            return Rejected("expert", "no_plan", made)
        chosen = self.settings
        goal = Goal(end[: HEADING + 1], float(end[VX]), chosen.max_off_m, chosen.max_off_deg, chosen.max_off_mps)
        poses = to_world(ego[: HEADING + 1], made)
        missed = goal.missed(poses[-1], float(end_speeds(made[None])[0]))
        return Plan(poses, goal) if missed is None else Rejected("expert", "out_of_reach", f"the plan {missed}")


def fading_back(ego: Array, log: Array, fade_s: float) -> Array:
    """The log's drive (40, 3) from where the ego is, in its frame: along, what it is off dies out in 4 s.

    Beside the log and in heading it dies out within fade_s. ego: state (11,); log: states (41, 11).
    """
    start = to_local(log[0, : HEADING + 1], ego[: HEADING + 1])
    along, aside = (1.0 - _step(T_S / seconds) for seconds in (N * STEP_S, fade_s))
    poses = log[1:, : HEADING + 1].copy()
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    poses[:, 0] += c * start[0] * along - s * start[1] * aside
    poses[:, 1] += s * start[0] * along + c * start[1] * aside
    poses[:, 2] += wrap_angle(start[2]) * aside
    return _headed_along(to_local(ego[: HEADING + 1], poses))


def warped_to_end(trajectory: Array, end: Array) -> Array:
    """The trajectory (40, 3), its end moved to the pose `end` (3,), what is before it the less the earlier it is."""
    share = _step(T_S / (N * STEP_S))
    moved = trajectory + share[:, None] * (end - trajectory[-1])
    moved[:, 2] = trajectory[:, 2] + share * wrap_angle(end[2] - trajectory[-1, 2])
    return _headed_along(np.asarray(moved))


def _headed_along(poses: Array) -> Array:
    """Poses (40, 3) from the origin, headed where they go, which `make_feasible` follows; slow ones stay as given."""
    places = np.concatenate([np.zeros((1, 2)), poses[:, :2], 2.0 * poses[-1:, :2] - poses[-2:-1, :2]])
    ahead = places[2:] - places[:-2]
    turn = wrap_angle(np.arctan2(ahead[:, 1], ahead[:, 0]) - poses[:, 2])
    goes = (np.hypot(*ahead.T) > 2.0 * STEP_S * SLOW_MPS) & (np.abs(turn) < np.pi / 2.0)
    headed = poses.copy()
    headed[goes, 2] += turn[goes]
    return headed


def _step(share: Array) -> Array:
    """From 0 at 0 to 1 at 1, at rest at both with no acceleration (minimum jerk)."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
