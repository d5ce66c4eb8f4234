"""The last look at a clip before anything is computed from it; every reader's clips pass here.

What a field must hold is said in docs/extend.md. A clip that breaks it would fail later, deep in the science, with an
error that names neither clip nor field.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from factory.readers.base import SPLITS, BadClip, ClipReader, ClipRef, failing_as
from factory.wording import shown
from tasks.world.clip import CLIP_STEPS, AgentKind, AgentTracks, Camera, Clip
from tasks.world.frames import EGO_STATE_SIZE
from tasks.world.road_map import Lane, LightState, MapLayer, RoadMap, Route, TrafficLights

Fault = tuple[str, str]  # the field, and what is wrong with it
KINDS = {"agents": AgentTracks, "road_map": RoadMap, "route": Route, "lights": TrafficLights}
MAPS_REMEMBERED = 4  # clips of a log share its map, and a reader keeps the last logs only


def read_clip(reader: ClipReader, ref: ClipRef) -> Clip:
    """The reader's clip, looked at. Raises BadClip naming the clip and the field."""
    where = f"clip {ref.clip_id} ({ref.dataset} {ref.log_id} at {ref.start_ms / 1000:g} s)"
    with failing_as(where):
        clip = reader.read(ref)
    if not isinstance(clip, Clip):
        raise BadClip(where, "read", f"gave a {type(clip).__name__}, expected a tasks.world.clip.Clip")
    for field in ("clip_id", "dataset", "log_id"):
        if getattr(clip, field) != getattr(ref, field):
            raise BadClip(where, field, f"is {shown(getattr(clip, field))}, expected the ref's {getattr(ref, field)!r}")
    return validate_clip(clip, where)


def validate_clip(clip: Clip, file: str) -> Clip:
    """The same clip. Raises BadClip naming `file` and the field that breaks a promise of the clip's types."""
    for field, problem in _faults(clip):
        raise BadClip(file, field, problem)
    return clip


def _faults(clip: Clip) -> Iterator[Fault]:
    """In an order in which each check may rely on those before it."""
    for field, kind in KINDS.items():
        if not isinstance(getattr(clip, field), kind):
            yield field, f"is a {type(getattr(clip, field)).__name__}, expected {kind.__module__}.{kind.__qualname__}"
    for field in ("licence", "content_digest"):
        if not isinstance(getattr(clip, field), str):
            yield field, f"is a {type(getattr(clip, field)).__name__}, expected text"
    if clip.split not in SPLITS:
        yield "split", f"{shown(clip.split)} is none of {', '.join(SPLITS)}"
    yield from _array("ego_states", clip.ego_states, (CLIP_STEPS, EGO_STATE_SIZE))
    yield from _array("world_from_ego", clip.world_from_ego, (CLIP_STEPS, 4, 4))
    yield from _agent_faults(clip)
    if fault := map_fault(clip.road_map):
        yield fault
    yield from _route_faults(clip)
    yield from _polyline("centerline", clip.centerline)
    yield from _light_faults(clip)
    yield from _sensor_faults(clip)


def _agent_faults(clip: Clip) -> Iterator[Fault]:
    agents, n = clip.agents, len(clip.agents)
    columns: dict[str, tuple[int, ...]] = {"boxes": (5,), "velocities": (2,), "valid": (), "center_z": ()}
    for name, last in columns.items():
        yield from _shape(f"agents.{name}", getattr(agents, name), (CLIP_STEPS, n, *last))
    yield from _shape("agents.heights", agents.heights, (n,))
    if agents.valid.dtype != np.bool_:
        yield "agents.valid", f"dtype {agents.valid.dtype}, expected bool"
    if len(agents.kinds) != n:
        yield "agents.kinds", "not one kind per track"
    if strange := sorted({shown(kind) for kind in agents.kinds if not isinstance(kind, AgentKind)}):
        yield "agents.kinds", f"{', '.join(strange)}: expected tasks.world.clip.AgentKind"
    if len(set(agents.track_ids)) != n:
        yield "agents.track_ids", "a track id stands twice"
    for name in ("boxes", "velocities", "center_z"):
        if not np.isfinite(getattr(agents, name)[agents.valid]).all():
            yield f"agents.{name}", "not finite where valid"
    if not (agents.boxes[agents.valid][:, 3:] > 0.0).all():
        yield "agents.boxes", "a length or width is not positive"


@lru_cache(maxsize=MAPS_REMEMBERED)
def map_fault(road_map: RoadMap) -> Fault | None:
    """The first field of a map that breaks a promise; None where all hold. A map's identity is the object's."""
    return next(_map_faults(road_map), None)


