"""Traffic that a policy of a user's own drives: what it is shown and answers, how it is named, how it is stepped.

`traffic=custom` asks it every 0.1 s for the next states of the vehicles that `traffic=idm` would drive. Who they are,
from when and along which ways, who waits, who enters and who parks is decided by the same rules (traffic.py).
"""

import errno
import importlib
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tasks.rollout.corridor import Paths
from tasks.rollout.idm import IdmDriver
from tasks.rollout.traffic import begin_step, finish_step, first_row
from tasks.rollout.traffic_state import AgentStates, Motion, Roles, RolloutRows
from tasks.settings import TrafficSettings
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import AgentKind
from tasks.world.geometry import all_within
from tasks.world.road_map import RoadMap

SEEN_ROWS = 11  # of 0.1 s: the second before now, and now


@dataclass(frozen=True)
class SeenTraffic:
    """The world up to now: N agents and, in the last place, the ego. Nothing of what comes after now is in it.

    As for IDM the log says which way a vehicle takes at a fork, how far beside the lane's middle it drives, and which
    stop lines are closed to it for how long: the maps have no lights. It says no speeds.
    """

    boxes: Array  # (SEEN_ROWS, N + 1, 5) centre x, y [m], heading [rad], length, width [m]; NaN where absent
    velocities: Array  # (SEEN_ROWS, N + 1, 2) world [m/s]
    valid: Bools  # (SEEN_ROWS, N + 1)
    kinds: tuple[AgentKind, ...]  # (N + 1,)
    asked: Bools  # (N,) whose next state is wanted
    road_map: RoadMap
    way: Ints  # (N,) the way among `ways` of each agent that is driven; -1: it is not
    ways: Paths  # M of them; line_state (1, Q) is that of now


class TrafficPolicy(Protocol):
    """Moves vehicles. Pure: the same world is answered the same, whatever was asked before."""

    def digest(self) -> str:
        """Tells code, weights and settings apart: rows made with another digest are other rows."""
        ...

    def next_states(self, seen: SeenTraffic) -> Array:
        """(N, 4) centre x, y [m], heading [rad], speed along it [m/s] in 0.1 s; of who is not asked, ignored."""
        ...


class BadPolicy(ValueError):
    """There is no such policy, or it answers what is no state."""


@lru_cache(maxsize=4)
def policy_named(name: str) -> TrafficPolicy:
    """What `my_package.my_module:MyPolicy`, a class or a function, gives when it is called. Raises BadPolicy."""
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise BadPolicy(f"traffic.policy={name}: name one as my_package.my_module:MyPolicy ({error})") from error
    policy: TrafficPolicy = found()
    missing = [member for member in ("digest", "next_states") if not hasattr(policy, member)]
    if missing:
        raise BadPolicy(f"traffic.policy: {name} is no traffic policy: it has no {', '.join(missing)}")
    return policy


def traffic_record(settings: TrafficSettings) -> dict[str, object]:
    """The settings as keys and records hold them: a policy with its digest, nothing of it where none drives.

    Raises BadPolicy.
    """
    record: dict[str, object] = asdict(settings)
    name = record.pop("policy")
    return record | ({} if settings.policy is None else {"policy": f"{name} {policy_named(settings.policy).digest()}"})


def refuse_another_policy(settings: TrafficSettings, recorded: object) -> None:
    """Raises OSError where the policy that drives here is not the one that `traffic_record` gave at the run's start."""
    if settings.policy is not None and traffic_record(settings)["policy"] != recorded:
        raise OSError(errno.ESTALE, "has another digest than when the run began; start it again", settings.policy)


def drive_by_policy(
    policy: TrafficPolicy, kinds: tuple[AgentKind, ...], road_map: RoadMap,
    start: int, log: AgentStates, now: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver,
    past: AgentStates, ego_past: tuple[Array, Array], ego: tuple[Array, Array],
) -> tuple[RolloutRows, Motion]:  # fmt: skip
    """As `traffic.drive`: the traffic's answer to an ego of boxes (T, 5) about its centre and velocities (T, 2).

    past: the agents over the SEEN_ROWS rows up to `start`; ego_past: the ego's boxes and velocities in them. Raises
    BadPolicy where the policy answers no states.
    """
    rows, motion, diverged = first_row(now, roles, *ego)
    boxes, velocities = (
        np.concatenate([agents, of_ego[:, None]], axis=1)
        for agents, of_ego in ((past.boxes, ego_past[0]), (past.velocities, ego_past[1]))
    )
    valid = np.concatenate([past.valid, np.ones((SEEN_ROWS, 1), bool)], axis=1)
    for t in range(len(rows.boxes) - 1):
        asked = begin_step(start, roles, paths, driver, t, rows, diverged, motion)
        answer = np.zeros((len(asked), 4))
        if asked.any():
            seen = SeenTraffic(
                boxes=_up_to(t, boxes, rows.boxes),
                velocities=_up_to(t, velocities, rows.velocities),
                valid=_up_to(t, valid, rows.valid),
                kinds=kinds,
                asked=asked.copy(),
                road_map=road_map,
                way=motion.path[t + 1].copy(),
                ways=paths._replace(line_state=paths.line_state[t : t + 1]),
            )
            answer = _checked(policy, policy.next_states(seen), asked)
        finish_step(start, log, roles, paths, driver, t, asked, answer, rows, diverged, motion)
    return rows, motion


def _up_to(t: int, past: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """The SEEN_ROWS rows up to row t, copied; the past's last row is row 0."""
    return np.concatenate([past[:-1], rows[: t + 1]])[-SEEN_ROWS:]


def _checked(policy: TrafficPolicy, answer: Array, asked: Bools) -> Array:
    """The answer as the kernels take it. Raises BadPolicy."""
    name, expected = type(policy).__name__, (len(asked), 4)
    answer = np.ascontiguousarray(answer, np.float64)
    if answer.shape != expected:
        raise BadPolicy(f"{name}.next_states gave {answer.shape}, not {expected}: x, y, heading, speed")
    if not all_within(answer[asked]):
        raise BadPolicy(f"{name}.next_states gave a state that is not finite, or too large to be one")
    return answer
