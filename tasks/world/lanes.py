"""The vector map around a clip: lanes with their graph, drivable areas, crossings, lights."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import Array


@dataclass(frozen=True)
class Lane:
    """One lane segment; polylines run in driving direction, world frame, metres."""

    lane_id: str
    ring: Array  # (M, 2) closed exterior ring of the lane polygon
    centerline: Array  # (P, 3) x, y, heading [rad]
    is_intersection: bool  # True: a lane connector inside a junction
    drives_cars: bool  # VEHICLE and BUS lanes; bicycle lanes are kept for drawing only
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()
    left_neighbor: str | None = None  # may name a lane outside the map, or one of the opposite direction
    right_neighbor: str | None = None
    speed_limit_mps: float | None = None
    left_boundary: Array | None = None  # (B, 3) x, y, z; None where the source has none
    right_boundary: Array | None = None
    left_mark: str = "NONE"  # AV2 lane mark type
    right_mark: str = "NONE"

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.centerline[:, :2], axis=0).T).sum())


class MapLayer(StrEnum):
    """Polygon layers the reward looks at (docs/reward.md 2a)."""

    LANE = "LANE"
    LANE_CONNECTOR = "LANE_CONNECTOR"
    INTERSECTION = "INTERSECTION"
    DRIVABLE_AREA = "DRIVABLE_AREA"
    ROADBLOCK = "ROADBLOCK"
    CARPARK_AREA = "CARPARK_AREA"


@dataclass(frozen=True, eq=False)
class MapPolygon:
    """One polygon of the drivable map; its identity is the object's, so that what is made of it can be kept."""

    token: str  # lane id, "int_" + lane id, "da_" + area id
    layer: MapLayer
    ring: Array  # (M, 2) closed exterior ring
    holes: tuple[Array, ...] = ()  # closed rings


@dataclass(frozen=True, eq=False)
class RoadMap:
    """The map a log carries, in file order; its identity is the object's, so that what is made of it can be kept."""

    lanes: Mapping[str, Lane]
    drivable_areas: tuple[MapPolygon, ...]  # of layers DRIVABLE_AREA, ROADBLOCK, CARPARK_AREA
    crossings: tuple[Array, ...] = ()  # closed rings (M, 2)
    roadblock_of: Mapping[str, str] = field(default_factory=dict)  # lane id -> roadblock (connector) id
    location: str = ""
    intersections: tuple[MapPolygon, ...] | None = None  # None: every intersection lane's own polygon is one

    @property
    def road_rings(self) -> tuple[Array, ...]:
        """Closed exterior rings of all that may be driven on, lanes not named again."""
        return tuple(area.ring for area in (*self.drivable_areas, *(self.intersections or ())))


@dataclass(frozen=True)
class Route:
    """Where the ego is going (docs/reward.md 0, route of a log that has no planner's route)."""

    lane_path: tuple[str, ...]  # lanes driven, in order
    roadblock_ids: tuple[str, ...]  # roadblocks passed, in order
    lane_ids: frozenset[str]  # all lanes of the roadblocks passed ("on route")
    lit_lane_ids: frozenset[str] | None = None  # lanes whose red lights the reward sees; None: those on route


class LightState(IntEnum):
    UNKNOWN = 0
    GREEN = 1
    YELLOW = 2
    RED = 3


@dataclass(frozen=True)
class TrafficLights:
    """State of the light that governs each listed lane connector, per 0.1 s step of the clip."""

    lane_ids: tuple[str, ...] = ()  # (L,)
    states: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, 0), np.int8))  # (S, L) LightState


NO_LIGHTS = TrafficLights()
