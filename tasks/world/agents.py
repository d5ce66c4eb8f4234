"""Everything that is tracked around the ego, over time."""

from dataclasses import dataclass, replace
from enum import StrEnum

from tasks.world.arrays import Array, Bools


class AgentKind(StrEnum):
    """Classes the reward tells apart (nuPlan's tracked object types)."""

    VEHICLE = "VEHICLE"
    PEDESTRIAN = "PEDESTRIAN"
    BICYCLE = "BICYCLE"  # motorcycles too, as in nuPlan
    TRAFFIC_CONE = "TRAFFIC_CONE"
    BARRIER = "BARRIER"
    CZONE_SIGN = "CZONE_SIGN"
    GENERIC_OBJECT = "GENERIC_OBJECT"


MOVING_KINDS = frozenset({AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE})  # "Agent" in docs/reward.md 2b


PER_STEP = ("boxes", "velocities", "valid", "center_z")  # fields of AgentTracks


@dataclass(frozen=True)
class AgentTracks:
    """N tracks over S steps of 0.1 s, world frame. Absent entries hold NaN and valid = False."""

    track_ids: tuple[str, ...]  # (N,) unique
    kinds: tuple[AgentKind, ...]  # (N,)
    boxes: Array  # (S, N, 5) centre x [m], centre y [m], heading [rad], length [m], width [m]
    velocities: Array  # (S, N, 2) world frame [m/s]
    valid: Bools  # (S, N)
    center_z: Array  # (S, N) height of the box centre, world frame [m]
    heights: Array  # (N,) box height [m]

    @property
    def n_steps(self) -> int:
        return self.valid.shape[0]

    def __len__(self) -> int:
        return len(self.track_ids)

    def window(self, start: int, stop: int) -> "AgentTracks":
        """The same tracks over steps start..stop-1 (views, not copies)."""
        return replace(self, **{name: getattr(self, name)[start:stop] for name in PER_STEP})

    def overwritten(self, start: int, part: "AgentTracks") -> "AgentTracks":
        """A copy whose steps start..start+part.n_steps-1 come from `part` (same tracks, same order)."""
        if part.track_ids != self.track_ids:
            raise ValueError("overwritten() needs the same tracks in the same order")
        stop = start + part.n_steps
        out = {}
        for name in PER_STEP:
            whole = getattr(self, name).copy()
            whole[start:stop] = getattr(part, name)
            out[name] = whole
        return replace(self, **out)
