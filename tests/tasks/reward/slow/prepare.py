"""Everything the reward asks of a scene, made once and used for any number of ego trajectories (docs/reward.md 2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.world.agents import MOVING_KINDS, AgentTracks
from tasks.world.clip import HORIZON_STEPS, Clip, Scene
from tasks.world.frames import box_corners
from tasks.world.lanes import LightState, MapLayer, MapPolygon
from tasks.world.polygons import polygons_near
from tasks.world.vehicle import EGO_STATE_SIZE, PACIFICA, Vehicle
from tests.tasks.reward.slow.boxes import ego_boxes, touching
from tests.tasks.reward.slow.comfort import comfort_history

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

N_TIMES = HORIZON_STEPS + 1
MAP_RADIUS_M = 100.0  # docs/reward.md 0
PAST_STEPS = (0, 5, 10, 15)  # of the 1.5 s history at 10 Hz: -1.5, -1.0, -0.5, 0 s
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
    red_lanes: tuple[str, ...] | tuple[tuple[str, ...], Bools] = (),
    vehicle: Vehicle = PACIFICA,
    ego_state0: Array | None = None,
    drop_touching: bool = True,
) -> PreparedScene:
    """Prepare a scene given as plain arrays.

    past_states: (4, 11) ego at -1.5, -1.0, -0.5, 0 s, or None to leave history comfort out; centerline: (P, >= 2) of
    the route ahead; polygons: the map around the ego; objects: tracks of at least 41 steps, row 0 is now; red_lanes:
    lane connectors that are red at all times, or (ids, (41, L) mask); lanes that are not among `polygons` are out of
    reach and left out; ego_state0: (11,), by default the last past state.
    drop_touching: objects whose box touches the ego's at step 0 are left out for good, as the public log replay does.
    Raises ValueError for wrong shapes, and when drop_touching has no ego state to look at.
    """
    if past_states is not None and past_states.shape != (len(PAST_STEPS), EGO_STATE_SIZE):
        raise ValueError(f"past_states must be (4, 11), got {past_states.shape}")
    if centerline.ndim != 2 or centerline.shape[0] < 2 or centerline.shape[1] < 2:
        raise ValueError(f"centerline must be (P >= 2, >= 2), got {centerline.shape}")
    if objects.n_steps < N_TIMES:
        raise ValueError(f"objects must span at least {N_TIMES} steps, got {objects.n_steps}")
    if ego_state0 is None and past_states is not None:
        ego_state0 = past_states[-1]
    if ego_state0 is None and drop_touching:
        raise ValueError("drop_touching needs ego_state0 or past_states")
    return PreparedScene(
        vehicle=vehicle,
        history=None if past_states is None else comfort_history(past_states),
        centerline=shapely.LineString(centerline[:, :2]),
        regions=_regions(polygons, route_lane_ids),
        obstacles=_obstacles(objects.window(0, N_TIMES), ego_state0 if drop_touching else None, vehicle),
        red_lanes=_red_lanes(red_lanes, polygons),
    )


def prepare_scene(
    scene: Scene, agents: AgentTracks, vehicle: Vehicle = PACIFICA, drop_touching: bool = True
) -> PreparedScene:
    """Prepare step `scene.step` of a clip against `agents` (41 steps, row 0 is that step): a rollout's or the log's.

    Lights are red for on-route lane connectors over steps scene.step .. scene.step + 40.
    """
    clip = scene.clip
    return prepare(
        past_states=scene.ego_history[list(PAST_STEPS)],
        centerline=scene.centerline,
        polygons=polygons_near(clip.road_map, ego_boxes(scene.ego_state, vehicle)[:2], MAP_RADIUS_M),
        route_lane_ids=clip.route.lane_ids,
        objects=agents,
        red_lanes=_red_connectors(clip, scene.step),
        vehicle=vehicle,
        ego_state0=scene.ego_state,
        drop_touching=drop_touching,
    )


def _red_connectors(clip: Clip, step: int) -> tuple[tuple[str, ...], Bools]:
    """On-route lane connectors with a light, and where it is red over steps step .. step + 40: ids (L,), (41, L)."""
    lights, lanes = clip.lights, clip.road_map.lanes
    governed = [
        i
        for i, lane_id in enumerate(lights.lane_ids)
        if lane_id in clip.route.lane_ids and lane_id in lanes and lanes[lane_id].is_intersection
    ]
    if not governed:
        return (), np.zeros((N_TIMES, 0), dtype=bool)
    states = lights.states[step : step + N_TIMES, governed]
    return tuple(lights.lane_ids[i] for i in governed), states == LightState.RED


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


def _red_lanes(red_lanes: tuple[str, ...] | tuple[tuple[str, ...], Bools], polygons: Sequence[MapPolygon]) -> RedLanes:
    if len(red_lanes) == 2 and isinstance(red_lanes[1], np.ndarray):
        lane_ids, is_red = red_lanes
    else:
        lane_ids, is_red = red_lanes, np.ones((N_TIMES, len(red_lanes)), dtype=bool)
    if is_red.shape != (N_TIMES, len(lane_ids)):
        raise ValueError(f"the mask of red lanes must be ({N_TIMES}, {len(lane_ids)}), got {is_red.shape}")
    shape_of = {polygon.token: polygon for polygon in polygons if polygon.layer in LANE_LAYERS}
    columns = [i for i, lane_id in enumerate(lane_ids) if lane_id in shape_of and is_red[:, i].any()]
    shapes = np.array([_shape(shape_of[lane_ids[i]]) for i in columns], dtype=object)
    shapely.prepare(shapes)
    return RedLanes(shapes, is_red[:, columns])