def _map_faults(road_map: RoadMap) -> Iterator[Fault]:
    lanes = road_map.lanes
    for lane_id, lane in lanes.items():
        yield from _lane_faults(f"road_map.lanes[{shown(lane_id)}]", lane_id, lane)
    if not any(lane.drives_cars for lane in lanes.values()):
        yield "road_map.lanes", "no lane for cars"
    for name in ("drivable_areas", "intersections"):
        for i, area in enumerate(getattr(road_map, name) or ()):
            if not isinstance(area.layer, MapLayer):
                yield f"road_map.{name}[{i}].layer", f"{shown(area.layer)}: expected tasks.world.road_map.MapLayer"
            for ring in (area.ring, *area.holes):
                yield from _ring(f"road_map.{name}[{i}]", ring)
    for i, ring in enumerate(road_map.crossings):
        yield from _ring(f"road_map.crossings[{i}]", ring)
    if unknown := sorted(set(road_map.roadblock_of) - set(lanes)):
        yield "road_map.roadblock_of", f"names lanes that are not on the map: {_some(unknown)}"


def _lane_faults(field: str, lane_id: str, lane: Any) -> Iterator[Fault]:
    if not isinstance(lane, Lane):
        yield field, f"is a {type(lane).__name__}, expected tasks.world.road_map.Lane"
    if lane.lane_id != lane_id:
        yield field, f"its lane_id is {shown(lane.lane_id)}"
    yield from _ring(f"{field}.ring", lane.ring)
    yield from _polyline(f"{field}.centerline", lane.centerline)
    for side in ("left_boundary", "right_boundary"):
        if (line := getattr(lane, side)) is not None:
            yield from _array(f"{field}.{side}", line, (None, 3))


def _route_faults(clip: Clip) -> Iterator[Fault]:
    route, blocks = clip.route, clip.road_map.roadblock_of
    if not route.lane_ids:
        yield "route.lane_ids", "empty"
    for name in ("lane_ids", "lane_path"):
        if unknown := sorted(set(getattr(route, name)) - set(clip.road_map.lanes)):
            yield f"route.{name}", f"not on the map: {_some(unknown)}"
    if without := sorted(set(route.lane_ids) - set(blocks)):
        how = "fill it with tasks.world.road_map.roadblocks_of(lanes)"
        yield "road_map.roadblock_of", f"has no roadblock of on-route {_some(without)}: {how}"
    if beside := sorted({blocks[lane_id] for lane_id in route.lane_ids} - set(route.roadblock_ids)):
        yield "route.roadblock_ids", f"lacks the roadblocks of on-route lanes: {_some(beside)}"


def _light_faults(clip: Clip) -> Iterator[Fault]:
    lights = clip.lights
    if not lights.lane_ids:
        return
    yield from _shape("lights.states", lights.states, (CLIP_STEPS, len(lights.lane_ids)))
    if strange := sorted(set(np.unique(lights.states).tolist()) - {int(state) for state in LightState}):
        yield "lights.states", f"{_some(strange)}: expected tasks.world.road_map.LightState"


def _sensor_faults(clip: Clip) -> Iterator[Fault]:
    if any(not isinstance(camera, Camera) for camera in clip.cameras):
        yield "cameras", "expected tasks.world.clip.Camera"
    names = [camera.name for camera in clip.cameras]
    if len(set(names)) != len(names):
        yield "cameras", "a name stands twice"
    if uncalibrated := sorted({image.sensor for image in clip.images} - set(names)):
        yield "images", f"no calibration of camera {uncalibrated}"
    for kind in ("images", "sweeps"):
        for i, file in enumerate(getattr(clip, kind)):
            yield from _array(f"{kind}[{i}].world_from_ego", file.world_from_ego, (4, 4))


def _shape(field: str, array: Any, shape: tuple[int | None, ...]) -> Iterator[Fault]:
    """None: any number of them."""
    if not isinstance(array, np.ndarray):
        yield field, f"is a {type(array).__name__}, expected an array"
    elif array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        yield field, f"shape {array.shape}, expected ({expected}{',' if len(shape) == 1 else ''})"


def _array(field: str, array: Any, shape: tuple[int | None, ...]) -> Iterator[Fault]:
    yield from _shape(field, array, shape)
    if not np.isfinite(array).all():
        yield field, "not finite"


def _ring(field: str, ring: Any) -> Iterator[Fault]:
    yield from _array(field, ring, (None, 2))
    if len(ring) < 4:
        yield field, f"{len(ring)} points: a closed ring has four or more"


def _polyline(field: str, line: Any) -> Iterator[Fault]:
    yield from _array(field, line, (None, 3))
    if len(line) < 2:
        yield field, f"{len(line)} points: a line has two or more"


def _some(names: Sequence[object]) -> str:
    """The first few of many."""
    first = ", ".join(name if isinstance(name, str) else shown(name) for name in names[:3])
    return first + (f" and {len(names) - 3} more" if len(names) > 3 else "")
