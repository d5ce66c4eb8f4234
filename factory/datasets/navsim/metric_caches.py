"""NAVSIM's metric caches as the scenes of a bank, for who has them and not the logs.

A cache is `<folder>/<log>/<scenario type>/<token>/metric_cache.pkl`: the pickle of a `MetricCache` in an lzma stream
(autonomousvision/navsim @ 0a380a9, navsim/planning/metric_caching/metric_cache.py:30-57). It is data: its objects are
records, of which nothing runs (`factory.readers.pickles`). Taken is what the public `pdm_score` takes for the traffic
that replays the log: the ego and its past, the objects and red lights of 4 s, the polygons around, the centre line, and
the plan of PDM-Closed, which progress is relative to. The lists in `metadata` are not looked at: they name the places
where the caches were made.
"""

import lzma
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factory.datasets.navsim.log import (
    CLASSES,
    CheckedValues,
    enum_number,
    inner_record,
    list_of,
    number_of,
    record_fields,
    se2,
    tracked_objects,
    vector,
)
from factory.files import matching
from factory.readers.base import BadClip, bytes_of
from factory.readers.pickles import Record, load_records
from factory.setup.bank import PackedScene, write_packed
from tasks.bank import compliant_progress_m, pack_prepared
from tasks.reward.epdms import N_TIMES, PAST_STEPS, PreparedScene, prepare
from tasks.rollout.lqr import track
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S, AgentTracks
from tasks.world.frames import HEADING, PACIFICA
from tasks.world.road_map import MapLayer, MapPolygon

FILE = "metric_cache.pkl"
MAX_PICKLE_BYTES = 1 << 26  # of a cache unpacked; one of 60 objects has 1.2 MB
MAX_LZMA_BYTES = 1 << 27  # that its unpacking may take
CACHE_CLASSES = (
    *CLASSES,
    "navsim.common.dataclasses Trajectory",
    "navsim.common.enums SceneFrameType",
    "navsim.planning.metric_caching.metric_cache MapParameters",
    "navsim.planning.metric_caching.metric_cache MetricCache",
    "navsim.planning.simulation.planner.pdm_planner.observation.pdm_observation PDMObservation",
    "navsim.planning.simulation.planner.pdm_planner.observation.pdm_occupancy_map PDMDrivableMap",
    "navsim.planning.simulation.planner.pdm_planner.observation.pdm_occupancy_map PDMOccupancyMap",
    "navsim.planning.simulation.planner.pdm_planner.utils.pdm_path PDMPath",
    "nuplan.common.actor_state.car_footprint CarFootprint",
    "nuplan.common.actor_state.dynamic_car_state DynamicCarState",
    "nuplan.common.actor_state.ego_state EgoState",
    "nuplan.common.actor_state.vehicle_parameters VehicleParameters",
    "nuplan.common.maps.maps_datatypes SemanticMapLayer",
    "nuplan.planning.simulation.trajectory.interpolated_trajectory InterpolatedTrajectory",
    "nuplan.planning.simulation.trajectory.trajectory_sampling TrajectorySampling",
    "shapely.io from_wkb",
)
NEEDED = (
    *("ego_state", "past_human_trajectory", "trajectory", "observation"),
    *("centerline", "route_lane_ids", "drivable_area_map"),
)
LAYERS = {  # nuPlan's SemanticMapLayer
    0: MapLayer.LANE,
    1: MapLayer.INTERSECTION,
    5: MapLayer.DRIVABLE_AREA,
    11: MapLayer.LANE_CONNECTOR,
    15: MapLayer.CARPARK_AREA,
    17: MapLayer.ROADBLOCK,
}
PAST_US, SLACK_US = 500_000, 50_000  # between the states of the past
RED_LIGHT = "red_light_"  # before a lane connector's id


@dataclass(frozen=True)
class CachedScene:
    """A scene at T, ready to score plans on, and the drive that their progress is relative to."""

    prepared: PreparedScene
    ego_state: Array  # (11,)
    reference: Array  # (41, 11) PDM-Closed's plan as the tracker drives it


