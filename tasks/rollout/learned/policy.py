"""What a traffic policy is: states and map in, next states out, for many worlds at once.

`traffic=learned` asks one at every 0.1 s. It is named in the settings and made of the file that holds its weights;
policies of a user's own package satisfy the protocol too (docs/extend.md).
"""

import errno
import importlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from tasks.rollout.corridor import Paths
from tasks.rollout.settings import TrafficSettings
from tasks.world.agents import AgentKind
from tasks.world.arrays import Array, Bools, Ints

SEEN_ROWS = 11  # of 0.1 s: now, and the second before
KIND_NUMBER = {kind: number for number, kind in enumerate(AgentKind)}  # in SeenWorlds.kinds
X, Y, HEADING, SPEED = range(4)  # columns of an answer


class SeenWorlds(NamedTuple):
    """B worlds up to now: N agents and, in the last place, the ego. Nothing of what comes after now is in it."""

    boxes: Array  # (SEEN_ROWS, B, N + 1, 5) centre x, y [m], heading [rad], length, width [m]; NaN where absent
    velocities: Array  # (SEEN_ROWS, B, N + 1, 2) world [m/s]
    valid: Bools  # (SEEN_ROWS, B, N + 1)
    kinds: Ints  # (N + 1,) by KIND_NUMBER; the ego is a vehicle
    asked: Bools  # (B, N) whose next state is wanted: vehicles


@dataclass(frozen=True)
class RoadLines:
    """The map as lines: all lanes that cars drive, and the way of every agent through them.

    As for IDM the log says which way at a fork, how far beside the lane's middle, and where one waits at a junction
    for how long: the maps have no lights. It says no speeds.
    """

    lane_points: Array  # (Q, 3) x, y [m], heading [rad] of all centrelines
    lane_first: Ints  # (L + 1,) lane l has points lane_first[l]..lane_first[l + 1] - 1
    way: Ints  # (N,) the way of each agent among `ways`; -1: none, and it is never asked
    ways: Paths  # M of them, as far as they are known now: line_state (1, K) is that of this instant


class TrafficPolicy(Protocol):
    """Moves vehicles. Pure, and each world for itself: what is answered for one depends on no other in the batch."""

    def digest(self) -> str:
        """Tells weights and settings apart: rows made with another digest are other rows."""
        ...

    def next_states(self, seen: SeenWorlds, streets: RoadLines) -> Array:
        """(B, N, 4) centre x, y [m], heading [rad], speed along it [m/s], 0.1 s on; of who is asked, others ignored."""
        ...


class BadPolicy(ValueError):
    """There is no such policy, its file is none or damaged, or it answers what is no state."""


def policy_of(settings: TrafficSettings) -> TrafficPolicy:
    """The policy that the settings name; kept until its file changes. Raises BadPolicy."""
    try:
        stamp = None if settings.weights is None else Path(settings.weights).expanduser().stat()
    except OSError as error:
        raise BadPolicy(f"traffic.weights: {settings.weights}: {error.strerror}") from error
    changed = None if stamp is None else (stamp.st_mtime_ns, stamp.st_size, stamp.st_ino)
    return _made(settings.policy, settings.weights, changed)


def told(settings: TrafficSettings) -> dict[str, object]:
    """The settings as keys and records hold them: a policy's file by its digest; nothing of it where no policy drives.

    Raises BadPolicy.
    """
    words = asdict(settings)
    if settings.mode == "learned":
        return words | {"weights": policy_of(settings).digest()}
    return {name: word for name, word in words.items() if name not in ("weights", "policy")}


def refuse_another(settings: TrafficSettings, digest: object) -> None:
    """Raises OSError where a policy drives and its file is no longer what it was when rows were named by `digest`."""
    if settings.mode == "learned" and policy_of(settings).digest() != digest:
        raise OSError(errno.ESTALE, "is another file than when the run began; start it again", settings.weights)


@lru_cache(maxsize=4)
def _made(name: str, weights: str | None, changed: object) -> TrafficPolicy:
    made = _named(name)(weights)
    missing = [member for member in ("digest", "next_states") if not hasattr(made, member)]
    if missing:
        raise BadPolicy(f"traffic.policy: {name} is no traffic policy: it has no {', '.join(missing)}")
    policy: TrafficPolicy = made
    return policy


def _named(name: str) -> Callable[[str | None], Any]:
    module, _, attribute = name.partition(":")
    try:
        found: Callable[[str | None], Any] = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise BadPolicy(f"traffic.policy={name}: name one as my_package.my_module:MyPolicy ({error})") from error
    return found
