"""Writes a clip's scene at T as NAVSIM's metric cache, without NAVSIM: classes of the same names, pickled.

Class by class and field by field as the caches of autonomousvision/navsim @ 0a380a9: centre lines, plans and maps are
made anew when they are unpickled (`__reduce__`), shapely's polygons stand as well-known binary, and the occupancy maps
are arrays of objects.
"""

import enum
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from tasks.experts.pdm_closed import plan_for
from tasks.reward.epdms import N_TIMES, PAST_STEPS, _red_connectors
from tasks.world.clip import NOW, Clip, Scene, scene_of_clip
from tasks.world.frames import PACIFICA, REAR_AXLE_TO_CENTER, ego_boxes
from tasks.world.road_map import MapPolygon, polygons_near
from tests.factory.datasets.navsim.openscene_writer import numpy_1_pickle
from tests.factory.datasets.navsim.scene_pickles import (
    TYPES,
    Thing,
    TimePoint,
    TrackedObjectType,
    detections,
    importable,
    new,
)

NOW_US = 1_623_693_601_500_000
PDM = "navsim.planning.simulation.planner.pdm_planner"


class SemanticMapLayer(enum.IntEnum):
    LANE = 0
    INTERSECTION = 1
    DRIVABLE_AREA = 5
    LANE_CONNECTOR = 11
    CARPARK_AREA = 15
    ROADBLOCK = 17


class SceneFrameType(enum.IntEnum):
    ORIGINAL = 0
    SYNTHETIC = 1