def write_cache_bank(folder: str | Path, caches: str | Path, *, workers: int = 1) -> dict[str, str]:
    """Write the scenes of all caches below a folder as a bank of their tokens, as `factory.setup.bank.write_bank`.

    Returns token -> why, for caches that cannot be read or scored. Raises FileNotFoundError where there are none, and
    as `write_bank`.
    """
    files = {path.parent.name: path for path in matching(Path(caches), f"*/*/*/{FILE}")}
    if not files:
        raise FileNotFoundError(
            f"{caches}: no <log>/<scenario type>/<token>/{FILE} in it: give NAVSIM's metric_cache_path"
        )
    return write_packed(folder, _packed, files, workers=workers)


def read_metric_cache(path: Path) -> CachedScene:
    """The scene of a cache. Raises BadClip that names file and field, ValueError for a scene that cannot be scored."""
    file = str(path)
    cache = load_records(_unpacked(path), file, CACHE_CLASSES, drop_object_arrays=True)
    values = record_fields(CheckedValues({}, file), cache, ("MetricCache",), "pickle")
    values = CheckedValues(values.items, file)
    if missing := [name for name in NEEDED if name not in values.items]:
        raise BadClip(file, ", ".join(missing), "missing: a cache of NAVSIM before v2; make it again by v2")
    observation = inner_record(values, "observation", "PDMObservation")
    now_us, ego = _ego_state(inner_record(values, "ego_state", "EgoState"))
    past_us, past = _states(values, "past_human_trajectory")
    if len(past) != len(PAST_STEPS) or (np.abs(np.diff(past_us) - PAST_US) > SLACK_US).any():
        raise values.bad("past_human_trajectory", f"{len(past)} states, expected {len(PAST_STEPS)} 0.5 s apart")
    prepared = prepare(
        past_states=past,
        centerline=_centerline(values),
        polygons=_polygons(values),
        route_lane_ids=frozenset(values.texts("route_lane_ids")),
        objects=_objects(observation),
        red_lanes=_red_lanes(observation),
        ego_state0=ego,
    )
    plan = _sampled(*_states(values, "trajectory"), now_us)
    return CachedScene(prepared, ego, track(ego, plan[None, 1:], planned_pose0=plan[None, 0])[0])


def _packed(path: Path) -> PackedScene:
    scene = read_metric_cache(path)
    reference_m = compliant_progress_m(scene.prepared, scene.reference)
    return PackedScene(pack_prepared(scene.prepared, scene.ego_state, reference_m))


def _unpacked(path: Path) -> bytes:
    """The pickle in the stream. Raises BadClip for one that is cut off, broken, or unpacks to more than a cache may."""
    stream = lzma.LZMADecompressor(lzma.FORMAT_XZ, MAX_LZMA_BYTES)
    try:
        data = stream.decompress(bytes_of(path), MAX_PICKLE_BYTES + 1)
    except lzma.LZMAError as error:
        raise BadClip(str(path), "lzma", f"no readable stream ({error})") from error
    if len(data) > MAX_PICKLE_BYTES:
        raise BadClip(str(path), "lzma", f"unpacks to more than {MAX_PICKLE_BYTES} bytes: refused")
    if not stream.eof:
        raise BadClip(str(path), "lzma", "the stream is cut off")
    return data


def _ego_state(values: CheckedValues) -> tuple[int, Array]:
    """Time [us] and state (11,) of an `EgoState`. Raises BadClip, also for another car than the rules know."""
    body = inner_record(values, "_car_footprint", "CarFootprint")
    motion = inner_record(values, "_dynamic_car_state", "DynamicCarState")
    own = number_of(body, "_length"), number_of(body, "_width"), number_of(motion, "_rear_axle_to_center_dist")
    if not np.allclose(own, (PACIFICA.length, PACIFICA.width, PACIFICA.rear_axle_to_center), rtol=0.0, atol=1e-6):
        raise body.bad("_length", f"{own[0]:g} x {own[1]:g} m is not the car that the rules know, nuPlan's Pacifica")
    x, y, heading = se2(inner_record(body, "_center", "StateSE2"))
    axle_m = PACIFICA.rear_axle_to_center
    state = [
        *(x - axle_m * np.cos(heading), y - axle_m * np.sin(heading), heading),
        *vector(inner_record(motion, "_rear_axle_velocity_2d", "StateVector2D")),
        *vector(inner_record(motion, "_rear_axle_acceleration_2d", "StateVector2D")),
        *(number_of(values, "_tire_steering_angle"), number_of(motion, "_tire_steering_rate")),
        *(number_of(motion, "_angular_velocity"), number_of(motion, "_angular_acceleration")),
    ]
    return inner_record(values, "_time_point", "TimePoint").integer("time_us"), np.array(state)


