"""Everything the reward asks of a scene, made once and used for any number of ego trajectories (docs/reward.md 2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.reward.comfort import interpolated_history
from tasks.world.clip import HORIZON_STEPS, MOVING_KINDS, AgentTracks
from tasks.world.frames import PACIFICA, Vehicle, box_corners, ego_boxes, touching
from tasks.world.road_map import MapLayer, MapPolygon

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

N_TIMES = HORIZON_STEPS + 1
STOPPED_SPEED_MPS = 0.05
LANE_LAYERS = frozenset({MapLayer.LANE, MapLayer.LANE_CONNECTOR})
DRIVABLE_LAYERS = frozenset(
    {MapLayer.ROADBLOCK, MapLayer.INTERSECTION, MapLayer.DRIVABLE_AREA, MapLayer.CARPARK_AREA}
)  # lanes themselves are not in it


@dataclass(frozen=True)
class Regions:
    """R distinct map polygons with the parts they play; polygons with the same rings are one region."""

    shapes: NDArray[np.object_]  # (R,) shapely polygons, prepared
    bounds: Array  # (R, 4) min x, min y, max x, max y [m]
    is_lane: Bools  # (R,) lane or lane connector
    is_on_route: Bools  # (R,) a lane of the route
    is_drivable: Bools  # (R,)
    is_intersection: Bools  # (R,)


@dataclass(frozen=True)
class Obstacles:
    """N objects over 41 steps of 0.1 s, world frame."""

    boxes: Array  # (41, N, 5) centre x, y, heading, length, width; NaN when absent
    centroids: Array  # (41, N, 2) of the box polygons [m]; NaN when absent
    is_stopped: Bools  # (N,) no road user, or at most 0.05 m/s when first seen
    collision_score: Array  # (N,) what an at-fault collision leaves of NC: 0 for road users, else 0.5


@dataclass(frozen=True)
class RedLanes:
    """L on-route lane connectors whose light is red at some time."""

    shapes: NDArray[np.object_]  # (L,) shapely polygons, prepared
    is_red: Bools  # (41, L)


@dataclass(frozen=True)
class PreparedScene:
    """A scene ready to score ego trajectories of 4 s at 10 Hz; steps 0..40, 0 is now."""

    vehicle: Vehicle
    history: Array | None  # (14, 11) ego states at -1.5 .. -0.2 s; None: history comfort is not judged
    centerline: shapely.LineString
    regions: Regions
    obstacles: Obstacles
    red_lanes: RedLanes


def prepare(
    *,
    past_states: Array | None,
    centerline: Array,
    polygons: Sequence[MapPolygon],
    route_lane_ids: frozenset[str],
    objects: AgentTracks,
    red_lanes: tuple[tuple[str, ...], Bools],
    vehicle: Vehicle = PACIFICA,
    ego_state0: Array | None = None,
    drop_touching: bool = True,
) -> PreparedScene:
    """As tasks.reward.epdms.prepare, of arguments that make sense."""
    if ego_state0 is None and past_states is not None:
        ego_state0 = past_states[-1]
    return PreparedScene(
        vehicle=vehicle,
        history=None if past_states is None else interpolated_history(past_states),
        centerline=shapely.LineString(centerline[:, :2]),
        regions=_regions(polygons, route_lane_ids),
        obstacles=_obstacles(objects.window(0, N_TIMES), ego_state0 if drop_touching else None, vehicle),
        red_lanes=_red_lanes(red_lanes, polygons),
    )


def _shape(polygon: MapPolygon) -> shapely.Polygon:
    return shapely.Polygon(polygon.ring[:, :2], [hole[:, :2] for hole in polygon.holes])


def _regions(polygons: Sequence[MapPolygon], route_lane_ids: frozenset[str]) -> Regions:
    index: dict[tuple[bytes, ...], int] = {}
    shapes: list[shapely.Polygon] = []
    parts: list[list[bool]] = []  # is_lane, is_on_route, is_drivable, is_intersection
    for polygon in polygons:
        key = tuple(ring.tobytes() for ring in (polygon.ring, *polygon.holes))
        if key not in index:
            index[key] = len(shapes)
            shapes.append(_shape(polygon))
            parts.append([False] * 4)
        is_lane = polygon.layer in LANE_LAYERS
        plays = (
            is_lane,
            is_lane and polygon.token in route_lane_ids,
            polygon.layer in DRIVABLE_LAYERS,
            polygon.layer is MapLayer.INTERSECTION,
        )
        parts[index[key]] = [a or b for a, b in zip(parts[index[key]], plays)]
    array = np.array(shapes, dtype=object)
    shapely.prepare(array)
    table = np.array(parts, dtype=bool).reshape(-1, 4)
    bounds = shapely.bounds(array).reshape(-1, 4)
    return Regions(array, bounds, table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def _obstacles(objects: AgentTracks, ego_state0: Array | None, vehicle: Vehicle) -> Obstacles:
    boxes = np.where(objects.valid[..., None], objects.boxes, np.nan)
    keep = objects.valid.any(axis=0)
    if ego_state0 is not None:
        keep &= ~touching(ego_boxes(ego_state0, vehicle), boxes[0])
    boxes = boxes[:, keep]
    columns = np.nonzero(keep)[0]

    # Velocity and class are those of the first appearance, as in the public observation.
    first_seen = objects.valid.argmax(axis=0)[columns]
    speed = np.hypot(*objects.velocities[first_seen, columns].T)
    is_agent = np.array([objects.kinds[i] in MOVING_KINDS for i in columns], dtype=bool)

    centroids = np.full((*boxes.shape[:2], 2), np.nan)
    present = np.isfinite(boxes).all(axis=-1)
    centroids[present] = shapely.get_coordinates(shapely.centroid(shapely.polygons(box_corners(boxes[present]))))
    return Obstacles(
        boxes=boxes,
        centroids=centroids,
        is_stopped=~is_agent | (speed <= STOPPED_SPEED_MPS),
        collision_score=np.where(is_agent, 0.0, 0.5),
    )


def _red_lanes(red_lanes: tuple[tuple[str, ...], Bools], polygons: Sequence[MapPolygon]) -> RedLanes:
    lane_ids, is_red = red_lanes
    shape_of = {polygon.token: polygon for polygon in polygons if polygon.layer in LANE_LAYERS}
    columns = [i for i, lane_id in enumerate(lane_ids) if lane_id in shape_of and is_red[:, i].any()]
    shapes = np.array([_shape(shape_of[lane_ids[i]]) for i in columns], dtype=object)
    shapely.prepare(shapes)
    return RedLanes(shapes, is_red[:, columns])
