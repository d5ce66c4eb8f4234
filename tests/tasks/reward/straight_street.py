"""A straight street to score on: lane "own" (on route, y in -2 .. 2) and lane "other" (y in 2 .. 6), both along x."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.reward.epdms import NO_RED, PreparedScene, prepare
from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.frames import HEADING, VX, X, Y, to_world
from tasks.world.road_map import MapLayer, MapPolygon

ORIGIN = np.zeros(3)


@dataclass(frozen=True)
class Thing:
    """An object that moves at constant velocity over steps first..40."""

    x: float
    y: float
    heading: float = 0.0
    velocity: tuple[float, float] = (0.0, 0.0)
    kind: AgentKind = AgentKind.VEHICLE
    length: float = 4.0
    width: float = 2.0
    first: int = 0


def drive(
    speed: float, y: float = 0.0, x: float = 0.0, heading: float = 0.0, origin: np.ndarray = ORIGIN
) -> np.ndarray:
    """Ego states (1, 41, 11) at constant velocity along its heading."""
    gone = speed * 0.1 * np.arange(41)
    local = np.stack([x + gone * np.cos(heading), y + gone * np.sin(heading), np.full(41, heading)], axis=-1)
    states = np.zeros((1, 41, 11))
    states[0][:, [X, Y, HEADING]] = to_world(origin, local)
    states[0, :, VX] = speed
    return states


def past_of(states: np.ndarray) -> np.ndarray:
    """Past states (4, 11) that lead to row 0 of (1, 41, 11) at its velocity."""
    now = states[0, 0]
    past = np.tile(now, (4, 1))
    back = now[VX] * np.array([1.5, 1.0, 0.5, 0.0])
    past[:, X] -= back * np.cos(now[HEADING])
    past[:, Y] -= back * np.sin(now[HEADING])
    return past


def tracks(things: Sequence[Thing], origin: np.ndarray = ORIGIN) -> AgentTracks:
    steps = np.arange(41)
    boxes = np.full((41, len(things), 5), np.nan)
    velocities = np.full((41, len(things), 2), np.nan)
    for i, thing in enumerate(things):
        seconds = 0.1 * steps
        vx, vy = thing.velocity
        pose = np.stack([thing.x + vx * seconds, thing.y + vy * seconds, np.full(41, thing.heading)], axis=-1)
        seen = steps >= thing.first
        boxes[seen, i, :3] = to_world(origin, pose)[seen]
        boxes[seen, i, 3:] = thing.length, thing.width
        c, s = np.cos(origin[2]), np.sin(origin[2])
        velocities[seen, i] = c * vx - s * vy, s * vx + c * vy
    return AgentTracks(
        track_ids=tuple(f"t{i}" for i in range(len(things))),
        kinds=tuple(thing.kind for thing in things),
        boxes=boxes,
        velocities=velocities,
        valid=np.isfinite(boxes[..., 0]),
        center_z=np.zeros((41, len(things))),
        heights=np.ones(len(things)),
    )


def rectangle(token: str, layer: MapLayer, low: tuple[float, float], high: tuple[float, float]) -> MapPolygon:
    (x0, y0), (x1, y1) = low, high
    return MapPolygon(token, layer, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], dtype=float))


STREET = (
    rectangle("own", MapLayer.LANE, (-60, -2), (140, 2)),
    rectangle("other", MapLayer.LANE, (-60, 2), (140, 6)),
    rectangle("da", MapLayer.DRIVABLE_AREA, (-60, -2), (140, 6)),
)


def street(
    things: Sequence[Thing] | AgentTracks = (),
    extra: Sequence[MapPolygon] = (),
    red_lanes: tuple = NO_RED,
    past: np.ndarray | None = None,
    origin: np.ndarray = ORIGIN,
    ego0: np.ndarray | None = None,
) -> PreparedScene:
    """The street with objects and further map polygons, moved to the frame `origin` as a whole."""

    def moved(ring: np.ndarray) -> np.ndarray:
        return to_world(origin, np.column_stack([ring, np.zeros(len(ring))]))[:, :2]

    return prepare(
        past_states=past,
        centerline=to_world(origin, np.column_stack([np.linspace(-50, 130, 241), np.zeros((241, 2))])),
        polygons=[MapPolygon(p.token, p.layer, moved(p.ring)) for p in (*STREET, *extra)],
        route_lane_ids=frozenset({"own"}),
        objects=things if isinstance(things, AgentTracks) else tracks(things, origin),
        red_lanes=red_lanes,
        ego_state0=drive(0.0, origin=origin)[0, 0] if ego0 is None else ego0,
    )