def _states(values: CheckedValues, key: str) -> tuple[Ints, Array]:
    """Times (S,) [us], increasing, and states (S, 11) of an `InterpolatedTrajectory`. Raises BadClip."""
    (states,) = _arguments(values, key, "InterpolatedTrajectory", 1)
    rows = [
        _ego_state(record_fields(values, state, ("EgoState",), f"{key}[{i}]"))
        for i, state in enumerate(states if isinstance(states, list) else ())
    ]
    times_us = np.array([time_us for time_us, _ in rows], np.int64)
    if len(rows) < 2 or (np.diff(times_us) <= 0).any():
        raise values.bad(key, "holds no states in the order of time")
    return times_us, np.array([state for _, state in rows])


def _sampled(times_us: Ints, states: Array, now_us: int) -> Array:
    """Poses (41, 3) of a plan from now on, at the instants of the public `get_trajectory_as_array`, which are whole
    microseconds below its steps (navsim/evaluate/pdm_score.py:64-74)."""
    at_us = ((STEP_S * np.arange(N_TIMES) + now_us * 1e-6) * 1e6).astype(np.int64)
    poses = states[:, : HEADING + 1].copy()
    poses[:, HEADING] = np.unwrap(poses[:, HEADING])
    since_us, known_us = at_us - times_us[0], times_us - times_us[0]
    return np.stack([np.interp(since_us, known_us, column) for column in poses.T], axis=1)


def _centerline(values: CheckedValues) -> Array:
    """(P, 3). Raises BadClip."""
    (points,) = _arguments(values, "centerline", "PDMPath", 1)
    if not isinstance(points, list | tuple):
        raise values.bad("centerline", f"is of a {type(points).__name__}, expected a list")
    return np.array([se2(record_fields(values, at, ("StateSE2",), f"centerline[{i}]")) for i, at in enumerate(points)])


def _objects(observation: CheckedValues) -> AgentTracks:
    """The replayed objects of the 41 steps, in the order in which they appear. Raises BadClip."""
    steps = list_of(observation, "_detections_tracks")
    if len(steps) < N_TIMES:
        raise observation.bad("_detections_tracks", f"{len(steps)} instants, expected {N_TIMES}: 4 s at 10 Hz")
    seen = [tracked_objects(observation, one, f"_detections_tracks[{t}]") for t, one in enumerate(steps[:N_TIMES])]
    column: dict[str, int] = {}
    for found in seen:
        for token in found.track_tokens:
            column.setdefault(token, len(column))
    boxes, velocities = np.full((N_TIMES, len(column), 5), np.nan), np.full((N_TIMES, len(column), 2), np.nan)
    first = {token: (found, i) for found in reversed(seen) for i, token in enumerate(found.track_tokens)}
    for t, found in enumerate(seen):
        at = [column[token] for token in found.track_tokens]
        boxes[t, at], velocities[t, at] = np.column_stack([found.poses, found.sizes[:, :2]]), found.velocities
    return AgentTracks(
        track_ids=tuple(column),
        kinds=tuple(found.kinds[i] for found, i in map(first.__getitem__, column)),
        boxes=boxes,
        velocities=velocities,
        valid=np.isfinite(boxes).all(axis=-1),
        center_z=np.full(boxes.shape[:2], np.nan),
        heights=np.array([found.sizes[i, 2] for found, i in map(first.__getitem__, column)]),
    )


def _red_lanes(observation: CheckedValues) -> tuple[tuple[str, ...], Bools]:
    """Lane connectors with a light that is red at some step, and when each is (41, L). Raises BadClip."""
    steps = list_of(observation, "_occupancy_maps_tl")
    if len(steps) < N_TIMES:
        raise observation.bad("_occupancy_maps_tl", f"{len(steps)} instants, expected {N_TIMES}: 4 s at 10 Hz")
    red: list[tuple[str, ...]] = []
    for t, step in enumerate(steps[:N_TIMES]):
        tokens = step[0] if isinstance(step, tuple) and len(step) == 2 else None
        red.append(CheckedValues({"tokens": tokens}, observation.file, f"_occupancy_maps_tl[{t}].").texts("tokens"))
    lanes = tuple(dict.fromkeys(token for tokens in red for token in tokens))
    is_red = np.array([[lane in tokens for lane in lanes] for tokens in red], bool).reshape(N_TIMES, len(lanes))
    return tuple(lane.removeprefix(RED_LIGHT) for lane in lanes), is_red


