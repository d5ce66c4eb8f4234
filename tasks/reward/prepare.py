"""Everything the reward asks of a scene, made once and used for any number of ego trajectories (docs/reward.md 2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from tasks.kernels.compiled import read_only
from tasks.reward.rules.centerline import Centerline, index_centerline
from tasks.reward.rules.comfort import comfort_history
from tasks.reward.rules.lights import NEVER_RED, RedLanes, index_red_lanes
from tasks.reward.rules.map_index import MapIndex, index_map
from tasks.reward.rules.obstacles import N_TIMES, Obstacles, index_obstacles, lay_out
from tasks.world.arrays import Array, Bools
from tasks.world.clip import MOVING_KINDS, AgentKind, AgentTracks, Clip, Scene
from tasks.world.frames import EGO_STATE_SIZE, PACIFICA
from tasks.world.geometry import LARGEST, all_within, ego_boxes
from tasks.world.road_map import LightState, MapLayer, MapPolygon, polygons_near

PAST_STEPS = (0, 5, 10, 15)  # of the 1.5 s history at 10 Hz: -1.5, -1.0, -0.5, 0 s
_NOBODY = read_only(np.full(5, np.nan))
LANE_LAYERS = frozenset({MapLayer.LANE, MapLayer.LANE_CONNECTOR})


# A scene is prepared several times among different objects: by a planner, for its score, for every rollout.
_indexed_map = lru_cache(maxsize=4)(index_map)


@lru_cache(maxsize=4)
def _indexed_line(shape: tuple[int, ...], points: bytes) -> Centerline:
    return index_centerline(np.frombuffer(points).reshape(shape).copy())


@dataclass(frozen=True)
class PreparedScene:
    """A scene ready to score ego trajectories of 4 s at 10 Hz; steps 0..40, 0 is now. Arrays only: it pickles."""

    history: Array | None  # (14, 11) ego states at -1.5 .. -0.2 s; None: history comfort is not judged
    centerline: Centerline
    map_index: MapIndex
    obstacles: Obstacles  # to be looked at one by one
    red_lanes: RedLanes

    @cached_property
    def indexed_obstacles(self) -> Obstacles:
        """The same objects, quicker to look up; made when first asked for, since only many trajectories repay it."""
        radius_m = float(np.hypot(PACIFICA.half_length, PACIFICA.half_width))
        plain = self.obstacles
        return index_obstacles(plain.boxes, plain.is_stopped, plain.collision_score, radius_m)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Arrays that a shared object store hands out read-only are copied: the kernels are compiled for others."""
        self.__dict__.update({name: _writable(value) for name, value in state.items()})


def _writable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.require(value, requirements=["C", "W"])
    return type(value)._make(map(_writable, value)) if hasattr(value, "_make") else value


def prepare(
    *,
    past_states: Array | None,
    centerline: Array,
    polygons: Sequence[MapPolygon],
    route_lane_ids: frozenset[str],
    objects: AgentTracks,
    red_lanes: tuple[str, ...] | tuple[tuple[str, ...], Bools] = (),
    ego_state0: Array | None = None,
    drop_touching: bool = True,
) -> PreparedScene:
    """Prepare a scene given as plain arrays.

    past_states: (4, 11) ego at -1.5, -1.0, -0.5, 0 s, or None to leave history comfort out; centerline: (P, >= 2) of
    the route ahead; polygons: the map around the ego; objects: tracks of at least 41 steps, row 0 is now; red_lanes:
    lane connectors that are red at all times, or (ids, (41, L) mask); lanes that are not among `polygons` are out of
    reach and left out; ego_state0: (11,), by default the last past state.
    drop_touching: objects whose box touches the ego's at step 0 are left out for good, as the public log replay does.
    Raises ValueError, naming the argument, for wrong shapes, ego states or a centreline that are not finite, a
    centreline without length, polygons that bound no area or cross themselves, and when drop_touching has no ego
    state to look at.
    """
    if past_states is not None:
        _check_states("past_states", past_states, (len(PAST_STEPS), EGO_STATE_SIZE))
    if ego_state0 is not None:
        _check_states("ego_state0", ego_state0, (EGO_STATE_SIZE,))
    if ego_state0 is None and past_states is not None:
        ego_state0 = past_states[-1]
    if ego_state0 is None and drop_touching:
        raise ValueError("drop_touching needs ego_state0 or past_states")
    return PreparedScene(
        history=None if past_states is None else comfort_history(read_only(past_states)),
        centerline=_indexed_line(np.shape(centerline), np.ascontiguousarray(centerline, np.float64).tobytes()),
        map_index=_indexed_map(tuple(polygons), route_lane_ids),
        obstacles=_obstacles(objects, ego_state0 if drop_touching else None),
        red_lanes=_red(red_lanes, polygons),
    )


def prepare_scene(scene: Scene, agents: AgentTracks, drop_touching: bool = True) -> PreparedScene:
    """Prepare step `scene.step` of a clip against `agents` (41 steps, row 0 is that step): a rollout's or the log's.

    Lights are red for on-route lane connectors over steps scene.step .. scene.step + 40; drop_touching: see `prepare`.
    """
    clip = scene.clip
    return prepare(
        past_states=scene.ego_history[list(PAST_STEPS)],
        centerline=scene.centerline,
        polygons=polygons_near(clip.road_map, ego_boxes(scene.ego_state, PACIFICA)[:2]),
        route_lane_ids=clip.route.lane_ids,
        objects=agents,
        red_lanes=_red_connectors(clip, scene.step),
        drop_touching=drop_touching,
    )