class Remade:
    """An object that is pickled as what it is made of."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), self.arguments


def _of(base: type, *words: str) -> dict[str, Any]:
    return {name: type(name.split(" ")[1], (base,), {}) for name in words}


CACHE_TYPES = {
    **TYPES,
    **_of(
        Remade,
        f"{PDM}.utils.pdm_path PDMPath",
        f"{PDM}.observation.pdm_occupancy_map PDMOccupancyMap",
        f"{PDM}.observation.pdm_occupancy_map PDMDrivableMap",
        "nuplan.common.actor_state.vehicle_parameters VehicleParameters",
        "nuplan.planning.simulation.trajectory.interpolated_trajectory InterpolatedTrajectory",
    ),
    **_of(
        Thing,
        f"{PDM}.observation.pdm_observation PDMObservation",
        "navsim.common.dataclasses Trajectory",
        "navsim.planning.metric_caching.metric_cache MapParameters",
        "navsim.planning.metric_caching.metric_cache MetricCache",
        "nuplan.common.actor_state.car_footprint CarFootprint",
        "nuplan.common.actor_state.dynamic_car_state DynamicCarState",
        "nuplan.common.actor_state.ego_state EgoState",
        "nuplan.planning.simulation.trajectory.trajectory_sampling TrajectorySampling",
    ),
    "navsim.common.enums SceneFrameType": SceneFrameType,
    "nuplan.common.maps.maps_datatypes SemanticMapLayer": SemanticMapLayer,
}
MADE = {words.split(" ")[1]: kind for words, kind in CACHE_TYPES.items()}


def cache_of(clip: Clip) -> Any:
    """The scene at T as a `MetricCache`."""
    scene = scene_of_clip(clip)
    polygons = polygons_near(clip.road_map, ego_boxes(scene.ego_state, PACIFICA)[:2])
    past = [_ego(scene.ego_history[k], 100_000 * (k - NOW)) for k in PAST_STEPS]
    plan = plan_for(scene)
    poses = np.zeros((51, 11))
    poses[:, :3] = plan.proposals.poses[plan.chosen]
    return MADE["MetricCache"](
        file_path=Path("cache", clip.log_id, "unknown", "token", "metric_cache.pkl"),
        log_name=clip.log_id,
        timepoint=TimePoint(NOW_US),
        scene_type=SceneFrameType.ORIGINAL,
        trajectory=MADE["InterpolatedTrajectory"]([_ego(row, 100_000 * k) for k, row in enumerate(poses)]),
        human_trajectory=MADE["Trajectory"](poses=np.zeros((8, 3)), trajectory_sampling=None),
        past_human_trajectory=MADE["InterpolatedTrajectory"](past),
        ego_state=_ego(scene.ego_state, 0),
        observation=_observation(scene),
        centerline=MADE["PDMPath"]([new("StateSE2", x=x, y=y, heading=heading) for x, y, heading in scene.centerline]),
        route_lane_ids=sorted(clip.route.lane_ids),
        drivable_area_map=MADE["PDMDrivableMap"](
            [polygon.token for polygon in polygons],
            [SemanticMapLayer[polygon.layer.name] for polygon in polygons],
            [_shape(polygon) for polygon in polygons],
            10,
        ),
        map_parameters=MADE["MapParameters"](map_root="/maps", map_version="nuplan-maps-v1.0", map_name="us-ma-boston"),
    )


def write_cache(folder: Path, token: str, cache: Any, preset: int = 0) -> Path:
    """The file in the folders that NAVSIM makes."""
    path = folder / "log" / "unknown" / token / "metric_cache.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    with importable(CACHE_TYPES):
        path.write_bytes(lzma.compress(numpy_1_pickle(cache), preset=preset))
    return path


def _ego(state: np.ndarray, since_us: int) -> Any:
    x, y, heading, vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_accel = state
    center = x + REAR_AXLE_TO_CENTER * np.cos(heading), y + REAR_AXLE_TO_CENTER * np.sin(heading)
    return MADE["EgoState"](
        _car_footprint=MADE["CarFootprint"](
            _center=new("StateSE2", x=center[0], y=center[1], heading=heading),
            _length=PACIFICA.length,
            _width=PACIFICA.width,
            _height=1.777,
            _vehicle_parameters=MADE["VehicleParameters"](2.297, 4.049, 1.127, 1.67, 3.089, "pacifica", "gen1", 1.777),
        ),
        _tire_steering_angle=steering,
        _is_in_auto_mode=True,
        _time_point=TimePoint(NOW_US + since_us),
        _dynamic_car_state=MADE["DynamicCarState"](
            _rear_axle_to_center_dist=REAR_AXLE_TO_CENTER,
            _angular_velocity=yaw_rate,
            _angular_acceleration=yaw_accel,
            _rear_axle_velocity_2d=new("StateVector2D", _x=vx, _y=vy, _array=np.array([vx, vy])),
            _rear_axle_acceleration_2d=new("StateVector2D", _x=ax, _y=ay, _array=np.array([ax, ay])),
            _tire_steering_rate=steering_rate,
        ),
    )


def _observation(scene: Scene) -> Any:
    agents, (lit, is_red) = scene.agents.window(NOW, NOW + N_TIMES), _red_connectors(scene.clip, scene.step)
    tracks, maps, lights = [], [], []
    for t in range(N_TIMES):
        there = np.flatnonzero(agents.valid[t])
        things = [
            (
                TrackedObjectType[agents.kinds[i].name].value,
                agents.track_ids[i],
                agents.boxes[t, i, :3],
                (*agents.boxes[t, i, 3:], agents.heights[i]),
                agents.velocities[t, i],
            )
            for i in there
        ]
        tracks.append(detections(things, "token"))
        red = [f"red_light_{lane}" for lane, now in zip(lit, is_red[t]) if now]
        shapes = np.array([shapely.Point(*agents.boxes[t, i, :2]).buffer(1.0) for i in there], object)
        maps.append(MADE["PDMOccupancyMap"]([agents.track_ids[i] for i in there], shapes, 10))
        lights.append((red, np.array([shapely.box(0.0, 0.0, 1.0, 1.0) for _ in red], object)))
    return MADE["PDMObservation"](
        _detections_tracks=tracks, _occupancy_maps=maps, _occupancy_maps_tl=lights, _collided_track_ids=[]
    )


def _shape(polygon: MapPolygon) -> Any:
    return shapely.Polygon(polygon.ring, polygon.holes)