def _polygons(values: CheckedValues) -> tuple[MapPolygon, ...]:
    """The map around the ego, in the cache's order. Raises BadClip."""
    key = "drivable_area_map"
    arguments = _arguments(values, key, "PDMDrivableMap", 4)
    tokens, layers, shapes = (
        list_of(CheckedValues({name: value}, values.file, f"{key}."), name)
        for name, value in zip(("tokens", "map_types", "geometries"), arguments)
    )
    if not len(tokens) == len(layers) == len(shapes):
        raise values.bad(key, f"{len(tokens)} tokens, {len(layers)} types and {len(shapes)} geometries")
    polygons = []
    for i, (token, layer, shape) in enumerate(zip(tokens, layers, shapes)):
        place = f"{key}[{i}]"
        number = enum_number(values, layer, "SemanticMapLayer", place)
        if number not in LAYERS:
            raise values.bad(place, f"is of layer {number}; the public map is of {', '.join(map(str, LAYERS))}")
        wkb = shape.arguments[0] if isinstance(shape, Record) and shape.name == "from_wkb" and shape.arguments else None
        if not isinstance(token, str) or not isinstance(wkb, bytes):
            raise values.bad(place, "is no polygon with a token")
        try:
            ring, *holes = polygon_rings(wkb)
        except ValueError as error:
            raise values.bad(place, str(error)) from error
        polygons.append(MapPolygon(token, LAYERS[number], ring, tuple(holes)))
    return tuple(polygons)


POLYGON, MULTI_POLYGON = 3, 6
HAS_Z, HAS_M, HAS_SRID = 0x80000000, 0x40000000, 0x20000000  # of the extended form, which shapely writes


def polygon_rings(wkb: bytes) -> list[Array]:
    """The rings (M, 2) of a polygon in well-known binary (OGC 06-103r4, 8.2), its outline first.

    Those of several polygons one after the other: what an odd number of rings encloses is inside either way.
    Raises ValueError for other shapes, and where bytes are missing.
    """
    rings: list[Array] = []
    at, left, kinds = 0, 1, {POLYGON, MULTI_POLYGON}
    try:
        while left:
            order = "<" if wkb[at] else ">"
            kind, count = struct.unpack_from(f"{order}I", wkb, at + 1)[0], 0
            at += 9 if kind & HAS_SRID else 5
            if kind & 0xFFFF not in kinds:
                raise ValueError(f"a geometry of type {kind & 0xFFFF}, expected a polygon")
            (count,) = struct.unpack_from(f"{order}I", wkb, at)
            at, left = at + 4, left - 1
            if kind & 0xFFFF == MULTI_POLYGON:
                left, kinds = count, {POLYGON}
                continue
            columns = 2 + bool(kind & HAS_Z) + bool(kind & HAS_M)
            for _ in range(count):
                (n,) = struct.unpack_from(f"{order}I", wkb, at)
                at, end = at + 4, at + 4 + 8 * n * columns
                if end > len(wkb):
                    raise IndexError
                points = np.frombuffer(wkb[at:end], f"{order}f8").reshape(n, columns)
                rings.append(points[:, :2].astype(np.float64))
                at = end
    except (struct.error, IndexError) as error:
        raise ValueError("a polygon that is cut off") from error
    if not rings:
        raise ValueError("a polygon without an outline")
    return rings


def _arguments(values: CheckedValues, key: str, name: str, n: int) -> tuple[object, ...]:
    """What the object of the class `name` under `key` was made with. Raises BadClip."""
    record = values.get(key)
    inner_record(values, key, name)
    if len(record.arguments) != n:
        raise values.bad(key, f"a {name} made with {len(record.arguments)} values, expected {n}")
    found: tuple[object, ...] = record.arguments
    return found