def among(prepared: PreparedScene, objects: AgentTracks, ego_state0: Array | None) -> PreparedScene:
    """The same scene among other objects: tracks of at least 41 steps, row 0 is now.

    Those that touch the ego at `ego_state0` (11,) are left out for good; None: nobody is. Raises ValueError for tracks
    of other shapes.
    """
    return replace(prepared, obstacles=_obstacles(objects, ego_state0))


def _red_connectors(clip: Clip, step: int) -> tuple[tuple[str, ...], Bools]:
    """Lane connectors whose light counts on the route, ids (L,), and where it is red from `step` on, (41, L)."""
    lights, lanes, route = clip.lights, clip.road_map.lanes, clip.route
    lit = route.lane_ids if route.lit_lane_ids is None else route.lit_lane_ids
    governed = [
        i
        for i, lane_id in enumerate(lights.lane_ids)
        if lane_id in lit and lane_id in lanes and lanes[lane_id].is_intersection
    ]
    if not governed:
        return (), np.zeros((N_TIMES, 0), dtype=bool)
    states = lights.states[step : step + N_TIMES, governed]
    return tuple(lights.lane_ids[i] for i in governed), states == LightState.RED


def _check_states(name: str, states: Array, shape: tuple[int, ...]) -> None:
    if states.shape != shape:
        raise ValueError(f"{name} must be {shape}, got {states.shape}")
    if not all_within(states):
        raise ValueError(f"{name} must be finite and at most {LARGEST:g}, it holds NaN, infinity or more")


def _obstacles(objects: AgentTracks, ego_state0: Array | None) -> Obstacles:
    """The objects but those that touch an ego at `ego_state0`. Raises ValueError where they are none."""
    if objects.n_steps < N_TIMES:
        raise ValueError(f"objects must span at least {N_TIMES} steps, got {objects.n_steps}")
    shape = (objects.n_steps, len(objects))
    for name, wanted in (("valid", shape), ("boxes", (*shape, 5)), ("velocities", (*shape, 2))):
        found = getattr(objects, name).shape
        if found != wanted:
            raise ValueError(f"objects.{name} must be {wanted} for {len(objects)} objects, got {found}")
    if len(objects.kinds) != len(objects):
        raise ValueError(f"objects.kinds must name {len(objects)} objects, got {len(objects.kinds)}")
    all_well, obstacles = lay_out(
        read_only(objects.boxes),
        read_only(objects.velocities),
        read_only(objects.valid, np.bool_),
        collision_scores(objects.kinds),
        _NOBODY if ego_state0 is None else read_only(ego_boxes(ego_state0, PACIFICA)),
    )
    if not all_well:
        raise _refused(objects)
    return obstacles


def _refused(objects: AgentTracks) -> ValueError:
    """The error that names the first object that is there and not well."""
    there = objects.valid.astype(bool) & ~np.isnan(objects.boxes).any(axis=-1)
    wrong = {
        "boxes": ~(np.abs(objects.boxes) <= LARGEST).all(axis=-1) | (objects.boxes[..., 3:] < 0.0).any(axis=-1),
        "velocities": ~(np.abs(objects.velocities) <= LARGEST).all(axis=-1),
    }
    name = next(name for name, where in wrong.items() if (where & there).any())
    step, i = np.argwhere(wrong[name] & there)[0]
    return ValueError(
        f"objects.{name} of {objects.track_ids[i]} at step {step} are {getattr(objects, name)[step, i]}: they "
        f"must be finite, at most {LARGEST:g}, sizes not negative; where it is absent its box is NaN"
    )


@lru_cache(maxsize=4)
def collision_scores(kinds: tuple[AgentKind, ...]) -> Array:
    """What an at-fault collision with each of N objects leaves of NC (N,): 0 for road users. Not to be written to."""
    return read_only(np.array([0.0 if kind in MOVING_KINDS else 0.5 for kind in kinds]))


def _red(red_lanes: tuple[str, ...] | tuple[tuple[str, ...], Bools], polygons: Sequence[MapPolygon]) -> RedLanes:
    if len(red_lanes) == 2 and isinstance(red_lanes[1], np.ndarray):
        lane_ids, is_red = red_lanes
    else:
        lane_ids, is_red = red_lanes, np.ones((N_TIMES, len(red_lanes)), dtype=bool)
    if is_red.shape != (N_TIMES, len(lane_ids)):
        raise ValueError(f"the mask of red lanes must be ({N_TIMES}, {len(lane_ids)}), got {is_red.shape}")
    if is_red.dtype != np.bool_:
        raise ValueError(f"the mask of red lanes must be bool, got {is_red.dtype}")
    if not lane_ids:  # the usual case, and half the cost of preparing a pair's lights
        return NEVER_RED
    lanes = {polygon.token: polygon for polygon in polygons if polygon.layer in LANE_LAYERS}
    columns = [i for i, lane_id in enumerate(lane_ids) if lane_id in lanes and is_red[:, i].any()]
    return index_red_lanes([lanes[lane_ids[i]] for i in columns], is_red[:, columns])
