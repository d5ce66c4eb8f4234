"""The recovery expert: the human trajectory that leads back to the log (paper, section "Recovery-based Expert").

From a table of human trajectories it retrieves the one whose matching vector
    m = [vx at the start, vy at the start, heading at the start, x, y, heading at the end],  in the start pose's frame,
is nearest in the L1 norm to the ego's: its present velocity, heading 0, and the LOGGED pose 4 s later. As published the
tracker follows it directly; by default it is first made feasible from the ego's actual start state (feasible.py).
"""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from tasks.experts.protocol import Plan
from tasks.experts.recovery.feasible import feasible
from tasks.experts.recovery.settings import RecoverySettings
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import to_local, to_world, wrap_angle
from tasks.world.vehicle import HEADING, VX, VY
from tasks.world.vocabulary import checked_trajectories, trajectories_digest

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
class Recovery:
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
            trajectory = feasible(self.table.trajectories[row], scene.ego_state, self.settings.feasible)
        if isinstance(trajectory, str):
            return Rejected("expert", "no_plan", f"table row {row}: {trajectory}")
        return Plan(to_world(scene.ego_state[: HEADING + 1], trajectory))
